"""Down the cost of a pose graph: Newton steps, damped where they fail, towards the losses that were asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.graph_band import SingularError
from xalign_ros.core.graph_chain import State, retract
from xalign_ros.core.graph_equations import Equations, Stages, residuals_at
from xalign_ros.core.graph_losses import AS_WIDE_AS_NEEDED, stages
from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import MAX_LOG_SCALE, Loss, PoseGraph

TOLERANCE = 3e-7  # predicted decrease over cost, below which nothing is left to gain
NOTHING = 1e-12  # the same, absolute: a millionth of a standard deviation
NEAR = 1e-2  # the same, below which the curvature of robust losses helps rather than leads astray
CHORD = 0.1  # by which a step must shrink what is left, for another with the same matrix
APPROACHES, MOST_APPROACHES = 0.8, 12  # by which residuals shrink while losses are wide, and for how many steps
STAGE_TOLERANCE = 1e-3  # on the way to another loss
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-7, 1e12
TRUSTED_DAMPING = 1e-3  # up to it a damped step's promise is believed, where no undamped step can be had
SHORTEST = 1 / 8  # of an undamped step that overshoots, before it is damped


@dataclass(frozen=True, slots=True, eq=False)
class Descent:
    """How far down one has come."""

    state: State
    cost: float
    costs: dict[str, float]
    iterations: int
    converged: bool
    gradient_norm: float


def approach(equations: Equations, start: Descent, final: Stages, held: np.ndarray, budget: int) -> Descent:
    """Newton steps with losses as wide as the residuals still are, while these shrink by them; then back to `final`."""
    wide = {kind: (loss, AS_WIDE_AS_NEEDED) for kind, (loss, _) in final.items()}
    descent, excess = start, _excess(equations, final)
    equations.at(start.state, wide)
    while excess > 1 and descent.iterations < min(budget, MOST_APPROACHES):
        step = _step(equations, descent.state, held, 0.0)
        if step is None:
            break
        equations.at(step[0], wide)
        before, excess = excess, _excess(equations, final)
        if not excess <= max(1.0, APPROACHES * before):
            break
        descent = replace(descent, state=step[0], iterations=descent.iterations + 1)
    # A loss that is wide enough already was not widened.
    cost = equations.at(descent.state, final) if excess > 1 else sum(equations.costs.values())
    return replace(descent, cost=cost)


def _excess(equations: Equations, final: Stages) -> float:
    """How much wider than its loss the typical residual of a kind is, the worst of all kinds."""
    return max((typical / final[kind][0].width for kind, typical in equations.typical.items()), default=0.0)


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

    But first it is shortened: of a long chain damping stops the soft directions, where most is to gain, and what little
    such a step promises is no sign of an end.
    Near the end the factored matrix is used on, as long as the gradient shrinks by it (chord steps).
    """
    state, cost, damping, iterations, last = start.state, start.cost, 0.0, 0, np.inf
    curved = factored = converged = singular = False
    length = 1.0
    while iterations < budget and not converged and damping < MOST_DAMPING:
        iterations += 1
        step = _step(equations, state, held, damping, factored, length)
        singular = singular if damping else step is None
        again, new, near, chord = factored, np.inf, False, False
        if step is not None:
            near = step[1] <= NEAR * cost
            chord = factored or (near and not damping and length == 1 and step[1] <= CHORD**2 * last)
            new = equations.at(step[0], stages, newton=near, only_gradient=chord)
            trusted = not damping or (singular and damping <= TRUSTED_DAMPING)
            converged = trusted and step[1] <= 2 * tolerance * cost + NOTHING
        if step is not None and new <= cost:
            state, cost, last, curved = step[0], new, step[1], near
            damping, length = damping / 10 if damping > LEAST_DAMPING else 0.0, 1.0
            if chord and not converged:
                left = _promise(equations, state, held)
                converged, factored = left <= 2 * tolerance * cost + NOTHING, left <= CHORD * last
                if not (converged or factored):
                    equations.at(state, stages, newton=True)
        else:
            if step is not None and not (curved or again or damping) and length > SHORTEST:
                length /= 2
            elif not (curved or again):
                damping, length = max(10 * damping, FIRST_DAMPING), 1.0
            last, curved, factored = np.inf, False, False
            equations.at(state, stages)
    norm = float(np.linalg.norm(_projected(equations.gradient, state, held)))
    return Descent(state, cost, dict(equations.costs), start.iterations + iterations, converged, norm)


def _step(
    equations: Equations, state: State, held: np.ndarray, damping: float, factored: bool = False, length: float = 1.0
) -> tuple[State, float] | None:
    """The state after `length` of a damped Newton step and twice the decrease of cost that the whole step promises.

    None where there is none.
    """
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
    trial = retract(state, length * step, equations.local)
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
