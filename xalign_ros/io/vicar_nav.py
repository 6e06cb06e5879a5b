"""VICAR's navigation files: XML here, text in vicar_nav_text.py, told apart by the first line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from xalign_ros.core.cahv import Cahv
from xalign_ros.core.errors import FormatError
from xalign_ros.core.lie import Array
from xalign_ros.core.pointing import PARAMETERS, SIX, Pointing, from_six
from xalign_ros.core.ties import Frame
from xalign_ros.io.text_files import write_text
from xalign_ros.io.xml_events import indices, number, parse, whole

IMAGE = ("filter", "frame_id", "image_id", "instrument")  # attributes that are passed on


@dataclass(frozen=True, slots=True)
class Surface:
    """A surface model, passed on as it is."""

    type: str
    solution_id: str
    parameters: tuple[tuple[str, float], ...]
    frame: Frame | None


@dataclass(frozen=True, slots=True, eq=False)
class Nav:
    """All solutions of a file in its order; `priority` lowest first."""

    mission: str
    priority: tuple[str, ...]
    pointings: tuple[Pointing, ...]
    surfaces: tuple[Surface, ...] = ()
    purpose: str = ""
    institution: str = "xalign"
    program: str = "posegraph"

    def solution(self, solution_id: str | None = None) -> tuple[Pointing, ...]:
        """Those of one solution, by default the one of highest priority. Raises ValueError if there is none."""
        ids = list(dict.fromkeys(p.solution_id for p in self.pointings))
        wanted = solution_id
        if wanted is None:
            entries = [entry for entry in self.priority if entry.lower() != "telemetry"]
            if not entries and len({i.lower() for i in ids}) > 1:
                raise ValueError(f"gives no priority among its solutions; SOLUTION_ID chooses: {', '.join(ids)}")
            wanted = entries[-1] if entries else ids[0]
        found = tuple(p for p in self.pointings if p.solution_id.lower() == wanted.lower())
        if not found:
            raise ValueError(f"has no solution '{wanted}', only {', '.join(ids)}")
        return found


@dataclass
class _Solution:
    """What was read of one <solution> or <surface_model>."""

    attributes: dict[str, str]
    image: dict[str, str] = field(default_factory=dict)
    blocks: dict[str, tuple[str, list[tuple[dict[str, str], int]], list[Frame]]] = field(default_factory=dict)


BLOCKS = ("original_parameters", "original_camera_model", "pointing_parameters", "camera_model")


class _Reader:
    def __init__(self) -> None:
        self.mission = ""
        self.priority: list[str] = []
        self.pointings: list[Pointing] = []
        self.surfaces: list[Surface] = []
        self.open: _Solution | None = None
        self.block = ""
        self.origin: dict[str, str] = {}

    def start(self, name: str, a: dict[str, str]) -> None:
        if name == "pointing_correction":
            self.mission = a.get("mission", "")
        elif name == "origination":
            self.origin = a
        elif name == "entry":
            self.priority.append(_text(a, "solution_id", name))
        elif name in ("solution", "surface_model"):
            self.open, self.block = _Solution(a), "" if name == "solution" else name
            self.open.blocks["surface_model"] = (a.get("type", ""), [], [])
        elif self.open is None:
            return
        elif name == "image":
            self.open.image = a
        elif name in BLOCKS:
            self.block = name
            self.open.blocks[name] = (a.get("type", ""), [], [])
        elif name == "parameter" and self.block:
            self.open.blocks[self.block][1].append((a, len(self.open.blocks[self.block][1])))
        elif name == "reference_frame" and self.block:
            frame = Frame(a.get("name", ""), indices(a), a.get("solution_id", ""))
            self.open.blocks[self.block][2].append(frame)

    def end(self, name: str) -> None:
        if name in BLOCKS:
            self.block = ""
        elif name == "solution" and self.open is not None:
            self.pointings.append(_pointing(self.open))
            self.open = None
        elif name == "surface_model" and self.open is not None:
            type_, parameters, frames = self.open.blocks["surface_model"]
            values = tuple((a.get("id", ""), number(a, "value")) for a, _ in parameters)
            own = self.open.attributes.get("solution_id", "")
            self.surfaces.append(Surface(type_, own, values, frames[0] if frames else None))
            self.open = None


def read_nav_xml(path: str | Path) -> Nav:
    """Raises FormatError with file and line."""
    reader = _Reader()
    parse(Path(path), "a pointing correction file", "pointing_correction", reader.start, reader.end)
    if not reader.pointings:
        raise FormatError(f"{path} has no <solution>, so no pointing")
    return Nav(
        reader.mission,
        tuple(reader.priority),
        tuple(reader.pointings),
        tuple(reader.surfaces),
        institution=reader.origin.get("institution", ""),
        program=reader.origin.get("program", ""),
    )


def _text(a: dict[str, str], name: str, of: str) -> str:
    if not a.get(name, "").strip():
        raise ValueError(f"<{of}> has no {name}")
    return a[name].strip()


def _pointing(s: _Solution) -> Pointing:
    blocks = s.blocks
    unique_id = _text(s.image, "unique_id", "image")
    if "pointing_parameters" not in blocks:
        raise ValueError(f"the solution for {unique_id} has no <pointing_parameters>")
    values = {name: _parameters(blocks[name][1], unique_id) for name in BLOCKS[::2] if name in blocks}
    cameras = {name: _camera(*blocks[name][:2]) for name in BLOCKS[1::2] if name in blocks}
    frames = blocks["camera_model"][2] if "camera_model" in blocks else []
    return Pointing(
        unique_id,
        _text(s.attributes, "solution_id", "solution"),
        values["pointing_parameters"],
        values.get("original_parameters"),
        blocks["pointing_parameters"][0],
        cameras.get("camera_model"),
        cameras.get("original_camera_model"),
        frames[0] if frames else None,
        indices(s.attributes),
        {name: s.image[name] for name in IMAGE if name in s.image},
    )


def _parameters(parameters: list[tuple[dict[str, str], int]], unique_id: str) -> Array:
    """(7,) by the names of seven or six, else in the file's order."""
    named = {a.get("id", ""): number(a, "value", 1e9) for a, _ in parameters}
    if len(parameters) == 6 and set(named) == set(SIX):
        return from_six(*np.array([named[name] for name in SIX]).reshape(2, 3))
    if len(parameters) != 7:
        raise ValueError(f"{unique_id} has {len(parameters)} pointing parameters; a pose graph needs seven (or six)")
    values = [named[name] for name in PARAMETERS] if set(named) == set(PARAMETERS) else list(named.values())
    if len(values) != 7 or not np.abs(values[:4]).max() > 1e-6:
        raise ValueError(f"{unique_id} has no quaternion S V1 V2 V3")
    return np.array(values)


def _camera(type_: str, parameters: list[tuple[dict[str, str], int]]) -> Cahv | None:
    if type_ not in ("CAHV", "CAHVOR", "CAHVORE"):
        return None  # a linearized or spherical one, which says nothing here
    named = {a.get("id", ""): a for a, _ in parameters}
    missing = [key for key in type_ if key not in named]
    if missing:
        raise ValueError(f"<camera_model> of type {type_} has no parameter {missing[0]}")
    vectors = {key: np.array([number(named[key], f"value{n}") for n in (1, 2, 3)]) for key in type_}
    mtype = whole(named["T"], "value") if "T" in named else 3
    return Cahv(**vectors, mtype=mtype, mparm=number(named["P"], "value") if "P" in named else 0.0)


def write_nav_xml(path: str | Path, nav: Nav) -> None:
    """As marsnav2 writes, eight decimals; O, R and E with nine digits. Raises FormatError where it cannot be written."""
    write_text(Path(path), _lines(nav))


def _lines(nav: Nav) -> Iterator[str]:
    last = nav.priority[-1] if nav.priority else nav.pointings[0].solution_id
    yield '<?xml version="1.0" encoding="UTF-8"?>\n'
    yield f"<pointing_correction mission={quoteattr(nav.mission)}>\n"
    yield f"  <origination id={quoteattr(last)} institution={quoteattr(nav.institution)}"
    yield f" program={quoteattr(nav.program)}>\n"
    if nav.purpose:
        yield f"    <purpose>{escape(nav.purpose)}</purpose>\n"
    yield "  </origination>\n  <priority>\n"
    for entry in nav.priority:
        yield f"    <entry solution_id={quoteattr(entry)}/>\n"
    yield "  </priority>\n"
    for p in nav.pointings:
        attributes = "".join(f" {name}={quoteattr(p.attributes[name])}" for name in IMAGE if name in p.attributes)
        yield f"  <solution{_numbered(p.index)} solution_id={quoteattr(p.solution_id)}>\n"
        yield f"    <image{attributes} unique_id={quoteattr(p.unique_id)}>\n"
        if p.original is not None:
            yield from _of_parameters("original_parameters", p.model, p.original, "      ")
        if p.original_camera is not None:
            yield from _of_camera("original_camera_model", p.original_camera, p.frame, "      ")
        yield "    </image>\n"
        yield from _of_parameters("pointing_parameters", p.model, p.parameters, "    ")
        if p.camera is not None:
            yield from _of_camera("camera_model", p.camera, p.frame, "    ")
        yield "  </solution>\n"
    for s in nav.surfaces:
        yield f"  <surface_model type={quoteattr(s.type)} solution_id={quoteattr(s.solution_id)}>\n"
        for name, value in s.parameters:
            yield f'    <parameter id={quoteattr(name)} value="{value:.9g}"/>\n'
        yield from _of_frame(s.frame, "    ")
        yield "  </surface_model>\n"
    yield "</pointing_correction>\n"


def _numbered(index: Sequence[int]) -> str:
    return "".join(f' index{n}="{value}"' for n, value in enumerate(index, 1))


def _of_frame(frame: Frame | None, pad: str) -> Iterator[str]:
    if frame is not None:
        yield f"{pad}<reference_frame name={quoteattr(frame.name)}{_numbered(frame.index)}/>\n"


def _of_parameters(name: str, model: str, values: Array, pad: str) -> Iterator[str]:
    yield f"{pad}<{name} type={quoteattr(model)}>\n"
    for key, value in zip(PARAMETERS, values.tolist(), strict=True):
        yield f'{pad}  <parameter id="{key}" value="{_eight(value)}"/>\n'
    yield f"{pad}</{name}>\n"


def _of_camera(name: str, camera: Cahv, frame: Frame | None, pad: str) -> Iterator[str]:
    yield f'{pad}<{name} type="{camera.model}">\n'
    for key in camera.model:
        digits = _eight if key in "CAHV" else "{:.9g}".format
        values = " ".join(f'value{n}="{digits(x)}"' for n, x in enumerate(getattr(camera, key).tolist(), 1))
        yield f'{pad}  <parameter id="{key}" type="float_3" {values}/>\n'
    if camera.model == "CAHVORE":
        yield f'{pad}  <parameter id="T" value="{camera.mtype}"/>\n'
        yield f'{pad}  <parameter id="P" value="{camera.mparm:.9g}"/>\n'
    yield from _of_frame(frame, pad + "  ")
    yield f"{pad}</{name}>\n"


def _eight(value: float) -> str:
    return f"{value + 0.0:.8f}" if abs(value) >= 5e-9 else f"{0.0:.8f}"  # never -0.00000000
