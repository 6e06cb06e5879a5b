"""pyTheia's cross-reconstruction Sim(3) pose graph: its names, fields and defaults, over graph.solve."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from xalign_ros.compat.pytheia_reconstruction import (
    GetSim3LieFromView,
    Reconstruction,
    SetViewCameraFromSim3Lie,
    similarity,
    tangents,
    views_of,
)
from xalign_ros.compat.pytheia_structs import (
    CrossReconstructionConstraints,
    CrossReconstructionPoseGraphOptions,
    CrossReconstructionPoseGraphSummary,
    CrossViewAnchorEdge,
    SequentialSim3Edge,
)
from xalign_ros.compat.pytheia_views import View
from xalign_ros.core.graph import Solution, solve
from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import (
    MAX_LOG_SCALE,
    Anchors,
    Chart,
    Loss,
    PoseGraph,
    ScaleFreeEdges,
    ScaleSmoothness,
    stack,
)
from xalign_ros.core.transforms import SE3
from xalign_ros.core.warp import warp_points

__all__ = ["AlignReconstructionsWithPoseGraph", "CrossReconstructionSim3PoseGraphOptimizer"]


class _Poses(dict[int, Array]):
    """View id -> Log (7,); the page has an attribute, the wheel a method."""

    def __call__(self) -> dict[int, Array]:
        return dict(self)


class CrossReconstructionSim3PoseGraphOptimizer:
    """A second optimize() goes on from where the first ended."""

    def __init__(self, options: CrossReconstructionPoseGraphOptions | None = None) -> None:
        self.options = options or CrossReconstructionPoseGraphOptions()
        self._fixed: dict[int, Array] = {}
        self._poseless: set[int] = set()
        self._variable: dict[int, Array] = {}
        self._sequential: list[SequentialSim3Edge] = []
        self._anchors: list[CrossViewAnchorEdge] = []
        self._smoothness: list[tuple[int, int, float]] = []

    def set_fixed_reconstruction(self, reconstruction: Reconstruction, view_ids: Iterable[int]) -> None:
        """Constant poses that edges may use; a variable view of the same id goes before it."""
        views = views_of(reconstruction, list(view_ids), "fixed")
        for k, v in views.items():
            if not v.IsEstimated():
                raise ValueError(f"fixed view {k} is not estimated, so it has no pose")
        self._fixed = {k: GetSim3LieFromView(v) for k, v in views.items()}

    def set_variable_reconstruction(self, reconstruction: Reconstruction, view_ids: Iterable[int]) -> None:
        """The poses to find, in the order along which scale is smooth."""
        views = views_of(reconstruction, list(view_ids), "variable")
        self._variable = {k: GetSim3LieFromView(v) for k, v in views.items()}
        self._poseless = {k for k, v in views.items() if not v.IsEstimated()}

    def set_initial_variable_poses(self, poses: Mapping[int, Array]) -> None:
        """Start values (7,) of variable views; ids that are none are passed over.

        Raises ValueError on numbers that are not finite and on a log-scale beyond +-20.
        """
        for view_id, lie in poses.items():
            if view_id in self._variable:
                similarity(lie, f"the initial pose of view {view_id}")
                start = np.array(lie, float).reshape(7)
                if abs(start[6]) > MAX_LOG_SCALE + 1e-9:  # what optimize() left at the bound may come back
                    raise ValueError(f"the initial pose of view {view_id} has log-scale {start[6]:g}, beyond +-20")
                self._variable[view_id] = start
                self._poseless.discard(view_id)

    def add_sequential_edge(self, edge: SequentialSim3Edge) -> None:
        self._sequential.append(edge)

    def add_cross_view_edge(self, edge: CrossViewAnchorEdge) -> None:
        self._anchors.append(edge)

    def add_scale_smoothness_edge(self, view_id_i: int, view_id_j: int, weight: float) -> None:
        self._smoothness.append((view_id_i, view_id_j, weight))

    def set_constraints(self, constraints: CrossReconstructionConstraints) -> None:
        """Replaces the sequential and cross-view edges; edges of scale smoothness stay."""
        self._sequential = list(constraints.sequential_edges)
        self._anchors = list(constraints.cross_view_edges)

    @property
    def variable_poses(self) -> _Poses:
        return _Poses((k, x.copy()) for k, x in self._variable.items())

    def optimize(self) -> tuple[bool, CrossReconstructionPoseGraphSummary]:
        """Solve; success says that it converged or came to the iteration limit with a lower cost.

        Raises ValueError on edges to views that are not there or from a view to itself, numbers that are not finite, a
        variable view that neither is estimated nor was given an initial pose, and where nothing ties the variable views
        to the fixed frame.
        """
        solution = solve(self._graph(), max_iterations=self.options.max_num_iterations)
        count = len(self._variable)
        lies = tangents(solution.R[:count], solution.t[:count], solution.s[:count])
        self._variable = dict(zip(self._variable, lies, strict=True))
        summary = self._summary(solution)
        if self.options.verbose:
            print(
                f"cross-reconstruction pose graph: cost {summary.initial_cost:.6g} -> {summary.final_cost:.6g} in "
                f"{solution.iterations} iterations, {'converged' if solution.converged else 'not converged'}"
            )
        return summary.success, summary

    def apply_to_variable_reconstruction(self, reconstruction: Reconstruction, transform_tracks: bool = True) -> None:
        """Write the poses back into estimated views, and move tracks along with the views that see them.

        A track moves world to world, by the mean over its moved views of T_new^-1 T_old, both rigid and world to camera.
        Raises ValueError, with nothing moved yet, on an estimated track whose point is at infinity.
        """
        tracks = [
            x
            for k in (reconstruction.TrackIds() if transform_tracks else [])
            if (x := reconstruction.Track(k)) is not None and x.IsEstimated()
        ]
        homogeneous = np.array([track.Point() for track in tracks]).reshape(-1, 4)
        if not homogeneous[:, 3].all():
            raise ValueError("an estimated track has the fourth coordinate 0, so there is no point to move")
        points = homogeneous[:, :3] / homogeneous[:, 3:]
        inverse_R, inverse_t = [], []
        rows: dict[int, int] = {}
        for view_id, lie in self._variable.items():
            view = reconstruction.View(view_id)
            if view is None or not view.IsEstimated():
                continue
            old = _rigid(view)
            SetViewCameraFromSim3Lie(view, lie)
            D = _rigid(view).inverse() @ old
            rows[view_id] = len(rows)
            inverse_R.append(D.R)
            inverse_t.append(D.t)
        if not rows:
            return
        seen = [[rows[v] for v in sorted(track.ViewIds()) if v in rows] for track in tracks]
        offsets = np.cumsum([0, *map(len, seen)])
        D_all = np.array(inverse_R), np.array(inverse_t), np.ones(len(rows))
        views = np.array([row for rows_ in seen for row in rows_], np.int32)
        moved = warp_points(points, offsets, views, D_all, np.ones(len(rows), bool))
        for track, point in zip(tracks, moved, strict=True):
            track.SetPoint([*point, 1.0])

    def _graph(self) -> PoseGraph:
        o, variable = self.options, list(self._variable)
        if not variable:
            raise ValueError("there are no variable views; set_variable_reconstruction names them")
        if self._poseless:
            raise ValueError(f"variable view {min(self._poseless)} is not estimated and was given no initial pose")
        o.check()
        fixed = [k for k in self._fixed if k not in self._variable]
        row = {k: n for n, k in enumerate([*variable, *fixed])}
        S = stack(
            [
                similarity(x, f"the pose of view {k}")
                for k, x in [*self._variable.items(), *((k, self._fixed[k]) for k in fixed)]
            ]
        )
        ends = [_ends(row, "sequential edge", n, e.view_id_i, e.view_id_j) for n, e in enumerate(self._sequential)]
        weights = o.anchor_weight * np.array([e.weight for e in self._anchors], float)
        if not weights.any() and not any(max(pair) >= len(variable) for pair in ends):
            raise ValueError(
                "there is no cross-view edge with a weight, so nothing ties the variable views to the fixed frame"
            )
        at = [_row(row, "cross-view edge", n, e.variable_view_id) for n, e in enumerate(self._anchors)]
        measured = stack(
            [
                similarity(e.measured_S_ji_log, f"the measurement of sequential edge {n}")
                for n, e in enumerate(self._sequential)
            ]
        )
        targets = stack(
            [
                similarity(e.measured_S_run_in_seg_log, f"the target of cross-view edge {n}")
                for n, e in enumerate(self._anchors)
            ]
        )
        roots = [
            _matrix(e.sqrt_information, f"the sqrt_information of sequential edge {n}")
            for n, e in enumerate(self._sequential)
        ]
        smooth = (
            [(n, n + 1, o.scale_smooth_weight) for n in range(len(variable) - 1)] if o.auto_scale_smoothness else []
        )
        smooth += [(*_ends(row, "scale-smoothness edge", n, i, j), w) for n, (i, j, w) in enumerate(self._smoothness)]
        smooth = [edge for edge in smooth if edge[2] != 0]
        if not all(np.isfinite(w) for *_, w in smooth):
            raise ValueError("the weight of a scale-smoothness edge is not finite")
        pairs = np.array(ends, np.int64).reshape(-1, 2)
        smooth_pairs = np.array([edge[:2] for edge in smooth], np.int64).reshape(-1, 2)
        return PoseGraph(
            np.arange(len(row)),
            *S,
            scale_free=ScaleFreeEdges(
                pairs[:, 0],
                pairs[:, 1],
                *measured[:2],
                o.sequential_weight * np.array(roots).reshape(-1, 7, 7),
                o.sequential_translation_magnitude_weight,
            ),
            anchors=Anchors(
                np.array(at, np.int64),
                *targets,
                (weights**2)[:, None, None] * np.eye(7),
                Chart.QUATERNION,
                Loss("huber", o.huber_delta_anchor) if o.huber_delta_anchor > 0 else Loss(),
            ),
            smoothness=ScaleSmoothness(
                smooth_pairs[:, 0], smooth_pairs[:, 1], np.array([1 / abs(w) for *_, w in smooth], float)
            ),
            fixed=np.arange(len(row)) >= len(variable),
        )

    def _summary(self, solution: Solution) -> CrossReconstructionPoseGraphSummary:
        residuals, weights = solution.residuals, solution.weights
        costs = [
            float((weights[k][:, None] * residuals[k] ** 2).sum()) if k in residuals else 0.0
            for k in ("scale_free", "anchors", "smoothness")
        ]
        better = solution.converged or solution.cost < solution.initial_cost
        finite = all(np.isfinite(x).all() for x in self._variable.values())
        return CrossReconstructionPoseGraphSummary(
            better and finite, solution.initial_cost, solution.cost, solution.iterations + 1, True, finite, *costs
        )


def AlignReconstructionsWithPoseGraph(
    fixed_reconstruction: Reconstruction,
    variable_reconstruction: Reconstruction,
    constraints: CrossReconstructionConstraints,
    options: CrossReconstructionPoseGraphOptions | None = None,
    apply_to_variable_reconstruction: bool = True,
) -> tuple[bool, CrossReconstructionPoseGraphSummary]:
    """Build, optimize, and write the poses and tracks back where that succeeded. Raises ValueError as optimize does."""
    optimizer = CrossReconstructionSim3PoseGraphOptimizer(options)
    optimizer.set_fixed_reconstruction(fixed_reconstruction, constraints.fixed_anchor_view_ids)
    optimizer.set_variable_reconstruction(variable_reconstruction, constraints.variable_keyframe_view_ids)
    optimizer.set_constraints(constraints)
    ok, summary = optimizer.optimize()
    if ok and apply_to_variable_reconstruction:
        optimizer.apply_to_variable_reconstruction(variable_reconstruction)
    return ok, summary


def _rigid(view: View) -> SE3:
    R = view.Camera().GetOrientationAsRotationMatrix()
    return SE3(R, -R @ view.Camera().GetPosition())


def _matrix(value: Array, what: str) -> Array:
    A = np.asarray(value, float)
    if A.shape != (7, 7):
        raise ValueError(f"{what} has shape {A.shape}, needed is (7, 7)")
    return A


def _row(row: Mapping[int, int], kind: str, n: int, view_id: int) -> int:
    if view_id not in row:
        raise ValueError(f"{kind} {n} names view {view_id}, which is neither a variable nor a fixed view")
    return row[view_id]


def _ends(row: Mapping[int, int], kind: str, n: int, i: int, j: int) -> tuple[int, int]:
    if i == j:
        raise ValueError(f"{kind} {n} ties view {i} to itself")
    return _row(row, kind, n, i), _row(row, kind, n, j)
