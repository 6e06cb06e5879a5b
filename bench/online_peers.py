"""What one robust method alone makes of the same worlds: a sliding window of 100 keyframes, solved anew at every anchor.

Each starts at the first anchor, which it believes whatever it is, and is told the scale there to 5 %; ours is told nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from online_worlds import ANCHOR_ROTATION, ANCHOR_TRANSLATION, SIGMA_ROTATION, SIGMA_TRANSLATION, World

from xalign_ros.core import lie
from xalign_ros.core.graph import Solution, solve
from xalign_ros.core.graph_residuals import linearize
from xalign_ros.core.lie import Array
from xalign_ros.core.pose_graph import Anchors, Chart, Loss, OdometryEdges, PoseGraph

WINDOW = 100
GATE_6 = 16.81  # chi-square, 6 degrees of freedom, 99 %
NOTHING = 1e-9  # weight of an anchor that is set aside


Policy = Callable[["SlidingWindow"], Array]  # moves the window's nodes; the weights (M,) of its anchors


class SlidingWindow:
    """Nodes `first` .. `last` of a world, a prior on the first, and the weights that a policy gives the anchors."""

    def __init__(self, w: World, policy: Policy) -> None:
        self.w, self.policy = w, policy
        self.first = self.last = 0
        self.R, self.t, self.s = w.R_a[:1].copy(), w.t_a[:1].copy(), np.exp(w.sigma[:1])
        steps = np.linalg.norm(w.t_z, axis=1)
        self.sigmas = np.c_[
            np.full((len(steps), 3), SIGMA_ROTATION), np.repeat(SIGMA_TRANSLATION * steps[:, None], 3, axis=1),
            np.full(len(steps), w.walk),
        ]  # fmt: skip
        information = np.zeros((7, 7))
        information[range(6), range(6)] = np.repeat([ANCHOR_ROTATION, ANCHOR_TRANSLATION], 3) ** -2.0
        self.anchor_information = information
        start = np.diag(np.r_[np.diag(information)[:6] / [1, 1, 1, *[self.s[0] ** -2] * 3], 0.05**-2])
        self.prior: Anchors | None = Anchors([0], self.R, self.t, self.s, start[None], Chart.LOG)
        self.accepted: dict[int, float] = {}
        self.agree: dict[tuple[int, int], bool] = {}

    @property
    def anchors(self) -> np.ndarray:
        """Numbers of the anchors in the window; the first of all is the prior."""
        return np.flatnonzero((self.w.at >= max(self.first, 1)) & (self.w.at <= self.last))

    def graph(self, weights: Array, loss: Loss, with_prior: bool = True) -> PoseGraph:
        w, m = self.w, self.anchors
        n = np.arange(self.last - self.first)
        part = slice(self.first, self.last)
        anchors = Anchors(
            w.at[m] - self.first, w.R_a[m], w.t_a[m], np.ones(len(m)),
            np.maximum(weights, NOTHING)[:, None, None] * self.anchor_information, loss=loss,
        )  # fmt: skip
        odometry = OdometryEdges(n, n + 1, w.R_z[part], w.t_z[part], self.sigmas[part])
        prior = self.prior if with_prior else None
        return PoseGraph(
            np.arange(len(self.t)), self.R, self.t, self.s, odometry=odometry, anchors=anchors, priors=prior
        )

    def take(self, solution: Solution) -> None:
        self.R, self.t, self.s = solution.R, solution.t, solution.s

    def chi2(self, R: Array | None = None, t: Array | None = None) -> Array:
        """Of the anchors in the window, unweighted."""
        w, m = self.w, self.anchors
        R, t = (self.R, self.t) if R is None or t is None else (R, t)
        k = w.at[m] - self.first
        Rt = np.swapaxes(w.R_a[m], 1, 2)
        r = np.c_[lie.so3_log(Rt @ R[k]), np.einsum("nij,nj->ni", Rt, t[k] - w.t_a[m])]
        return np.asarray((r**2 * np.diag(self.anchor_information)[:6]).sum(axis=1))

    def step(self, k: int) -> None:
        """Keyframe k by odometry, and what the policy makes of its anchor."""
        z = k - 1
        self.R = np.concatenate([self.R, (self.R[-1] @ self.w.R_z[z])[None]])
        self.t = np.concatenate([self.t, (self.t[-1] + self.s[-1] * self.R[-2] @ self.w.t_z[z])[None]])
        self.s, self.last = np.r_[self.s, self.s[-1]], k
        if k not in self.w.at:
            return
        anchors, weights = self.anchors, self.policy(self)
        while len(self.t) > WINDOW:
            self._leave(dict(zip(anchors, weights, strict=True)))

    def _leave(self, weights: dict[int, float]) -> None:
        """The first node's marginal becomes the prior of the second."""
        nodes = self.R[:2], self.t[:2], np.log(self.s[:2])
        one, two = (tuple(x[:1] for x in nodes), tuple(x[1:] for x in nodes))
        H, g = 1e-9 * np.eye(14), np.zeros(14)
        blocks: list[tuple[Anchors, float]] = [(self.prior, 1.0)] if self.prior is not None else []
        for m, weight in weights.items():
            if self.w.at[m] == self.first:
                blocks.append(
                    (Anchors([0], self.w.R_a[[m]], self.w.t_a[[m]], [1.0], self.anchor_information[None]), weight)
                )
        for block, weight in blocks:
            r, J, _ = linearize(block, one, None)
            omega = weight * block.information[0]
            H[:7, :7] += J[0].T @ omega @ J[0]
            g[:7] += J[0].T @ omega @ r[0]
        f = self.first
        edge = OdometryEdges([0], [1], self.w.R_z[[f]], self.w.t_z[[f]], self.sigmas[[f]])
        r, J_i, J_j = linearize(edge, one, two)
        assert J_j is not None
        J = np.c_[J_i[0], J_j[0]] / self.sigmas[f][:, None]
        H += J.T @ J
        g += J.T @ (r[0] / self.sigmas[f])
        rest = np.linalg.solve(H[:7, :7], np.c_[H[:7, 7:], g[:7]])
        H_1, g_1 = H[7:, 7:] - H[7:, :7] @ rest[:, :7], g[7:] - H[7:, :7] @ rest[:, 7]
        R, t, s = lie.sim3_exp(-np.linalg.solve(H_1 + 1e-9 * np.eye(7), g_1)[None])
        mean = two[0] @ R, two[1] + self.s[1] * np.einsum("nij,nj->ni", two[0], t), self.s[1:2] * s
        self.prior = Anchors([0], *mean, (H_1 + H_1.T)[None] / 2, Chart.LOG)
        self.R, self.t, self.s, self.first = self.R[1:], self.t[1:], self.s[1:], self.first + 1


def m_estimator(loss: Loss) -> Policy:
    def policy(window: SlidingWindow) -> Array:
        if not len(window.anchors):
            return np.zeros(0)
        solution = solve(window.graph(np.ones(len(window.anchors)), loss), max_iterations=30)
        window.take(solution)
        return solution.weights["anchors"]

    return policy


def dcs(window: SlidingWindow, phi: float = 5.0, rounds: int = 6) -> Array:
    """Dynamic covariance scaling (Agarwal et al. 2013), reweighted."""
    weights = np.zeros(0)
    for _ in range(rounds):
        weights = np.minimum(1, 2 * phi / (phi + window.chi2())) ** 2
        if len(weights):
            window.take(solve(window.graph(weights, Loss()), max_iterations=2))
    return weights


def consistent(window: SlidingWindow, i: int, j: int) -> bool:
    """Whether the odometry leads from one anchor to the other (Mangelson et al. 2018), under the window's scale."""
    key = (min(i, j), max(i, j))
    if key not in window.agree:
        w, (a, b) = window.w, key
        steps, s = int(w.at[b] - w.at[a]), float(np.median(window.s))
        R, t = np.eye(3), np.zeros(3)
        for z in range(w.at[a], w.at[b]):
            t, R = t + s * R @ w.t_z[z], R @ w.R_z[z]
        off = lie.so3_log(R.T @ w.R_a[a].T @ w.R_a[b])
        gap = w.R_a[a].T @ (w.t_a[b] - w.t_a[a]) - t
        length = float(np.linalg.norm(t))
        along = float(gap @ t) / max(length, 1e-9)
        rotation = 2 * ANCHOR_ROTATION**2 + steps * SIGMA_ROTATION**2
        across = (
            2 * ANCHOR_TRANSLATION**2
            + steps * SIGMA_TRANSLATION**2
            + length**2 * (ANCHOR_ROTATION**2 + steps / 3 * SIGMA_ROTATION**2)
        )
        scale = across + length**2 * (steps * w.walk**2 / 3 + 0.03**2)
        chi2 = off @ off / rotation + (gap @ gap - along**2) / across + along**2 / scale
        window.agree[key] = bool(chi2 < GATE_6)
    return window.agree[key]


def largest_clique(n: int, agree: Callable[[int, int], bool], tries: int = 4000) -> list[int]:
    """By branch and bound over bit sets."""
    near = [sum(1 << j for j in range(n) if j != i and agree(i, j)) for i in range(n)]
    best, count = 0, 0

    def grow(clique: int, candidates: int) -> None:
        nonlocal best, count
        count += 1
        if clique.bit_count() > best.bit_count():
            best = clique
        while candidates and count < tries and clique.bit_count() + candidates.bit_count() > best.bit_count():
            i = max((k for k in range(n) if candidates >> k & 1), key=lambda k: (near[k] & candidates).bit_count())
            grow(clique | 1 << i, candidates & near[i])
            candidates &= ~(1 << i)

    grow(0, (1 << n) - 1)
    return [i for i in range(n) if best >> i & 1]


def pcm(window: SlidingWindow) -> Array:
    m = window.anchors
    keep = largest_clique(len(m), lambda i, j: consistent(window, m[i], m[j]))
    chosen = np.isin(np.arange(len(m)), keep).astype(float)
    if not len(m):
        return chosen
    solution = solve(window.graph(chosen, Loss("huber", 1.345)), max_iterations=30)
    window.take(solution)
    return np.asarray(chosen * solution.weights["anchors"])


def _gate(window: SlidingWindow, chosen: Array) -> float:
    """Squared Mahalanobis length of the newest anchor against the prediction of the others."""
    graph = window.graph(np.r_[chosen[:-1], 0.0], Loss())
    solution = solve(graph, marginals=True, max_iterations=1)
    assert solution.cov is not None
    D = np.r_[np.ones(3), np.full(3, window.s[-1])]
    predicted = D[:, None] * solution.cov[-1, :6, :6] * D
    w, m = window.w, window.anchors[-1]
    Rt = w.R_a[m].T
    r = np.r_[lie.so3_log(Rt @ window.R[-1]), Rt @ (window.t[-1] - w.t_a[m])]
    return float(r @ np.linalg.solve(predicted + np.diag(1 / np.diag(window.anchor_information)[:6]), r))


def _settle(window: SlidingWindow, chosen: Array) -> Array:
    solution = solve(window.graph(chosen, Loss("huber", 2.0)), max_iterations=30)
    window.take(solution)
    return np.asarray(chosen * solution.weights["anchors"])


def gate_and_relock(window: SlidingWindow, relock: int = 4) -> Array:
    """A gate on the prediction; a clique of gated anchors that outnumbers those accepted since it began reopens it."""
    m, accepted = window.anchors, window.accepted
    if not len(m):
        return np.zeros(0)
    newest = m[-1]
    accepted[newest] = float(_gate(window, np.array([accepted.get(k, 0.0) for k in m])) < 1.3 * GATE_6)
    if not accepted[newest]:
        waiting = [k for k in m if not accepted.get(k) and (k == newest or consistent(window, k, newest))]
        clique = [
            waiting[i] for i in largest_clique(len(waiting), lambda i, j: consistent(window, waiting[i], waiting[j]))
        ]
        if len(clique) >= relock and len(clique) > sum(accepted.get(k, 0.0) for k in m if k >= min(clique)):
            accepted.update({k: float(k in clique) for k in m if k >= min(clique)})
            if window.prior is not None:
                window.prior = replace(window.prior, information=1e-3 * window.prior.information)
    return _settle(window, np.array([accepted.get(k, 0.0) for k in m]))


def majority(cap: float) -> Policy:
    """The gate, and a challenge by all waiting anchors on their own once they outnumber the accepted (at most `cap`)."""

    def policy(window: SlidingWindow) -> Array:
        m, accepted = window.anchors, window.accepted
        if not len(m):
            return np.zeros(0)
        chosen = np.array([accepted.get(k, 0.0) for k in m])
        chosen[-1] = accepted[m[-1]] = float(_gate(window, chosen) < 1.5 * GATE_6)
        waiting = chosen == 0
        incumbents = min(chosen.sum() + 1, cap)
        if not chosen[-1] and waiting.sum() >= 3 and waiting.sum() > incumbents:
            graph = window.graph(waiting.astype(float), Loss("cauchy", 2.0), with_prior=False)
            challenge = solve(_onto(graph, window), max_iterations=30)
            chi2 = window.chi2(challenge.R, challenge.t)
            fit = (chi2 < 1.5 * GATE_6) & waiting
            if fit[-1] and fit.sum() >= 3 and fit.sum() > incumbents:
                accepted.update({k: float(c < 1.5 * GATE_6) for k, c in zip(m, chi2, strict=True)})
                window.prior = None
                window.take(challenge)
                chosen = np.array([accepted.get(k, 0.0) for k in m])
        weights = _settle(window, chosen)
        for k, c in zip(m, window.chi2(), strict=True):
            accepted[k] = 1.0 if c < GATE_6 else 0.0 if c > 4 * GATE_6 else accepted.get(k, 0.0)
        return weights

    return policy


def _onto(graph: PoseGraph, window: SlidingWindow) -> PoseGraph:
    """The window moved rigidly so that its newest pose is the newest anchor's."""
    m = window.anchors[-1]
    R = window.w.R_a[m] @ graph.R[-1].T
    return replace(graph, R=R @ graph.R, t=(graph.t - graph.t[-1]) @ R.T + window.w.t_a[m])


PEERS: dict[str, Policy] = {
    "Huber": m_estimator(Loss("huber", 1.345)),
    "Cauchy": m_estimator(Loss("cauchy", 2.0)),
    "GNC-TLS": m_estimator(Loss("gnc_tls", float(np.sqrt(GATE_6)))),
    "DCS": dcs,
    "PCM": pcm,
    "relock4": gate_and_relock,
    "majority": majority(np.inf),
    "cap 8": majority(8),
}


def drive(w: World, policy: Policy) -> Array:
    """Positions (N, 3), each as it was known at its own keyframe."""
    window = SlidingWindow(w, policy)
    found = [window.t[-1]]
    for k in range(1, len(w.t)):
        window.step(k)
        found.append(window.t[-1])
    return np.array(found)
