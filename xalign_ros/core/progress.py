"""How far a long loop of the core has come: the caller passes in what shows it, since the core itself says nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol, TypeVar

T = TypeVar("T")


class Progress(Protocol):
    def __call__(self, items: Sequence[T], words: str) -> Iterable[T]:
        """The same items, one by one; `words` say what is done with them."""


def unseen(items: Sequence[T], words: str) -> Iterable[T]:
    return items
