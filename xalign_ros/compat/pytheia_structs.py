"""pyTheia's constraint, option and summary structs: mutable, with its fields and defaults.

They have slots, so a field that is not there is an AttributeError, as in pyTheia, and no setting is lost to a typo.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from xalign_ros.compat.pytheia_reconstruction import kInvalidViewId
from xalign_ros.core.lie import Array

__all__ = [
    "CrossReconstructionConstraints",
    "CrossReconstructionPoseGraphOptions",
    "CrossReconstructionPoseGraphSummary",
    "CrossViewAnchorEdge",
    "RelativePoseConstraint",
    "SequentialSim3Edge",
]


@dataclass(eq=False, slots=True)
class RelativePoseConstraint:
    """An odometry edge of bundle adjustment."""

    view_id_i: int = kInvalidViewId
    view_id_j: int = kInvalidViewId
    translation_sqrt_weight: float = 1.0
    rotation_sqrt_weight: float = 1.0
    scale_invariant_translation: bool = False
    translation_direction_sqrt_weight: float = 1.0
    translation_magnitude_sqrt_weight: float = 0.0


@dataclass(eq=False, slots=True)
class SequentialSim3Edge:
    """measured_S_ji_log (7,): Log(S_i^-1 S_j) in Sophus' order; sqrt_information (7, 7): rotation, direction, magnitude."""

    view_id_i: int = kInvalidViewId
    view_id_j: int = kInvalidViewId
    measured_S_ji_log: Array = field(default_factory=lambda: np.zeros(7))
    sqrt_information: Array = field(default_factory=lambda: np.eye(7))


@dataclass(eq=False, slots=True)
class CrossViewAnchorEdge:
    """measured_S_run_in_seg_log (7,): what S of the view should be, in Sophus' order; one weight for all of it."""

    variable_view_id: int = kInvalidViewId
    measured_S_run_in_seg_log: Array = field(default_factory=lambda: np.zeros(7))
    weight: float = 1.0


@dataclass(eq=False, slots=True)
class CrossReconstructionConstraints:
    variable_keyframe_view_ids: list[int] = field(default_factory=list)
    fixed_anchor_view_ids: list[int] = field(default_factory=list)
    sequential_edges: list[SequentialSim3Edge] = field(default_factory=list)
    cross_view_edges: list[CrossViewAnchorEdge] = field(default_factory=list)


@dataclass(eq=False, slots=True)
class CrossReconstructionPoseGraphOptions:
    sequential_weight: float = 1.0
    anchor_weight: float = 1.0
    sequential_translation_magnitude_weight: float = 0.2
    scale_smooth_weight: float = 0.1
    huber_delta_anchor: float = 1.0
    auto_scale_smoothness: bool = True
    max_num_iterations: int = 50
    verbose: bool = False
    debug_cost_breakdown: bool = False

    def check(self) -> None:
        """Raises ValueError on a number that is not finite and on fewer than 0 iterations."""
        for name in self.__slots__:
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"the option {name} is {getattr(self, name)}")
        if self.max_num_iterations < 0:
            raise ValueError(f"the option max_num_iterations is {self.max_num_iterations}; it cannot be negative")


@dataclass(eq=False, slots=True)
class CrossReconstructionPoseGraphSummary:
    """The residual costs are sums of squares of the residuals as the loss leaves them, without the half."""

    success: bool = False
    initial_cost: float = 0.0
    final_cost: float = 0.0
    num_iterations: int = 0
    poses_finite_before: bool = True
    poses_finite_after: bool = True
    sequential_residual_cost: float = 0.0
    anchor_residual_cost: float = 0.0
    scale_smooth_residual_cost: float = 0.0
