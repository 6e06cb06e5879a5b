"""How far a trajectory is from the truth: as it stands in the map, aligned in hindsight, and from pose to pose.

ATE and RPE are those of Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012), alignment is
Umeyama's (PAMI 1991).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from xalign_ros.core.lie import Array, so3_log
from xalign_ros.core.records import Anchor, Rejection
from xalign_ros.core.similarity import fit_similarity
from xalign_ros.core.transforms import SE3

WRONG_M, WRONG_RAD = 0.5, float(np.deg2rad(5.0))


def trajectory_errors(R: Array, t: Array, R_true: Array, t_true: Array, cov: Array | None) -> dict[str, Any]:
    """The figures of N poses R (N, 3, 3), t (N, 3), cov (N, 6, 6) or None in camera axes, beside the true ones.

    m and deg; None where N, or what the positions span, is too little for a figure.
    """
    gap, turn = np.linalg.norm(t - t_true, axis=1), _angle(np.swapaxes(R, 1, 2) @ R_true)
    out: dict[str, Any] = {"not_aligned": _summary(gap, turn)}
    out["wrong"] = int(((gap > WRONG_M) | (turn > WRONG_RAD)).sum())
    out["aligned"] = out["aligned_with_scale"] = out["scale"] = None
    if len(t) >= 3:
        try:
            S = fit_similarity(t, t_true)
        except ValueError:  # all in one place
            pass
        else:
            middle, middle_true = t.mean(axis=0), t_true.mean(axis=0)
            rigid = np.linalg.norm((t - middle) @ S.R.T - (t_true - middle_true), axis=1)
            turned = _angle(np.swapaxes(S.R @ R, 1, 2) @ R_true)
            out["aligned"] = _summary(rigid, turned)
            out["aligned_with_scale"] = _summary(np.linalg.norm(S.apply(t) - t_true, axis=1), turned)
            out["scale"] = S.s
    step, step_true = (_steps(a, b) for a, b in ((R, t), (R_true, t_true)))
    back = np.swapaxes(step_true[0], 1, 2)
    off = np.einsum("nij,nj->ni", back, step[1] - step_true[1])
    out["from_pose_to_pose"] = _summary(np.linalg.norm(off, axis=1), _angle(back @ step[0]))
    if cov is not None and len(t):
        d = np.hstack([so3_log(np.swapaxes(R, 1, 2) @ R_true), np.einsum("nji,nj->ni", R, t_true - t)])
        nees = np.einsum("ni,ni->n", d, np.linalg.solve(cov, d[..., None])[..., 0])
        out["nees_mean"], out["within_2_sigma"] = float(nees.mean()), float((nees < 12.85).mean())  # 95.45 % of chi2(6)
    return out


def anchor_errors(outcomes: Sequence[Anchor | Rejection], truth: Sequence[SE3 | None]) -> dict[str, Any]:
    """How many anchors with a truth were right (within WRONG_M and WRONG_RAD), accepted and refused.

    precision: part of the accepted that is right; recall: part of the right ones that was accepted. None of nothing.
    """
    count: Counter[tuple[bool, bool]] = Counter()
    for outcome, true in zip(outcomes, truth, strict=True):
        found = outcome if isinstance(outcome, Anchor) else outcome.anchor
        if found is not None and true is not None:
            T = found.T_map_cam
            turn = float(_angle(T.R.T @ true.R))
            is_right = float(np.linalg.norm(T.t - true.t)) <= WRONG_M and turn <= WRONG_RAD
            count[isinstance(outcome, Anchor), is_right] += 1
    accepted, right = count[True, True] + count[True, False], count[True, True] + count[False, True]
    return {
        "accepted": accepted,
        "accepted_wrong": count[True, False],
        "refused_right": count[False, True],
        "refused_wrong": count[False, False],
        "precision": count[True, True] / accepted if accepted else None,
        "recall": count[True, True] / right if right else None,
    }


def _steps(R: Array, t: Array) -> tuple[Array, Array]:
    """From each pose to the next, in its axes."""
    back = np.swapaxes(R[:-1], 1, 2)
    return back @ R[1:], np.einsum("nij,nj->ni", back, t[1:] - t[:-1])


def _angle(R: Array) -> Array:
    return np.asarray(np.linalg.norm(so3_log(R), axis=-1))


def _summary(metres: Array, rad: Array) -> dict[str, float] | None:
    if not len(metres):
        return None
    deg = np.rad2deg(rad)
    return {
        "rmse_m": float(np.sqrt((metres**2).mean())),
        "median_m": float(np.median(metres)),
        "p95_m": float(np.percentile(metres, 95)),
        "max_m": float(metres.max()),
        "rmse_deg": float(np.sqrt((deg**2).mean())),
        "median_deg": float(np.median(deg)),
        "max_deg": float(deg.max()),
    }
