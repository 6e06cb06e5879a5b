"""Down the cost of a pose graph: Newton steps, damped where they fail, towards the losses that were asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.graph_chain import State, retract
from xalign_ros.core.graph_equations import Equations, Stages, residuals_at
from xalign_ros.core.graph_losses import AS_WIDE_AS_NEEDED, stages
from xalign_ros.core.graph_system import SingularError
from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import MAX_LOG_SCALE, Loss, PoseGraph

TOLERANCE = 3e-7  # predicted decrease over cost, below which nothing is left to gain
NOTHING = 1e-12  # the same, absolute: a millionth of a standard deviation
NEAR = 1e-2  # the same, below which the curvature of robust losses helps rather than leads astray
CHORD = 0.1  # by which a step must shrink what is left, for another with the same matrix
APPROACHES, MOST_APPROACHES = 0.8, 12  # by which residuals shrink while losses are wide, and for how many steps
STAGE_TOLERANCE = 1e-3  # on the way to another loss
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-7, 1e12
TRUSTED_DAMPING = 1e-3  # up to it the predicted decrease is that of the undamped step


@dataclass(frozen=True, slots=True, eq=False)
class Descent:
    """How far down one has come."""

    state: State
    cost: float
    costs: dict[str, float]
    iterations: int
    converged: bool
    gradient_norm: float


def approach(
    equations: Equations, start: Descent, losses: Mapping[str, Loss], held: np.ndarray, budget: int
) -> Descent:
    """Newton steps with losses as wide as the residuals still are, while these shrink by them."""
    wide = {kind: (loss, AS_WIDE_AS_NEEDED) for kind, loss in losses.items()}
    descent, excess = start, _excess(equations, losses)
    while excess > 1 and descent.iterations < min(budget, MOST_APPROACHES):
        if descent is start:
            equations.at(start.state, wide)
        step = _step(equations, descent.state, held, 0.0)
        if step is None:
            break
        state = step[0]
        equations.at(state, wide)
        before, excess = excess, _excess(equations, losses)
        if not excess <= APPROACHES * before:
            break
        descent = replace(descent, state=state, iterations=descent.iterations + 1)
    return descent


def _excess(equations: Equations, losses: Mapping[str, Loss]) -> float:
    """How much wider than its loss the typical residual of a kind is, the worst of all kinds."""
    return max((typical / losses[kind].width for kind, typical in equations.typical.items()), default=0.0)


def path_of(graph: PoseGraph, state: State) -> list[Stages]:
    """The stages of all kinds' losses, the shorter ones waiting at their last."""
    blocks = dict(graph.blocks())
    worst = dict.fromkeys(blocks, 0.0)
    if any(block.loss.name == "gnc_tls" for block in blocks.values()):
        plain = {kind: (Loss(), np.inf) for kind in blocks}
        worst = {k: float((r * r).sum(axis=1).max()) for k, (r, _) in residuals_at(graph, state, plain).items()}
    ways = {kind: stages(block.loss, worst[kind]) for kind, block in blocks.items()}
    length = max((len(way) for way in ways.values()), default=1)
    return [{kind: way[min(n, len(way) - 1)] for kind, way in ways.items()} for n in range(length)]


def descend(
    equations: Equations, start: Descent, stages: Stages, held: np.ndarray, tolerance: float, budget: int
) -> Descent:
    """Levenberg-Marquardt from where the equations stand; damping begins when a step fails (Madsen et al. 2004).

    Near the end the factored matrix is used on, as long as the gradient shrinks by it (chord steps).
    """
    state, cost, damping, iterations, left = start.state, start.cost, 0.0, 0, np.inf
    curved = factored = converged = False
    while iterations < budget and not converged and damping < MOST_DAMPING:
        iterations += 1
        again = factored
        step = _step(equations, state, held, damping, factored)
        enough = 2 * tolerance * cost + NOTHING
        new = near = np.inf
        if step is not None:
            near = step[1] <= NEAR * cost
            new = equations.at(step[0], stages, only_gradient=bool(near))
        if step is not None and new <= cost:
            before = step[1] if not again else left
            state, cost = step[0], new
            left = _promise(equations, state, held) if near and not damping else np.inf
            converged = damping <= TRUSTED_DAMPING and min(step[1], left) <= enough
            factored = bool(near) and not damping and left <= CHORD * before
            damping = damping / 10 if damping > LEAST_DAMPING else 0.0
            if near and not (converged or factored):
                equations.at(state, stages, newton=True)
                curved = True
        else:
            converged = step is not None and damping <= TRUSTED_DAMPING and step[1] <= enough
            damping = damping if curved or again else max(10 * damping, FIRST_DAMPING)
            curved = factored = False
            equations.at(state, stages)
    norm = float(np.linalg.norm(_projected(equations.gradient, state, held)))
    return Descent(state, cost, dict(equations.costs), start.iterations + iterations, converged, norm)


def _step(
    equations: Equations, state: State, held: np.ndarray, damping: float, factored: bool = False
) -> tuple[State, float] | None:
    """The state after a damped Newton step and twice the decrease of cost it promises; None where there is none."""
    free = ~held[:, : equations.d]
    gradient = _projected(equations.gradient, state, held)
    if not factored:
        equations.system.hold(*np.nonzero(~free))
        if damping:
            equations.system.damp(damping)
        try:
            equations.system.factor()
        except SingularError:
            return None
    step = -equations.system.solve(gradient) * free
    promised = -float((step * gradient).sum())
    if not promised >= 0:
        return None
    step = step if equations.d == 7 else np.pad(step, ((0, 0), (0, 1)))
    trial = retract(state, step, equations.local)
    np.clip(trial[2], -MAX_LOG_SCALE, MAX_LOG_SCALE, out=trial[2])
    return trial, promised


def _promise(equations: Equations, state: State, held: np.ndarray) -> float:
    """Twice the decrease of cost that the last factored matrix promises for the gradient as it is now."""
    gradient = _projected(equations.gradient, state, held)
    return float((equations.system.solve(gradient) * gradient).sum())


def _projected(gradient: Array, state: State, held: np.ndarray) -> Array:
    """Without what is held, and without what pushes a log-scale out of its bounds."""
    g = np.where(held[:, : gradient.shape[1]], 0.0, gradient)
    if g.shape[1] == 7:
        sigma = state[2]
        g[((sigma >= MAX_LOG_SCALE) & (g[:, 6] < 0)) | ((sigma <= -MAX_LOG_SCALE) & (g[:, 6] > 0)), 6] = 0
    return g
