"""A small reconstruction by pyTheia's names, moved into another frame, and what ties the two."""

import numpy as np

import xalign_ros.compat.pytheia as pt
from xalign_ros.core.lie import so3_exp


def reconstruction(count=5, seed=0, first_name=0):
    """Cameras on a winding walk, world to camera, with a track seen by each two neighbours."""
    rng = np.random.default_rng(seed)
    recon = pt.sfm.Reconstruction()
    for n in range(count):
        view = recon.View(recon.AddView(f"{first_name + n}", float(n)))
        view.SetIsEstimated(True)
        view.Camera().SetPosition([n, np.sin(n), 0.1 * n])
        view.Camera().SetOrientationFromRotationMatrix(so3_exp(rng.normal(0, 0.3, 3)))
    for n in range(count - 1):
        track = recon.AddTrack()
        recon.Track(track).SetPoint([n, 1, 5, 1])
        recon.Track(track).SetIsEstimated(True)
        for view in (n, n + 1):
            assert recon.AddObservation(view, track)
    return recon


def moved(recon, R, t):
    """The same in another frame: x' = R x + t."""
    other = reconstruction(recon.NumViews())
    for k in recon.ViewIds():
        old, new = recon.View(k).Camera(), other.View(k).Camera()
        new.SetPosition(R @ old.GetPosition() + t)
        new.SetOrientationFromRotationMatrix(old.GetOrientationAsRotationMatrix() @ R.T)
    return other


def constraints(recon, target, anchored=(0, 2, 4)):
    c = pt.sfm.CrossReconstructionConstraints()
    c.variable_keyframe_view_ids = recon.ViewIds()
    for i, j in zip(recon.ViewIds()[:-1], recon.ViewIds()[1:], strict=True):
        edge = pt.sfm.SequentialSim3Edge()
        edge.view_id_i, edge.view_id_j = i, j
        edge.measured_S_ji_log = pt.sfm.RelativeSim3BetweenViews(recon.View(i), recon.View(j))
        c.sequential_edges.append(edge)
    for k in anchored:
        anchor = pt.sfm.CrossViewAnchorEdge()
        anchor.variable_view_id, anchor.measured_S_run_in_seg_log = k, pt.sfm.GetSim3LieFromView(target.View(k))
        c.cross_view_edges.append(anchor)
    return c
