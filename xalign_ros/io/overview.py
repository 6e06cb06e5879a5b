"""The overview of a batch: a CSV table, and one HTML page that shows the fleet on the map. No network, no script."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.io.report_page import PAGE
from xalign_ros.io.report_run import extent, plane
from xalign_ros.io.text_files import write_text
from xalign_ros.io.tum import read_tum

MOST_POINTS, MOST_POSES = 3000, 400  # of the map, of a run: what a picture can show
WIDTH = 1000.0  # of the picture
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe and Ito's, for all eyes
HIDDEN = ("log", "fingerprint", "trajectory_sha256")

Rows = Mapping[str, Mapping[str, Any]]


def write_overview(folder: Path, rows: Rows, map_: ReferenceMap) -> None:
    """overview.csv and overview.html of the rows by name of their log; trajectories are read from NAME.tum.

    Raises FormatError where they cannot be written.
    """
    columns = list(dict.fromkeys(key for row in rows.values() for key in row if key not in HIDDEN[1:]))
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["name", *columns])
    writer.writerows([name, *("" if row.get(c) is None else row[c] for c in columns)] for name, row in rows.items())
    write_text(folder / "overview.csv", [table.getvalue()])
    paths = {name: read_tum(folder / f"{name}.tum").t for name, row in rows.items() if row.get("poses")}
    write_text(folder / "overview.html", [_page(folder.name, rows, paths, map_)])


def _page(title: str, rows: Rows, paths: Mapping[str, Array], map_: ReferenceMap) -> str:
    m = "m" if map_.metric else "map units"
    told = [row for row in rows.values() if row["status"] != "failed"]
    poses, keyframes = (sum(row[key] or 0 for row in told) for key in ("poses", "keyframes"))
    lead = f"{len(paths)} of {len(rows)} logs have poses, {poses} of {keyframes} keyframes."
    lost = len(rows) - len(told)
    lead += f" {lost} could not be done; the table says why." if lost else ""
    source = f"Map {map_.map_id} {map_.version} from {map_.source}: {len(map_.points)} points, {len(map_.keyframe_t)} keyframes."
    colour = {name: COLOURS[n % len(COLOURS)] for n, name in enumerate(paths)}
    body = [
        f'<h1>{escape(title)}</h1><p class="lead">{escape(lead)}</p><p class="quiet">{escape(source)}</p>',
        _picture(paths, colour, map_, m),
        f"<h2>Logs</h2><table>{''.join(_line(name, row, colour.get(name), m) for name, row in rows.items())}</table>",
    ]
    return PAGE.format(mark="", title=escape(title), body="\n".join(body))


def _line(name: str, row: Mapping[str, Any], colour: str | None, m: str) -> str:
    mark = f'<i style="background:{colour}"></i> ' if colour else ""
    if not row.get("poses"):
        what, value = escape(str(row["words"])), "failed" if row["status"] == "failed" else "no pose"
    else:
        scale = f"{row['scale_min']:.4g} to {row['scale_max']:.4g}"
        what = (
            f"{row['poses']} of {row['keyframes']} keyframes, half of them to {row['position_sigma_m']:.3g} {m}; "
            f"{row['anchors']} anchors, {row['anchors_found']} of them in hindsight, {row['anchors_dropped']} dropped; "
            f"{row['sessions_locked']} of {row['sessions']} sessions locked; {scale} {m} per odometry unit"
        )
        value = f"{100 * row['coverage']:.3g} %"
    return f'<tr><th scope="row">{mark}{escape(name)}<small>{what}</small></th><td>{value}</td></tr>'


def _picture(paths: Mapping[str, Array], colour: Mapping[str, str], map_: ReferenceMap, m: str) -> str:
    """The map's points and the runs' ways, in the plane in which they lie."""
    points = np.asarray(map_.points[:: max(1, len(map_.points) // MOST_POINTS)])
    all_ = np.concatenate([*paths.values(), np.zeros((0, 3))])
    axes, view = plane(all_, map_, points)
    low, high = extent(all_ @ axes.T, np.asarray(map_.keyframe_t) @ axes.T)
    k = WIDTH / (high[0] - low[0])
    height = k * (high[1] - low[1])

    def drawn(x: Array) -> Array:
        flat = k * (x @ axes.T - low)
        flat[:, 1] = height - flat[:, 1]
        return flat

    dots = drawn(points)
    dots = dots[((dots >= 0) & (dots <= (WIDTH, height))).all(axis=1)]
    parts = ["".join(f"M{x:.0f} {y:.0f}h0" for x, y in dots)]
    parts = [f'<path d="{parts[0]}" stroke="#bbb" stroke-width="3" stroke-linecap="round"/>'] if len(dots) else []
    for name, t in paths.items():
        way = " ".join(f"{x:.1f},{y:.1f}" for x, y in drawn(t[:: max(1, len(t) // MOST_POSES)]))
        parts.append(
            f'<polyline points="{way}" stroke="{colour[name]}" stroke-width="3"><title>{escape(name)}</title></polyline>'
        )
    words = f"Where the runs went{view}: coloured as in the table, the map's points grey, {high[0] - low[0]:.3g} {m} across."
    return (
        f'<figure><svg viewBox="0 0 {WIDTH:.0f} {height:.0f}" fill="none" style="height:auto" role="img" '
        f'aria-label="the runs on the map">{"".join(parts)}</svg><figcaption>{escape(words)}</figcaption></figure>'
    )
