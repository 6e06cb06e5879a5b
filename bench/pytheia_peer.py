"""pyTheia's pose graph on one problem, in a process of its own since it aborts: pytheia_peer.py PROBLEM.npz ANSWER.npz.

Camera-to-world poses, weights of the row "best" (sequential rotation 1 / 0.1 deg, direction 50, magnitude 20, anchor 5,
smoothness 5, Huber 0.3), log-scale 1e-4 at the start, where its derivative by scale is not dropped.
"""

import sys
import time

import numpy as np
import pytheia as pt

ROTATION, DIRECTION, MAGNITUDE, ANCHOR, SMOOTH, HUBER, SIGMA_0 = 1 / np.deg2rad(0.1), 50.0, 20.0, 5.0, 5.0, 0.3, 1e-4


def tangents(R: np.ndarray, t: np.ndarray, s: float) -> list[np.ndarray]:
    return [np.asarray(pt.sfm.Sim3FromRotationTranslationScale(r, x, s)) for r, x in zip(R, t, strict=True)]


def main(problem: str, answer: str) -> None:
    p = np.load(problem)
    R, c = p["R"], p["c"]
    recon = pt.sfm.Reconstruction()
    ids = []
    for n in range(len(c)):
        view = recon.AddView(str(n), float(n))
        recon.View(view).SetIsEstimated(True)
        ids.append(view)
    options = pt.sfm.CrossReconstructionPoseGraphOptions()
    options.sequential_translation_magnitude_weight = MAGNITUDE
    options.anchor_weight, options.scale_smooth_weight, options.huber_delta_anchor = ANCHOR, SMOOTH, HUBER
    options.max_num_iterations = int(p["iterations"])
    optimizer = pt.sfm.CrossReconstructionSim3PoseGraphOptimizer(options)
    optimizer.set_variable_reconstruction(recon, ids)
    optimizer.set_initial_variable_poses(dict(zip(ids, tangents(R, c, np.exp(SIGMA_0)), strict=True)))
    between_R = np.swapaxes(R[:-1], 1, 2) @ R[1:]
    between_t = np.einsum("nji,nj->ni", R[:-1], c[1:] - c[:-1])
    for n, measured in enumerate(tangents(between_R, between_t, 1.0)):
        edge = pt.sfm.SequentialSim3Edge()
        edge.view_id_i, edge.view_id_j, edge.measured_S_ji_log = ids[n], ids[n + 1], measured
        edge.sqrt_information = np.diag([ROTATION] * 3 + [DIRECTION] * 3 + [1.0])
        optimizer.add_sequential_edge(edge)
    for n, measured in zip(p["anchor_idx"], tangents(p["anchor_R"], p["anchor_c"], 1.0), strict=True):
        anchor = pt.sfm.CrossViewAnchorEdge()
        anchor.variable_view_id, anchor.measured_S_run_in_seg_log, anchor.weight = ids[n], measured, 1.0
        optimizer.add_cross_view_edge(anchor)
    start = time.perf_counter()
    ok, summary = optimizer.optimize()
    seconds = time.perf_counter() - start
    poses = optimizer.variable_poses()
    t = np.array([pt.sfm.Sim3ToRotationTranslationScale(poses[view])[1] for view in ids])
    np.savez(
        answer, seconds=seconds, ok=ok, t=t, initial_cost=summary.initial_cost, cost=summary.final_cost,
        iterations=summary.num_iterations,
    )  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:])
