"""LOSS[:WIDTH] on a command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from xalign_ros.core.pose_graph import Loss


def loss_of(width: float) -> Callable[[str], Loss]:
    """What argparse reads a loss by, of this width in standard deviations where none is given."""

    def read(text: str) -> Loss:
        name, _, given = text.partition(":")
        try:
            return Loss(name, float(given) if given else width)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read
