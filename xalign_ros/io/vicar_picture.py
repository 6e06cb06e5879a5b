"""The pose graph of `xalign posegraph` before and after, from above, as a PNG."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from xalign_ros.core.errors import FormatError
from xalign_ros.core.tie_graph import Result


def write_picture(path: str | Path, result: Result) -> None:
    """The two widest axes of the images' bodies, edges as lines. Raises FormatError where it cannot be written."""
    path = Path(path)
    before, after = (np.array([v.T_site_body.t for v in views]) for views in (result.before, result.after))
    across, up = np.sort(np.argsort(-np.ptp(before, axis=0), kind="stable")[:2]).tolist()
    figure = Figure(figsize=(8, 8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    ends = [(e.a, e.b) for e in result.edges if e.T_a_b is not None]
    lines = [after[list(pair)][:, [across, up]] for pair in ends]
    axes.add_collection(LineCollection(lines, colors="tab:blue", linewidths=0.6, alpha=0.5))
    axes.plot(before[:, across], before[:, up], "o", color="0.6", ms=4, label="before")
    axes.plot(after[:, across], after[:, up], "o", color="tab:blue", ms=4, label=f"after, with {len(ends)} edges")
    held = list(result.references)
    axes.plot(after[held, across], after[held, up], "s", mfc="none", color="tab:red", ms=9, label="held")
    axes.set(xlabel=f"{'XYZ'[across]} (m)", ylabel=f"{'XYZ'[up]} (m)", aspect="equal", adjustable="datalim")
    axes.legend()
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        figure.savefig(temporary, format="png", dpi=120, metadata={"Software": None})
        os.replace(temporary, path)
    except OSError as error:
        raise FormatError(f"{path} cannot be written: {error.strerror}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()
