"""A progress bar on stderr, where that is a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import track

T = TypeVar("T")


def progress_bar(items: Iterable[T], words: str, total: int | None = None) -> Iterator[T]:
    """The same items, one by one. The bar goes when they are through; `total` where the items have no length."""
    shown = sys.stderr.isatty()
    yield from track(items, words, total, console=Console(stderr=True), transient=True, disable=not shown)
