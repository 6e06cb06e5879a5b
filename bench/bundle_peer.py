"""pyTheia's bundle adjustment of one problem, in a process of its own since it aborts: bundle_peer.py PROBLEM.npz.

For every line on stdin, "THREADS HOMOGENEOUS", it builds the reconstruction anew, adjusts it with inner iterations off
and all else as it comes, and answers with one line of JSON. What it needs and its pages do not say: intrinsics set through
the prior of each view, or every view gets and adjusts its own; an orientation prior of no weight on views without one,
whose field holds what the memory held; and inverse depths initialised.
"""

import json
import sys
import time
from typing import Any

import numpy as np
import pytheia as pt
from scipy.spatial.transform import Rotation


def reconstruction(p: dict[str, Any]) -> tuple[Any, list[int], list[int]]:
    f, cx, cy, width, height = p["intrinsics"]
    known = pt.sfm.CameraIntrinsicsPrior()
    known.image_width, known.image_height, known.camera_intrinsics_model_type = int(width), int(height), "PINHOLE"
    for name, value in (("focal_length", [f]), ("principal_point", [cx, cy]), ("aspect_ratio", [1.0]), ("skew", [0.0])):
        getattr(known, name).value, getattr(known, name).is_set = value, True
    recon, views = pt.sfm.Reconstruction(), []
    for n, (R, c) in enumerate(zip(p["R"], p["c"], strict=True)):
        views.append(recon.AddView(str(n), 0, float(n)))
        view = recon.MutableView(views[-1])
        view.SetCameraIntrinsicsPrior(known)
        view.SetOrientationPrior(np.zeros(3), np.zeros((3, 3)))
        view.SetIsEstimated(True)
        view.MutableCamera().SetPosition(c)
        view.MutableCamera().SetOrientationFromRotationMatrix(R)
    pt.sfm.SetCameraIntrinsicsFromPriors(recon)
    for n, R, c in zip(p["prior_views"], p["prior_R"], p["prior_c"], strict=True):
        view = recon.MutableView(views[n])
        view.SetPositionPrior(c, float(p["position"]) * np.eye(3))
        view.SetOrientationPrior(Rotation.from_matrix(R).as_rotvec(), float(p["orientation"]) * np.eye(3))
    tracks = [recon.AddTrack() for _ in p["X"]]
    for n, track, uv in zip(p["view"].tolist(), p["track"].tolist(), p["uv"], strict=True):
        recon.AddObservation(views[n], tracks[track], pt.sfm.Feature(uv))
    for number, x in zip(tracks, p["X"], strict=True):
        track = recon.MutableTrack(number)
        track.SetPoint(np.r_[x, 1.0])
        track.SetIsEstimated(True)
    if p["inverse_depth"]:
        recon.InitializeInverseDepth()
    return recon, views, tracks


def edges_of(p: dict[str, Any], views: list[int]) -> list[Any]:
    edges, (rotation, translation, direction, magnitude) = [], p["weights"]
    for i, j in p["edges"]:
        edge = pt.sfm.RelativePoseConstraint()
        edge.view_id_i, edge.view_id_j, edge.rotation_sqrt_weight = views[i], views[j], rotation
        edge.scale_invariant_translation = bool(translation == 0)
        edge.translation_sqrt_weight = translation
        edge.translation_direction_sqrt_weight, edge.translation_magnitude_sqrt_weight = direction, magnitude
        edges.append(edge)
    return edges


def main(problem: str) -> None:
    p = dict(np.load(problem))
    for line in sys.stdin:
        threads, homogeneous = map(int, line.split())
        recon, views, tracks = reconstruction(p)
        o = pt.sfm.BundleAdjustmentOptions()
        o.num_threads, o.use_inner_iterations = threads, False
        o.use_homogeneous_point_parametrization = bool(homogeneous)
        o.use_position_priors = o.use_orientation_priors = len(p["prior_views"]) > 0
        o.use_inverse_depth_parametrization = bool(p["inverse_depth"])
        edges, constant = edges_of(p, views), [tracks[k] for k in p["constant_tracks"]]
        held = [views[k] for k in p["constant_views"]]
        start = time.perf_counter()
        if constant:
            done = pt.sfm.BundleAdjustReconstructionWithConstantTracks(o, constant, recon)
        elif held:
            done = pt.sfm.BundleAdjustPartialViewsConstant(o, sorted(set(views) - set(held)), held, recon)
        elif edges:
            done = pt.sfm.BundleAdjustReconstructionWithRelativePoseEdges(o, edges, recon)
        else:
            done = pt.sfm.BundleAdjustReconstruction(o, recon)
        seconds = time.perf_counter() - start
        t = [recon.View(view).Camera().GetPosition().tolist() for view in views]
        answer = {"seconds": seconds, "initial_cost": done.initial_cost, "cost": done.final_cost, "t": t}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
