"""The vocabulary and its inverted file: what is in it, what it finds of what exhaustive search finds, and the odd sizes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xalign_ros.core.descriptors import nearest
from xalign_ros.core.records import Norm
from xalign_ros.core.vocabulary import Vocabulary


def descriptors(norm: Norm, count: int, seed: int = 0, width: int = 32) -> np.ndarray:
    """Fifty kinds of things, each seen in its own way every time."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(0, 50, count)
    if norm is Norm.HAMMING:
        kinds = np.random.default_rng(99).integers(0, 256, (50, width), np.uint8)
        return kinds[kind] ^ np.packbits(rng.random((count, 8 * width)) < 0.15, axis=1)
    x = np.random.default_rng(99).uniform(0, 150, (50, width))[kind] + 25 * rng.normal(size=(count, width))
    return np.clip(x, 0, 255).astype(np.uint8) if norm is Norm.L2_UINT8 else x.astype(np.float32)


def seen_again(x: np.ndarray, norm: Norm, seed: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if norm is Norm.HAMMING:
        return x ^ np.packbits(rng.random((len(x), 8 * x.shape[1])) < 0.05, axis=1)
    y = x + 5 * rng.normal(size=x.shape)
    return np.clip(y, 0, 255).astype(np.uint8) if norm is Norm.L2_UINT8 else y.astype(np.float32)


@pytest.mark.parametrize("norm", Norm)
def test_every_point_is_in_one_word(norm):
    x = descriptors(norm, 5000)
    v = Vocabulary.learn(x, norm)
    assert sorted(v.word_point.tolist()) == list(range(5000))
    assert v.word_offset[0] == 0 and v.word_offset[-1] == 5000 and (np.diff(v.word_offset) >= 0).all()
    assert len(v.word_offset) == v.fine.shape[0] * v.fine.shape[1] + 1
    assert np.diff(v.word_offset).max() < 1000  # the words divide the points


@pytest.mark.parametrize("norm", Norm)
def test_what_is_seen_again_is_found_by_its_word(norm):
    """95 of 100 at least of the nearest points that exhaustive search finds, with their true distances, nearest first."""
    x = descriptors(norm, 5000)
    v = Vocabulary.learn(x, norm)
    query = seen_again(x[::25], norm)
    best, distance = nearest(query, x, norm, 1)
    rows, points, d = v.nearest(query, x, norm, 2)
    first = np.r_[True, np.diff(rows) > 0]
    assert (points[first] == best[rows[first], 0]).mean() > 0.95
    same = points[first] == best[rows[first], 0]
    np.testing.assert_allclose(d[first][same], distance[rows[first], 0][same], rtol=1e-3, atol=1e-4)
    assert (np.bincount(rows, minlength=len(query)) <= 2).all() and (d[~first] >= d[np.flatnonzero(~first) - 1]).all()


@pytest.mark.parametrize("norm", Norm)
@settings(max_examples=25, deadline=None)
@given(count=st.integers(1, 400), width=st.integers(1, 9), asked=st.integers(0, 30), seed=st.integers(0, 5))
def test_any_size_of_map_gives_back_its_own(norm, count, width, asked, seed):
    """A map so small that every word is probed: a point's own descriptor is found, at distance zero."""
    x = descriptors(norm, count, seed, width if norm is Norm.HAMMING else 8 * width)
    v = Vocabulary.learn(x, norm)
    query = x[np.random.default_rng(seed).integers(0, count, asked)]
    rows, _, d = v.nearest(query, x, norm, 2)
    first = np.r_[True, np.diff(rows) > 0][: len(rows)]
    assert np.array_equal(rows[first], np.arange(asked))
    np.testing.assert_allclose(d[first], 0, atol=1e-3)


def test_the_same_descriptors_give_the_same_vocabulary():
    x = descriptors(Norm.L2_FLOAT32, 3000)
    a, b = (Vocabulary.learn(x, Norm.L2_FLOAT32) for _ in range(2))
    for name in Vocabulary.__slots__:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
