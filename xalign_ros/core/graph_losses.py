"""Robust losses: what a squared whitened length costs, and the weight by which reweighted least squares takes it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import Loss

Stage = tuple[Loss, float]  # a loss and the mu of truncated least squares, infinite for the loss itself
AS_WIDE_AS_NEEDED = 0.0  # in place of mu

CONVEXITY = 1.6  # by which mu grows between stages
LAST_MU = 1e3


def weigh(stage: Stage, chi2: Array) -> tuple[Array, Array]:
    """Weights (M,) = rho'(chi2) and costs (M,) = rho(chi2) / 2 of squared whitened lengths chi2 (M,)."""
    (loss, mu), c2 = stage, stage[0].width ** 2
    if loss.name == "huber":
        length = np.sqrt(np.maximum(chi2, c2))
        return loss.width / length, np.where(chi2 <= c2, chi2 / 2, loss.width * (length - loss.width / 2))
    if loss.name == "cauchy":
        return 1 / (1 + chi2 / c2), c2 / 2 * np.log1p(chi2 / c2)
    if loss.name == "geman_mcclure":
        w = c2 / (c2 + chi2)
        return w * w, chi2 * w / 2
    if loss.name == "gnc_tls":
        return _truncated(chi2, c2, mu)
    return np.ones_like(chi2), chi2 / 2


def bend(stage: Stage, chi2: Array, weight: Array) -> Array | None:
    """2 rho''(chi2) (M,), at least what leaves no curvature along the residual: without it steps only creep.

    Triggs et al., "Bundle adjustment - a modern synthesis" (2000), section 4.3.
    """
    (loss, mu), c2 = stage, stage[0].width ** 2
    if loss.name == "none":
        return None
    if loss.name == "cauchy":
        twice = -2 * weight**2 / c2
    elif loss.name == "geman_mcclure":
        twice = -4 * weight / (c2 + chi2)
    else:  # Huber, and truncated least squares between its plateaus, with the least that may be
        flat = chi2 <= (c2 if loss.name == "huber" or np.isinf(mu) else mu / (mu + 1) * c2)
        return np.where(flat, 0.0, -weight / np.maximum(chi2, 1e-300))
    return np.maximum(twice, -weight / np.maximum(chi2, 1e-300))


def _truncated(chi2: Array, c2: float, mu: float) -> tuple[Array, Array]:
    """Yang et al. 2020, equations 11 to 13: quadratic below, constant above, a square root between, convex for mu -> 0."""
    if np.isinf(mu):
        return np.where(chi2 <= c2, 1.0, 0.0), np.minimum(chi2, c2) / 2
    low, high = mu / (mu + 1) * c2, (mu + 1) / mu * c2
    length = np.sqrt(np.clip(chi2, low, high))
    between = 2 * length * np.sqrt(c2 * mu * (mu + 1)) - mu * (c2 + chi2)
    w = np.where(chi2 <= low, 1.0, np.where(chi2 >= high, 0.0, np.sqrt(c2 * mu * (mu + 1)) / length - mu))
    return w, np.where(chi2 <= low, chi2, np.where(chi2 >= high, c2, between)) / 2


def stages(loss: Loss, worst: float) -> list[Stage]:
    """On the way to `loss` from a start whose largest chi2 is `worst`: truncated least squares from its convex surrogate on."""
    if loss.name != "gnc_tls" or worst <= loss.width**2:
        return [(loss, np.inf)]
    mu, path = loss.width**2 / max(2 * worst - loss.width**2, 1e-300), []
    while mu < LAST_MU:
        path.append((loss, mu))
        mu *= CONVEXITY
    return [*path, (loss, np.inf)]


def widened(loss: Loss, typical: float) -> Stage:
    """The loss as wide as the median whitened length: a start that is off everywhere has no outliers yet."""
    name = "huber" if loss.name == "huber" else "cauchy"
    return (replace(loss, name=name, width=typical) if typical > loss.width else loss), np.inf
