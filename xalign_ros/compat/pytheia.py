"""`import xalign_ros.compat.pytheia as pt`: pyTheia's cross-reconstruction API as `pt.sfm`, over our engine.

docs/pytheia.md has every name, its counterpart in the core, and where we do what the page means instead of what 1.2.1
does.
"""

from types import SimpleNamespace

from xalign_ros.compat import (
    pytheia_adjuster,
    pytheia_bundle,
    pytheia_bundle_options,
    pytheia_calibrated_pose,
    pytheia_clouds,
    pytheia_intrinsics,
    pytheia_localization,
    pytheia_pose_graph,
    pytheia_priors,
    pytheia_reconstruction,
    pytheia_structs,
    pytheia_tracks,
    pytheia_views,
)

sfm = SimpleNamespace(
    **{
        name: getattr(module, name)
        for module in (
            pytheia_adjuster,
            pytheia_bundle,
            pytheia_bundle_options,
            pytheia_calibrated_pose,
            pytheia_clouds,
            pytheia_intrinsics,
            pytheia_localization,
            pytheia_pose_graph,
            pytheia_priors,
            pytheia_reconstruction,
            pytheia_structs,
            pytheia_tracks,
            pytheia_views,
        )
        for name in module.__all__
    }
)
solvers = SimpleNamespace(
    RansacParameters=pytheia_calibrated_pose.RansacParameters, RansacSummary=pytheia_calibrated_pose.RansacSummary
)
