"""Command lines as VICAR's users write them: NAME=value, prefixes, -KEYWORD, (a,b,c) lists, and ordinary --flags.

Parameters are the fields of a frozen dataclass made by `parameter`, so that name, default and help have one home.
"""

from __future__ import annotations

import dataclasses
import math
import textwrap
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, TypeVar

from xalign_ros.core.errors import ConfigError


class Dataclass(Protocol):
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]


T = TypeVar("T", bound=Dataclass)
REQUIRED = dataclasses.MISSING


class UsageError(Exception):
    """A command line that cannot be taken; str() is one sentence."""


def parameter(
    help_: str, default: Any = REQUIRED, *, keywords: Sequence[str] = (), many: int = 1, also: str = ""
) -> Any:
    """A field: with keywords, of which two (ON, OFF) make a bool and others a word; many > 1 takes a list up to it.

    `also`: another name that is understood.
    """
    metadata = {"help": help_, "keywords": tuple(keywords), "many": many, "also": also}
    return dataclasses.field(default=default, metadata=metadata)


def parse(kind: type[T], words: Sequence[str], positional: Sequence[str] = ("inp", "out")) -> T:
    """The dataclass `kind` from words of a command line. Raises UsageError."""
    fields = {f.name: f for f in dataclasses.fields(kind)}
    found: dict[str, Any] = {}
    left = [name for name in positional]

    def put(name: str, value: str) -> None:
        if name in found:
            raise UsageError(f"{name.upper()} is given twice")
        found[name] = _value(fields[name], value)

    joined = _joined(words)
    while joined:
        word = joined.pop(0)
        name, equals, value = word.partition("=")
        if word.startswith("--"):
            name = _resolved(name[2:].replace("-", "_"), fields, flag=True)
            if name.startswith("no:"):
                found[name[3:]] = False
            elif equals:
                put(name, value)
            elif _is_switch(fields[name]):
                found[name] = True
            elif joined:
                put(name, joined.pop(0))
            else:
                raise UsageError(f"--{name.replace('_', '-')} needs a value")
        elif word.startswith("-") and not equals and not _is_number(word):
            name, value = _keyword(word[1:], fields)
            put(name, value)
        elif equals and name.replace("_", "").isalnum():
            put(_resolved(name, fields), value)
        elif left:
            put(left.pop(0), word)
        else:
            raise UsageError(f"'{word}' is one argument too many; a parameter is given as NAME=value")
    missing = [f.name.upper() for f in fields.values() if f.default is REQUIRED and f.name not in found]
    if missing:
        raise UsageError(f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} required")
    return kind(**found)


def _joined(words: Sequence[str]) -> list[str]:
    """Words with a list that the shell took apart put together again."""
    out: list[str] = []
    depth = 0
    for word in words:
        if depth > 0 or (out and out[-1].endswith(",") and "=" in out[-1] and "=" not in word):
            out[-1] += word
        else:
            out.append(word)
        depth += word.count("(") - word.count(")") if depth > 0 or "=(" in word or word.startswith("(") else 0
    if depth > 0:
        raise UsageError(f"'{out[-1]}' has no closing parenthesis")
    return out


def _is_switch(field: dataclasses.Field[Any]) -> bool:
    return field.type in ("bool", bool)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _resolved(name: str, fields: dict[str, dataclasses.Field[Any]], *, flag: bool = False) -> str:
    """The parameter that a name, another name for it or the beginning of one means; of a flag `no:` and the parameter."""
    low = name.lower()
    names = {f: f for f in fields} | {f.metadata["also"]: f.name for f in fields.values() if f.metadata["also"]}
    if flag:
        names |= {f"no_{f.name}": f"no:{f.name}" for f in fields.values() if _is_switch(f)}
    if low in names:
        return names[low]
    found = sorted({target for known, target in names.items() if low and known.startswith(low)})
    if len(found) == 1:
        return found[0]
    if found:
        raise UsageError(f"'{name}' may be {' or '.join(f.upper() for f in found)}")
    raise UsageError(f"there is no parameter '{name}'")


def _keyword(word: str, fields: dict[str, dataclasses.Field[Any]]) -> tuple[str, str]:
    """Parameter and value of a -KEYWORD or the beginning of one."""
    known = {value: f.name for f in fields.values() for value in f.metadata["keywords"]}
    up = word.upper()
    found = [up] if up in known else [value for value in known if up and value.startswith(up)]
    if len(found) == 1:
        return known[found[0]], found[0]
    raise UsageError(f"'-{word}' may be -{' or -'.join(found)}" if found else f"there is no keyword '-{word}'")


def _value(field: dataclasses.Field[Any], text: str) -> Any:
    name, keywords, many = field.name.upper(), field.metadata["keywords"], field.metadata["many"]
    if keywords:
        matching = [k for k in keywords if k == text.upper()] or [k for k in keywords if k.startswith(text.upper())]
        if len(matching) != 1 or not text:
            raise UsageError(f"{name}={text} is none of {', '.join(keywords)}")
        return matching[0] == keywords[0] if _is_switch(field) else matching[0]
    kind = str(field.type)
    if many > 1:
        inner = text[1:-1] if text.startswith("(") and text.endswith(")") else text
        parts = [part.strip() for part in inner.split(",")]
        if len(parts) > many:
            raise UsageError(f"{name} has {len(parts)} values, at most {many} are taken")
    else:
        parts = [text[1:-1] if text.startswith("(") and text.endswith(")") else text]
    if not all(parts):
        raise UsageError(f"{name} has no value" if len(parts) == 1 else f"{name} has an empty value in its list")
    values = tuple(
        _number(name, p, int if "int" in kind else float) if "int" in kind or "float" in kind else p for p in parts
    )
    return values if many > 1 else values[0]


def _number(name: str, text: str, kind: type) -> Any:
    try:
        value = kind(text)
    except ValueError:
        raise UsageError(f"{name}={text[:40]} is no {'whole ' if kind is int else ''}number") from None
    if not math.isfinite(value):
        raise UsageError(f"{name}={text[:40]} is no number to work with")
    return value


def help_of(kind: type, usage: str, about: str) -> str:
    """The help page: usage, a word about it, and every parameter with its default."""
    out = [usage, "", *textwrap.wrap(about, 100), ""]
    for f in dataclasses.fields(kind):
        keywords = f.metadata["keywords"]
        values = (
            " | ".join(f"-{k}" for k in keywords)
            if keywords
            else f"list, up to {f.metadata['many']}"
            if f.metadata["many"] > 1
            else ""
        )
        if f.default is REQUIRED:
            default = "required"
        elif _is_switch(f):
            default = f"default {keywords[0] if f.default else keywords[1]}"
        else:
            default = "default none" if f.default in (None, ()) else f"default {f.default}"
        out.append(f"{f.name.upper():<16} {', '.join(x for x in (values, default) if x)}")
        out += textwrap.wrap(f.metadata["help"], 100, initial_indent=" " * 17, subsequent_indent=" " * 17)
    return "\n".join(out) + "\n"


def image_numbers(name: str, values: Sequence[int], n: int) -> tuple[int, ...]:
    """Places, from 0, of REFIMAGE or IGNORE: numbers from 1, a negative one closes a range from the one before it.

    1,3,-6,8 is 1,3,4,5,6,8. Raises ConfigError.
    """
    out: list[int] = []
    before = 0
    for value in values:
        if value == 0 or abs(value) > n:
            raise ConfigError(f"{name} names image {abs(value)}; the list has images 1 to {n}")
        if value > 0:
            out.append(value - 1)
        elif 0 < before < -value:
            out.extend(range(before, -value))
        else:
            raise ConfigError(f"{name}: {value} closes a range, so a smaller positive number must come before it")
        before = value
    return tuple(dict.fromkeys(out))
