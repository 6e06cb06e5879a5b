"""How the pictures of all reports look, and a figure as PNG; the same bytes for the same figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from xalign_ros.core.lie import Array

WIDTH_IN, DPI = 6.4, 200

# Okabe and Ito's colours, which the colour-blind tell apart; each has one meaning in all pictures.
BLUE, SKY, GREEN, ORANGE, RED, PURPLE = "#0072B2 #56B4E9 #009E73 #E69F00 #D55E00 #CC79A7".split()
INK, QUIET, GREY, PALE = "#222222 #5f5f5f #999999 #cccccc".split()
STYLE = f"""axes.edgecolor={GREY} axes.grid=True axes.axisbelow=True axes.labelcolor={INK} axes.spines.right=False
axes.spines.top=False axes.titlelocation=left axes.titlepad=10 axes.titlesize=11 axes.titleweight=bold font.size=9
figure.constrained_layout.use=True figure.dpi={DPI} grid.color=#eeeeee legend.frameon=False lines.linewidth=1.4
lines.markeredgewidth=0 text.color={INK} xtick.color={QUIET} ytick.color={QUIET}"""


@contextmanager
def styled() -> Iterator[None]:
    """Figures made and written within look alike, whatever the user's own settings."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        style: dict[Any, Any] = dict(item.split("=") for item in STYLE.split())
        matplotlib.rcParams.update(style)
        yield


def png(figure: Figure) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def panels(title: str, heights: Sequence[float]) -> tuple[Figure, list[Axes]]:
    """Axes one below the other, of these heights (inch), with one axis of time."""
    figure = Figure((WIDTH_IN, sum(heights) + 0.8))
    axes = list(figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0])
    axes[0].set_title(title)
    return figure, axes


def from_zero(ax: Axes, values: Array) -> None:
    """The axis from zero, or in powers of ten where a few values would flatten all others."""
    ax.set_ylim(0)
    values = values[values > 0]
    if len(values) and values.max() > 20 * np.median(values):
        ax.set_yscale("log")
        ax.set_ylim(np.percentile(values, 1) / 2)
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("")


def with_legend(figure: Figure, empty: str) -> Figure:
    """The legend below, out of the data's way; axes without data say why."""
    for ax in figure.axes:
        if not ax.lines:
            ax.set_yticks([])
            ax.text(0.5, 0.5, empty, transform=ax.transAxes, ha="center", va="center", color=QUIET)
    named = {label: h for ax in figure.axes for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if named:
        figure.set_figheight(figure.get_figheight() + 0.1 + 0.19 * np.ceil(len(named) / 3))
        legend = figure.legend(named.values(), named, loc="outside lower left", ncols=3)
        for line in legend.get_lines():
            line.set_markersize(max(line.get_markersize(), 5))
    return figure
