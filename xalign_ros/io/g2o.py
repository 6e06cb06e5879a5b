"""g2o pose graphs: VERTEX_ and EDGE_ of SE2, SE3:QUAT, SIM3:QUAT (SIM3:EXPMAP is read too), FIX, `#` before comments.

The file orders numbers translation, rotation, log-scale; we order rotation, translation, log-scale. VERTEX_SIM3:QUAT is
`id x y z qx qy qz qw s` (x_a = s R x_i + t), EDGE_SIM3:QUAT `i j x y z qx qy qz qw s` and 28 numbers. What g2o itself
takes for an edge's error is (t_E, vec(q_E)), E = Z^-1 X_i^-1 X_j: half the angle, so "vec" is its reading of the
information and "angle" GTSAM's, which takes the same numbers for Log(E). In SE2 g2o's error has the angle itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import FormatError
from xalign_ros.core.lie import Array, quat_from_rotation, rotation_from_quat, sim3_exp, so3_exp, so3_log
from xalign_ros.core.pose_graph import Chart, PoseGraph, SimilarityEdges
from xalign_ros.io.text_files import read_text, write_text

ROTATION_INFO = ("vec", "angle")
INFORMATION = {"SE2": 6, "SE3:QUAT": 21, "SIM3:QUAT": 28, "SIM3:EXPMAP": 28}
POSE = {"SE2": 3, "SE3:QUAT": 7, "SIM3:QUAT": 8, "SIM3:EXPMAP": 7}
CAMERA = 4  # numbers after a SIM3:EXPMAP vertex: focal lengths and principal point, which say nothing about poses
# Where the file's numbers go in ours; in the plane x, y, yaw.
ORDER = {"SE2": [3, 4, 2], "SE3": [3, 4, 5, 0, 1, 2], "SIM3": [3, 4, 5, 0, 1, 2, 6]}
ACROSS_THE_PLANE = [0, 1, 5, 6]
PSD = 1e-9  # of the largest eigenvalue: how negative rounding may make the smallest


@dataclass(frozen=True, slots=True, eq=False)
class G2o:
    """A graph as it was read: its edges are `similarities`, in the order of the file.

    grammar SE2, SE3 or SIM3; rotation_info how information was read; skipped: lines of tags that are not of pose graphs,
    by tag. A file without vertices has those that its edges name, at identity.
    """

    graph: PoseGraph
    grammar: str
    rotation_info: str
    skipped: dict[str, int]


def read_g2o(path: str | Path, rotation_info: str = "vec") -> G2o:
    """Quaternions are normalised. Raises FormatError, with file and line, on what is no pose graph."""
    path = Path(path)
    text = read_text(path, "no g2o graph")
    lines = _Lines()
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if words:
            try:
                lines.take(words, number)
            except ValueError as error:
                raise FormatError(f"{path} line {number}: {error}") from error
    try:
        return lines.g2o(rotation_info)
    except ValueError as error:
        raise FormatError(f"{path}{'' if str(error).startswith(' line') else ': '}{error}") from error


class _Lines:
    """What was read so far."""

    def __init__(self) -> None:
        self.kind = ""
        self.vertices: dict[int, list[float]] = {}
        self.ends: list[tuple[int, int]] = []
        self.edges: list[list[float]] = []
        self.at: list[int] = []
        self.fix: dict[int, int] = {}
        self.skipped: dict[str, int] = {}

    def take(self, words: list[str], number: int) -> None:
        """One line. Raises ValueError, in words."""
        tag, _, kind = words[0].partition("_")
        if words[0] == "FIX":
            self.fix.update((_id(word), number) for word in words[1:])
        elif tag in ("VERTEX", "EDGE") and kind in POSE:
            if self.kind not in ("", kind):
                raise ValueError(f"{words[0]} after {self.kind}; a graph is all of one kind")
            self.kind = kind
            (self._vertex if tag == "VERTEX" else self._edge)(words, number)
        else:
            self.skipped[words[0]] = self.skipped.get(words[0], 0) + 1

    def _vertex(self, words: list[str], number: int) -> None:
        pose = _numbers(words, 2, POSE[self.kind], CAMERA if self.kind == "SIM3:EXPMAP" else 0)
        vertex = _id(words[1])
        if vertex in self.vertices:
            raise ValueError(f"vertex {vertex} is there already")
        _sound(pose, self.kind)
        self.vertices[vertex] = pose

    def _edge(self, words: list[str], number: int) -> None:
        values = _numbers(words, 3, POSE[self.kind] + INFORMATION[self.kind], 0)
        i, j = _id(words[1]), _id(words[2])
        if i == j:
            raise ValueError(f"an edge from vertex {i} to itself")
        _sound(values[: POSE[self.kind]], self.kind)
        self.ends.append((i, j))
        self.edges.append(values)
        self.at.append(number)

    def g2o(self, rotation_info: str) -> G2o:
        """Raises ValueError on edges and FIX that name vertices that are not there, and on information that is none."""
        if not self.edges:
            raise ValueError("it has no edges of SE2, SE3:QUAT or SIM3, so nothing to solve")
        ids = list(self.vertices) or sorted({end for ends in self.ends for end in ends})
        row = {vertex: n for n, vertex in enumerate(ids)}
        for (i, j), number in zip(self.ends, self.at, strict=True):
            for end in (i, j):
                if end not in row:
                    raise ValueError(f" line {number}: there is no vertex {end}")
        for vertex, number in self.fix.items():
            if vertex not in row:
                raise ValueError(f" line {number}: there is no vertex {vertex} to fix")
        grammar = self.kind.partition(":")[0]
        identity = [0.0] * 3 if grammar == "SE2" else [0.0] * 6 + [1.0] * (POSE[self.kind] - 6)
        if self.kind == "SIM3:EXPMAP":
            identity = [0.0] * 7
        R, t, s = _poses(np.array([self.vertices.get(v, identity) for v in ids]), self.kind)
        values = np.array(self.edges)
        split = POSE[self.kind]
        R_z, t_z, s_z = _poses(values[:, :split], self.kind)
        order = list(range(7)) if self.kind == "SIM3:EXPMAP" else ORDER[grammar]
        information = _full(values[:, split:], order)
        bad = _indefinite(information)
        if bad is not None:
            raise ValueError(f" line {self.at[bad]}: the information is not positive semi-definite")
        if self.kind in ("SE3:QUAT", "SIM3:QUAT"):
            information = _scaled(information, 0.5 if rotation_info == "vec" else 1.0)
        # What an edge in the plane cannot say; the rest does not feel it, since nothing tilts or lifts a flat graph.
        silent = ACROSS_THE_PLANE if grammar == "SE2" else [6] if grammar == "SE3" else []
        information[:, silent, silent] = 1.0
        chart = Chart.SPLIT if grammar == "SE2" else Chart.QUATERNION
        chart = Chart.LOG if rotation_info == "angle" or self.kind == "SIM3:EXPMAP" else chart
        rows = np.array([[row[i], row[j]] for i, j in self.ends])
        graph = PoseGraph(
            np.array(ids),
            R,
            t,
            s,
            similarities=SimilarityEdges(rows[:, 0], rows[:, 1], R_z, t_z, s_z, information, chart),
            fixed=np.array([vertex in self.fix for vertex in ids]),
            free_scale=grammar == "SIM3",
        )
        return G2o(graph, grammar, rotation_info, self.skipped)


def _id(word: str) -> int:
    if not word.isascii() or not word.isdigit() or len(word) > 18:
        raise ValueError(f"'{word}' is no vertex number")
    return int(word)


def _numbers(words: list[str], start: int, count: int, more: int) -> list[float]:
    """The `count` finite numbers after `start` words; `more` may follow. Raises ValueError, in words."""
    if len(words) - start not in (count, count + more):
        raise ValueError(f"{words[0]} with {len(words) - 1} numbers, needed are {count + start - 1}")
    try:
        values = [float(word) for word in words[start : start + count]]
    except ValueError:
        raise ValueError(f"'{' '.join(words[start:])}' are not all numbers") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{words[0]} has a number that is not finite")
    return values


def _sound(pose: list[float], kind: str) -> None:
    if kind in ("SE3:QUAT", "SIM3:QUAT") and not any(pose[3:7]):
        raise ValueError("the quaternion is zero")
    if kind == "SIM3:QUAT" and pose[7] <= 0:
        raise ValueError(f"the scale is {pose[7]}; it must be positive")


def _poses(values: Array, kind: str) -> tuple[Array, Array, Array]:
    """R (N, 3, 3), t (N, 3), s (N,) of rows of numbers.

    SIM3:EXPMAP is g2o's Log of camera to world, in the order rotation, translation, log-scale
    (types_seven_dof_expmap.cpp, which inverts it on reading; its edges likewise).
    """
    if kind == "SIM3:EXPMAP":
        return sim3_exp(values)
    t, s = np.zeros((len(values), 3)), np.ones(len(values))
    if kind == "SE2":
        t[:, :2] = values[:, :2]
        return so3_exp(np.c_[np.zeros((len(values), 2)), values[:, 2]]), t, s
    return rotation_from_quat(values[:, 3:7]), values[:, :3], values[:, 7] if kind == "SIM3:QUAT" else s


def _full(upper: Array, order: list[int]) -> Array:
    """(M, 7, 7) in our order of upper triangles (M, k) in the file's."""
    place = np.array(order)
    rows, columns = np.triu_indices(len(order))
    out = np.zeros((len(upper), 7, 7))
    out[:, place[rows], place[columns]] = upper
    out[:, place[columns], place[rows]] = upper
    return out


def _indefinite(information: Array) -> int | None:
    """The first of the matrices (M, 7, 7) that is not positive semi-definite."""
    size = np.abs(information).max(axis=(1, 2))
    try:
        np.linalg.cholesky(information + (PSD * np.maximum(size, 1e-300))[:, None, None] * np.eye(7))
        return None
    except np.linalg.LinAlgError:
        bad = np.flatnonzero(np.linalg.eigvalsh(information)[:, 0] < -PSD * size)
        return int(bad[0]) if bad.size else None


def _scaled(information: Array, rotation: float) -> Array:
    """Information on rotations that are measured `rotation` times as large."""
    D = np.r_[[rotation] * 3, np.ones(4)]
    return np.asarray(D[:, None] * information * D)


def write_g2o(path: str | Path, g2o: G2o, R: Array, t: Array, s: Array) -> None:
    """The graph with its vertices at R (N, 3, 3), t (N, 3), s (N,), in digits that read back the same.

    SIM3:EXPMAP becomes SIM3:QUAT. The file gets its name when it is complete. Raises FormatError where it cannot be
    written.
    """
    path, graph, grammar = Path(path), g2o.graph, g2o.grammar
    edges = graph.similarities
    assert edges is not None
    tag = {"SE2": "SE2", "SE3": "SE3:QUAT", "SIM3": "SIM3:QUAT"}[grammar]
    information = edges.information
    if grammar != "SE2":
        information = _scaled(information, 2.0 if g2o.rotation_info == "vec" else 1.0)
    order = np.array(ORDER[grammar])
    rows, columns = np.triu_indices(len(order))
    lines = [
        f"VERTEX_{tag} {key} {_text(row)}\n"
        for key, row in zip(graph.keys.tolist(), _rows(R, t, s, grammar).tolist(), strict=True)
    ]
    lines += [f"FIX {key}\n" for key in graph.keys[graph.fixed].tolist()]
    measured = np.hstack([_rows(edges.R, edges.t, edges.s, grammar), information[:, order[rows], order[columns]]])
    ends = zip(graph.keys[edges.i].tolist(), graph.keys[edges.j].tolist(), measured.tolist(), strict=True)
    lines += [f"EDGE_{tag} {i} {j} {_text(row)}\n" for i, j, row in ends]
    write_text(path, lines)


def _rows(R: Array, t: Array, s: Array, grammar: str) -> Array:
    if grammar == "SE2":
        return np.c_[t[:, :2], so3_log(R)[:, 2]]
    pose = np.hstack([t, quat_from_rotation(R)])
    return np.c_[pose, s] if grammar == "SIM3" else pose


def _text(row: list[float]) -> str:
    return " ".join(map(repr, row))
