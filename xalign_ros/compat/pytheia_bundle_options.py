"""pyTheia's options and summary of bundle adjustment, with its fields and defaults, and its enumerations."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import IntEnum, IntFlag

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import Loss

__all__ = [
    "BundleAdjustmentOptions",
    "BundleAdjustmentSummary",
    "DenseLinearAlgebraLibraryType",
    "GravityPriorErrorType",
    "LinearSolverType",
    "LossFunctionType",
    "OptimizeIntrinsicsType",
    "PreconditionerType",
    "SparseLinearAlgebraLibraryType",
    "VisibilityClusteringType",
]

LossFunctionType = IntEnum("LossFunctionType", "TRIVIAL HUBER SOFTLONE CAUCHY ARCTAN TUKEY", start=0)
LinearSolverType = IntEnum(
    "LinearSolverType",
    "DENSE_NORMAL_CHOLESKY DENSE_QR SPARSE_NORMAL_CHOLESKY DENSE_SCHUR SPARSE_SCHUR ITERATIVE_SCHUR CGNR",
    start=0,
)
DenseLinearAlgebraLibraryType = IntEnum("DenseLinearAlgebraLibraryType", "EIGEN LAPACK", start=0)
SparseLinearAlgebraLibraryType = IntEnum(
    "SparseLinearAlgebraLibraryType", "SUITE_SPARSE EIGEN_SPARSE ACCELERATE_SPARSE", start=0
)
VisibilityClusteringType = IntEnum("VisibilityClusteringType", "CANONICAL_VIEWS SINGLE_LINKAGE", start=0)
GravityPriorErrorType = IntEnum("GravityPriorErrorType", "VECTOR_DIFF DIRECTION_CROSS", start=0)


class PreconditionerType(IntEnum):
    IDENTITY, JACOBI, SCHUR_JACOBI, CLUSTER_JACOBI, CLUSTER_TRIDIAGONAL = 0, 1, 2, 4, 5


class OptimizeIntrinsicsType(IntFlag):
    NONE, FOCAL_LENGTH, ASPECT_RATIO, SKEW, PRINCIPAL_POINTS, RADIAL_DISTORTION, TANGENTIAL_DISTORTION = (
        0,
        1,
        2,
        4,
        8,
        16,
        32,
    )
    DISTORTION, FOCAL_LENGTH_RADIAL_DISTORTION, FOCAL_LENGTH_DISTORTION, ALL = 48, 17, 49, 63


LOSSES = {LossFunctionType.TRIVIAL: "none", LossFunctionType.HUBER: "huber", LossFunctionType.CAUCHY: "cauchy"}
REFINED = {
    OptimizeIntrinsicsType.FOCAL_LENGTH: "focal_length",
    OptimizeIntrinsicsType.ASPECT_RATIO: "aspect_ratio",
    OptimizeIntrinsicsType.PRINCIPAL_POINTS: "principal_point",
}
USED = {
    *("loss_function_type", "robust_loss_width", "intrinsics_to_optimize", "max_num_iterations", "verbose"),
    *("use_position_priors", "use_orientation_priors", "use_gravity_priors", "gravity_prior_error_type"),
    *("gravity_world_direction", "use_inverse_depth_parametrization"),
}


@dataclass(eq=False, slots=True)
class BundleAdjustmentOptions:
    loss_function_type: int = LossFunctionType.TRIVIAL
    robust_loss_width: float = 2.0
    robust_loss_width_depth_prior: float = 0.01
    linear_solver_type: int = LinearSolverType.SPARSE_SCHUR
    preconditioner_type: int = PreconditionerType.SCHUR_JACOBI
    visibility_clustering_type: int = VisibilityClusteringType.CANONICAL_VIEWS
    dense_linear_algebra_library_type: int = DenseLinearAlgebraLibraryType.EIGEN
    sparse_linear_algebra_library_type: int = SparseLinearAlgebraLibraryType.EIGEN_SPARSE
    optimize_for_forward_facing_trajectory: bool = False
    use_mixed_precision_solves: bool = False
    max_num_refinement_iterations: int = 2
    verbose: bool = False
    constant_camera_orientation: bool = False
    constant_camera_position: bool = False
    use_homogeneous_point_parametrization: bool = True
    use_inverse_depth_parametrization: bool = False
    intrinsics_to_optimize: int = OptimizeIntrinsicsType.NONE
    num_threads: int = 1
    max_num_iterations: int = 100
    max_solver_time_in_seconds: float = 3600.0
    use_inner_iterations: bool = True
    function_tolerance: float = 1e-6
    gradient_tolerance: float = 1e-10
    parameter_tolerance: float = 1e-8
    max_trust_region_radius: float = 1e12
    use_position_priors: bool = False
    use_orientation_priors: bool = False
    use_depth_priors: bool = False
    use_gravity_priors: bool = False
    orthographic_camera: bool = False
    gravity_prior_error_type: int = GravityPriorErrorType.DIRECTION_CROSS
    gravity_world_direction: Array = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))

    def loss(self) -> Loss:
        """On reprojections. Raises ValueError on a loss that is not here, and on a width that is none."""
        name = LOSSES.get(LossFunctionType(self.loss_function_type))
        if name is None:
            raise ValueError(
                f"the loss {LossFunctionType(self.loss_function_type).name} is not here; TRIVIAL, HUBER and CAUCHY are"
            )
        return Loss(name, self.robust_loss_width) if name != "none" else Loss()

    def refined(self) -> list[str]:
        return [name for flag, name in REFINED.items() if self.intrinsics_to_optimize & flag]

    def constants(self) -> bool:
        """Whether no view moves. Raises ValueError where only their orientations or positions should be constant."""
        if self.constant_camera_orientation != self.constant_camera_position:
            raise ValueError(
                "views are constant or not: constant_camera_orientation and constant_camera_position go together"
            )
        return self.constant_camera_orientation

    def without_counterpart(self) -> tuple[str, ...]:
        """Names of fields that were changed and say nothing here."""
        default = BundleAdjustmentOptions()
        unused = [f.name for f in fields(self) if f.name not in USED and not f.name.startswith("constant_camera")]
        found = [name for name in unused if getattr(self, name) != getattr(default, name)]
        rest = int(self.intrinsics_to_optimize) & ~int(sum(REFINED))
        return (*found, *([f"intrinsics_to_optimize: {OptimizeIntrinsicsType(rest)!r}"] if rest else []))


@dataclass(eq=False, slots=True)
class BundleAdjustmentSummary:
    """Not in pyTheia's: without_counterpart, options that were changed and say nothing here, each once; skipped, sentences
    on views and tracks that stay where they are though they were to move."""

    success: bool = False
    initial_cost: float = 0.0
    final_cost: float = 0.0
    setup_time_in_seconds: float = 0.0
    solve_time_in_seconds: float = 0.0
    without_counterpart: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()
