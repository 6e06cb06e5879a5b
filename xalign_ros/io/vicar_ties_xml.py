"""VICAR's XML tiepoints, all eleven types, several sets, tracks and the extras that marsnav2 writes."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.ties import EXTRAS, PAIRED, Frame, Ties, TieType
from xalign_ros.io.text_files import write_text
from xalign_ros.io.xml_events import BadNumberError, indices, number, parse, whole

MAX_TIES = 5_000_000
MAX_PIXEL = 1e6
NOTES = 5
NAN = float("nan")
PLACED = (TieType.FIDUCIAL, TieType.ORBITAL_XYZ)
ANGLED = (TieType.ONE_D, TieType.AZIMUTH, TieType.ELEVATION)
RESIDUALS = ("left_init_residual", "left_final_residual", "right_init_residual", "right_final_residual")
# Places of numbers in a row: 0 type, 1 left key, 2 right key, then these.
LEFT, RIGHT, PROJECTED, XYZ, ANGLE, QUALITY, INTERACTIVE, RESIDUAL, TRACK, EXTRA = 3, 5, 7, 9, 12, 13, 14, 15, 16, 17
WIDTH = EXTRA + EXTRAS


def read_ties_xml(path: str | Path) -> Ties:
    """A tie with a missing or bad number is left out, and noted with its line, as VICAR does. Raises FormatError."""
    path = Path(path)
    reader = _Reader(path)
    parse(path, "a tiepoint file", "tiepoint_file", reader.start, reader.end)
    return reader.ties()


class _Reader:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows = array("d")
        self.frames: list[Frame] = []
        self.frame_of: list[int] = []
        self.ids: dict[str, int] = {}
        self.names: list[str] = []
        self.notes: list[str] = []
        self.dropped = 0
        self.more = False
        self.row: list[float] | None = None
        self.bad = ""
        self.found: set[str] = set()
        self.number = 0
        self.begin_set()

    def begin_set(self) -> None:
        self.keys: dict[int, int] = {}
        self.set_start = len(self.rows)
        self.frame = -1
        self.lines = array("q")

    def note(self, text: str) -> None:
        if len(self.notes) < NOTES:
            self.notes.append(f"{self.path} {text}")
        elif len(self.notes) == NOTES:
            self.notes.append(f"{self.path}: more of this kind")

    def start(self, name: str, a: dict[str, str]) -> None:
        self.number += 1
        if self.row is not None:
            try:
                self.child(name, a)
            except BadNumberError as error:
                self.bad = self.bad or f"<{name}> has {error}"
        elif name == "tie":
            self.row, self.bad, self.found = [NAN] * WIDTH, "", set()
            self.row[2] = -1.0
            self.row[TRACK] = -1.0
            try:
                self.row[0], self.row[1] = whole(a, "type"), whole(a, "left_key")
                if self.row[0] not in range(11):
                    self.bad = f"type {a['type']} is none of 0 to 10"
                elif self.row[0] in PAIRED:
                    self.row[2] = whole(a, "right_key")
            except BadNumberError as error:
                self.bad = f"<tie> has {error}"
        elif name == "tiepoint_file" and a.get("version") != "1.0":
            self.note(f"has version '{a.get('version', '')}', read as 1.0")
        elif name == "tiepoint_set":
            self.begin_set()
        elif name == "reference_frame":
            frame = Frame(a.get("name", a.get("frame", "")), indices(a), a.get("solution_id", ""))
            if frame not in self.frames:
                self.frames.append(frame)
            self.frame = self.frames.index(frame)
        elif name == "image":
            self.image(a)

    def image(self, a: dict[str, str]) -> None:
        unique_id, key = a.get("unique_id", "").strip(), whole(a, "key")
        if not unique_id:
            raise ValueError("<image> has no unique_id")
        if key in self.keys and self.ids.get(unique_id.lower()) != self.keys[key]:
            self.note(f"key {key} is of two images, {unique_id} is left out: DUPLICATE KEY")
            return
        place = self.ids.setdefault(unique_id.lower(), len(self.ids))
        if place == len(self.names):
            self.names.append(unique_id)
        self.keys[key] = place

    def child(self, name: str, a: dict[str, str]) -> None:
        row = self.row
        assert row is not None
        self.found.add(name)
        if name in ("left", "right", "projected"):
            at = LEFT if name == "left" else RIGHT if name == "right" else PROJECTED
            row[at], row[at + 1] = number(a, "samp", MAX_PIXEL), number(a, "line", MAX_PIXEL)
        elif name == "flags":
            row[QUALITY], row[INTERACTIVE] = number(a, "quality"), whole(a, "interactive")
            if "residual" in a:
                row[RESIDUAL] = number(a, "residual")
        elif name in ("xyz", "xy", "z"):
            for axis in name:
                row[XYZ + "xyz".index(axis)] = number(a, axis)
        elif name in ("angle", "azimuth", "elevation"):
            self.found.add("angle")
            row[ANGLE] = number(a, "degrees")
        elif name == "track":
            row[TRACK] = whole(a, "id")
        elif name in RESIDUALS:
            at = EXTRA + 2 * RESIDUALS.index(name)
            row[at], row[at + 1], self.more = number(a, "samp"), number(a, "line"), True
        elif name in ("init_miss", "final_miss"):
            row[EXTRA + 8 + (name == "final_miss")], self.more = number(a, "dist"), True
        elif name in ("init_xyz", "final_xyz"):
            at = EXTRA + 10 + 3 * (name == "final_xyz")
            row[at : at + 3], self.more = [number(a, axis) for axis in "xyz"], True

    def end(self, name: str) -> None:
        if name == "tie" and self.row is not None:
            row, self.row = self.row, None
            bad = self.bad or self.lacking(int(row[0]))
            if bad:
                self.dropped += 1
                self.note(f"tie {len(self.lines) + self.dropped} left out: {bad}")
            else:
                self.rows.extend(row)
                if len(self.rows) > MAX_TIES * WIDTH:
                    raise ValueError(f"more than {MAX_TIES} ties")
                self.lines.append(self.frame)
        elif name == "tiepoint_set":
            self.end_set()

    def lacking(self, type_: int) -> str:
        needed = ["left", "flags"]
        needed += ["right"] if type_ in PAIRED else []
        needed += ["xyz"] if type_ in PLACED else ["xy"] if type_ == 4 else ["z"] if type_ == 8 else []
        needed += ["angle"] if type_ in ANGLED else []
        return next((f"it has no <{name}>" for name in needed if name not in self.found), "")

    def end_set(self) -> None:
        """Keys of the set become places among all images; ties on images that are not in the set go."""
        values = np.frombuffer(self.rows, float, offset=8 * self.set_start).reshape(-1, WIDTH).copy()
        keys = {float(key): float(place) for key, place in self.keys.items()}
        places = np.array([[keys.get(key, NAN) for key in values[:, c].tolist()] for c in (1, 2)])
        paired = np.isin(values[:, 0], PAIRED)
        known = np.isfinite(places[0]) & (np.isfinite(places[1]) | ~paired)
        if not known.all():
            self.note(f"has {(~known).sum()} ties of keys that no <image> of their set has; they are left out")
            self.dropped += int((~known).sum())
        values[:, 1] = places[0]
        values[:, 2] = np.where(paired, places[1], -1)
        del self.rows[self.set_start :]
        self.rows.frombytes(values[known].tobytes())
        self.frame_of += [self.frame] * int(known.sum())
        self.begin_set()

    def ties(self) -> Ties:
        values = np.frombuffer(self.rows, float).reshape(-1, WIDTH)
        if not len(values):
            more = f"; {self.dropped} were left out, the first: {self.notes[0]}" if self.dropped else ""
            raise FormatError(f"{self.path} has no ties{more}")
        return Ties(
            type=values[:, 0].astype(int),
            left=values[:, 1].astype(int),
            right=values[:, 2].astype(int),
            left_px=values[:, LEFT : LEFT + 2],
            right_px=values[:, RIGHT : RIGHT + 2],
            projected_px=values[:, PROJECTED : PROJECTED + 2],
            xyz=values[:, XYZ : XYZ + 3],
            angle_deg=values[:, ANGLE],
            quality=values[:, QUALITY],
            interactive=values[:, INTERACTIVE].astype(int),
            residual_px=values[:, RESIDUAL],
            track=values[:, TRACK].astype(int),
            frame=np.array(self.frame_of, int),
            extras=values[:, EXTRA:] if self.more else None,
            images=tuple(self.names),
            frames=tuple(self.frames),
            notes=tuple(self.notes),
        )


def write_ties_xml(path: str | Path, ties: Ties, images: tuple[str, ...], start_key: int = 0) -> None:
    """One set for each frame, keys START_KEY + place in `images`. Raises FormatError where it cannot be written."""
    write_text(Path(path), _lines(ties, images, start_key))


def _lines(ties: Ties, images: tuple[str, ...], start_key: int) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="UTF-8"?>\n<tiepoint_file version="1.0">\n'
    for frame in np.unique(ties.frame).tolist():
        yield "<tiepoint_set>\n"
        if frame >= 0:
            f = ties.frames[frame]
            numbered = "".join(f' index{n}="{index}"' for n, index in enumerate(f.index, 1))
            solution = f" solution_id={quoteattr(f.solution_id)}" if f.solution_id else ""
            yield f"  <reference_frame name={quoteattr(f.name)}{numbered}{solution}/>\n"
        yield "  <images>\n"
        for n, name in enumerate(images):
            yield f'    <image unique_id={quoteattr(name)} key="{start_key + n}"/>\n'
        yield "  </images>\n  <tiepoints>\n"
        for row in np.flatnonzero(ties.frame == frame).tolist():
            yield _tie(ties, row, start_key)
        yield "  </tiepoints>\n</tiepoint_set>\n"
    yield "</tiepoint_file>\n"


def _tie(ties: Ties, row: int, start_key: int) -> str:
    type_, paired = int(ties.type[row]), int(ties.type[row]) in PAIRED
    right_key = f' right_key="{start_key + int(ties.right[row])}"' if paired else ""
    out = [f'    <tie type="{type_}" left_key="{start_key + int(ties.left[row])}"{right_key}>\n']

    def element(name: str, **values: Any) -> None:
        out.append(f"      <{name} " + " ".join(f'{k}="{_text(v)}"' for k, v in values.items()) + "/>\n")

    def pixel(name: str, px: np.ndarray) -> None:
        element(f"{name:<9}", line=px[1], samp=px[0])

    pixel("left", ties.left_px[row])
    if paired:
        if np.isfinite(ties.projected_px[row]).all():
            pixel("projected", ties.projected_px[row])
        pixel("right", ties.right_px[row])
    axes = "xyz" if type_ in PLACED else "xy" if type_ == 4 else "z" if type_ == 8 else ""
    if axes:
        element(axes, **{axis: ties.xyz[row]["xyz".index(axis)] for axis in axes})
    if type_ in ANGLED:
        element("angle", degrees=ties.angle_deg[row])
    if ties.extras is not None and np.isfinite(ties.extras[row]).any():
        extra = ties.extras[row]
        for n, name in enumerate(RESIDUALS):
            if np.isfinite(extra[2 * n : 2 * n + 2]).all():
                pixel(name, extra[2 * n : 2 * n + 2])
        for n, when in enumerate(("init", "final")):
            if np.isfinite(extra[8 + n]):
                element(f"{when}_miss", dist=extra[8 + n])
        for n, when in enumerate(("init", "final")):
            if np.isfinite(xyz := extra[10 + 3 * n : 13 + 3 * n]).all():
                element(f"{when}_xyz", x=xyz[0], y=xyz[1], z=xyz[2])
    if ties.track[row] >= 0:
        element("track", id=int(ties.track[row]))
    residual = {"residual": ties.residual_px[row]} if np.isfinite(ties.residual_px[row]) else {}
    element("flags", quality=ties.quality[row], interactive=int(ties.interactive[row]), **residual)
    return "".join([*out, "    </tie>\n"])


def _text(value: Any) -> str:
    """Six decimals, as VICAR writes, or where those would lose something all digits."""
    if isinstance(value, int):
        return str(value)
    short = f"{value:.6f}"
    return short if float(short) == value else repr(float(value))
