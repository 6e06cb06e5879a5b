"""The multifrontal factor against dense matrices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xalign_ros.core import graph_fronts
from xalign_ros.core.graph_band import SingularError
from xalign_ros.core.graph_fronts import Fronts


def filled(nodes, d, pairs, rng):
    """Fronts and the dense matrix that they hold, which is positive definite."""
    keys = np.unique([min(p) * nodes + max(p) for p in pairs]).astype(np.int64)
    fronts = Fronts(nodes, d, keys)
    H = np.zeros((nodes, d, nodes, d))
    for k in range(nodes):
        A = rng.normal(size=(d, d))
        H[k, :, k] = A @ A.T
    i, j = np.divmod(keys, nodes)
    swapped = fronts.swapped(i, j)
    i, j = np.where(swapped, j, i), np.where(swapped, i, j)
    blocks = rng.normal(size=(len(keys), d, d))
    for a, b, block in zip(i, j, blocks, strict=True):
        H[b, :, a], H[a, :, b] = block, block.T
    H = H.reshape(nodes * d, nodes * d)
    H += np.diag(np.abs(H).sum(axis=1))
    u, v = np.tril_indices(d)
    own = H.reshape(nodes, d, nodes, d)[np.arange(nodes), :, np.arange(nodes)]
    fronts.flat[fronts.diagonal(np.arange(nodes))] = own[:, u, v]
    fronts.flat[fronts.lower(i * nodes + j)] = blocks.reshape(len(keys), d * d)
    return fronts, H


def check(fronts, H, nodes, d, rng) -> None:
    g = rng.normal(size=(nodes, d))
    fronts.factor()
    np.testing.assert_allclose(fronts.solve(g).ravel(), np.linalg.solve(H, g.ravel()), atol=1e-10)
    inverse = np.linalg.inv(H).reshape(nodes, d, nodes, d)[np.arange(nodes), :, np.arange(nodes)]
    np.testing.assert_allclose(fronts.marginals(), inverse, atol=1e-10)


@given(st.integers(0, 10**6), st.integers(1, 40), st.integers(0, 80), st.sampled_from([2, 6, 7]))
def test_any_graph(seed, nodes, edges, d) -> None:
    rng = np.random.default_rng(seed)
    pairs = [p for p in rng.integers(0, nodes, (edges, 2)).tolist() if p[0] != p[1]]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graph_fronts, "WORTH", float(rng.choice([0, 3e3, 3e5])))
        fronts, H = filled(nodes, d, pairs, rng)
    check(fronts, H, nodes, d, rng)


def test_a_long_loop_loses_no_fill() -> None:
    rng, nodes = np.random.default_rng(0), 500
    fronts, H = filled(nodes, 2, [(k, (k + 1) % nodes) for k in range(nodes)], rng)
    check(fronts, H, nodes, 2, rng)


def test_damped_and_held_numbers() -> None:
    rng, nodes, d = np.random.default_rng(1), 20, 3
    fronts, H = filled(nodes, d, [(k, (k * 7 + 1) % nodes) for k in range(nodes) if (k * 7 + 1) % nodes != k], rng)
    fronts.damp(0.5)
    fronts.hold(np.array([4]), np.array([1]))
    fronts.factor()
    g = rng.normal(size=(nodes, d))
    free = np.arange(nodes * d) != 4 * d + 1
    damped = (H + 0.5 * np.diag(np.diag(H)))[np.ix_(free, free)]
    found = fronts.solve(g).ravel()
    np.testing.assert_allclose(found[free], np.linalg.solve(damped, g.ravel()[free]), atol=1e-10)
    assert abs(found[~free]) < 1e-15


def test_an_open_direction_is_said() -> None:
    fronts, _ = filled(5, 2, [(0, 1), (1, 2), (2, 3), (3, 4)], np.random.default_rng(2))
    fronts.clear()
    with pytest.raises(SingularError):
        fronts.factor()
