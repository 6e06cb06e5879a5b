"""Distances and nearest neighbours against brute force, for all four norms; the medoid."""

import numpy as np
import pytest

from xalign_ros.core import kernels
from xalign_ros.core.descriptors import nearest, nearest_to_mean, pair_distance
from xalign_ros.core.records import Norm

every_norm = pytest.mark.parametrize("norm", list(Norm), ids=lambda n: n.name)


def some(norm, count, rng, width=32):
    if norm.dtype is np.uint8:
        return rng.integers(0, 256, (count, width), np.uint8)
    x = rng.normal(size=(count, width)).astype(np.float32)
    return x / np.linalg.norm(x, axis=1, keepdims=True) if norm is Norm.L2_FLOAT32 else 3 * x


def brute(a, b, norm):
    """All distances (N, M), one definition per norm, in double precision."""
    if norm is Norm.HAMMING:
        return np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2).astype(float)
    x, y = a.astype(float)[:, None], b.astype(float)[None]
    if norm is Norm.COSINE_FLOAT32:
        return 1 - (x * y).sum(2) / np.linalg.norm(x, axis=2) / np.linalg.norm(y, axis=2)
    return np.sqrt(((x - y) ** 2).sum(2))


@every_norm
@pytest.mark.parametrize("width", [32, 61, 6])  # FREAK and AKAZE: widths that are no whole machine words
def test_pair_distance_against_brute_force(norm, width):
    rng = np.random.default_rng(1)
    a, b = some(norm, 50, rng, width), some(norm, 50, rng, width)
    np.testing.assert_allclose(pair_distance(a, b, norm), np.diag(brute(a, b, norm)), rtol=1e-5, atol=1e-6)
    assert pair_distance(a[:0], b[:0], norm).shape == (0,)


@every_norm
@pytest.mark.parametrize("width", [32, 61, 6])
def test_distances_of_candidates_against_brute_force(norm, width):
    """All features lie where all points are expected; the distance alone decides."""
    rng = np.random.default_rng(2)
    a, b, at = some(norm, 40, rng, width), some(norm, 70, rng, width), np.array([3, 69, 8])
    every, gate = brute(a, b[at], norm), float(np.median(brute(a, b, norm)))
    uv, centre, S = rng.uniform(0, 9, (40, 2)), np.zeros((3, 2)), np.tile([400.0, 0, 400], (3, 1))
    feature, point, distance = kernels.candidates(norm, uv, a, centre, S, at, b, 3.0, 100.0, gate)
    column = np.array([at.tolist().index(p) for p in point])
    np.testing.assert_allclose(distance, every[feature, column], rtol=1e-5, atol=1e-6)
    assert len(distance) == (every <= gate).sum() and len(distance) < every.size


def test_hamming_counts_bits_by_hand():
    a = np.array([[0, 0], [255, 1], [0b1010, 0]], np.uint8)
    b = np.array([[0, 0], [0, 0], [0b0110, 0]], np.uint8)
    assert pair_distance(a, b, Norm.HAMMING).tolist() == [0, 9, 2]


def test_a_bit_is_a_bit_and_not_a_number():
    """As bits 127 is next to 255, as a number next to 128."""
    query, train = np.array([[127]], np.uint8), np.array([[255], [128]], np.uint8)
    assert nearest(query, train, Norm.HAMMING, 1)[0].item() == 0
    assert nearest(query, train, Norm.L2_UINT8, 1)[0].item() == 1


@every_norm
@pytest.mark.parametrize("count", [1, 2, 4])
def test_nearest_against_brute_force(norm, count):
    rng = np.random.default_rng(2)
    query, train = some(norm, 600, rng), some(norm, 300, rng)  # more queries than one block
    index, distance = nearest(query, train, norm, count)
    assert index.shape == distance.shape == (600, count)
    D = brute(query, train, norm)
    np.testing.assert_allclose(distance, np.sort(D, axis=1)[:, :count], rtol=1e-4, atol=2e-3)
    np.testing.assert_allclose(np.take_along_axis(D, index, 1), distance, rtol=1e-4, atol=2e-3)
    assert all(len(set(row)) == count for row in index.tolist())


@every_norm
def test_nearest_finds_itself(norm):
    train = some(norm, 40, np.random.default_rng(3), 128)
    index, distance = nearest(train, train, norm, 1)
    assert index[:, 0].tolist() == list(range(40))
    np.testing.assert_allclose(distance, 0, atol=0.5 if norm is Norm.L2_UINT8 else 2e-3)


@every_norm
def test_nearest_gives_no_more_than_there_are(norm):
    rng = np.random.default_rng(4)
    index, distance = nearest(some(norm, 5, rng), some(norm, 3, rng), norm, 10)
    assert index.shape == distance.shape == (5, 3)
    assert sorted(index[0].tolist()) == [0, 1, 2]
    index, distance = nearest(some(norm, 5, rng), some(norm, 1, rng), norm, 2)
    assert index.tolist() == [[0]] * 5


@every_norm
def test_nearest_twice_is_the_same(norm):
    rng = np.random.default_rng(5)
    query, train = some(norm, 100, rng), some(norm, 80, rng)
    first, second = nearest(query, train, norm, 3), nearest(query, train, norm, 3)
    assert np.array_equal(first[0], second[0]) and np.array_equal(first[1], second[1])


@every_norm
def test_the_descriptor_nearest_to_the_mean(norm):
    """Groups of any order and size, each around a centre: against one at a time."""
    rng = np.random.default_rng(6)
    group = np.r_[np.arange(7), rng.integers(0, 7, 60)]
    rng.shuffle(group)
    descriptors = some(norm, 7, rng)[group]
    if norm is Norm.HAMMING:
        descriptors = descriptors ^ np.packbits(rng.random((len(group), 256)) < 0.1, axis=1)
    else:
        descriptors = (descriptors + rng.integers(0, 3, descriptors.shape)).astype(norm.dtype)
    values = np.unpackbits(descriptors, axis=1) if norm is Norm.HAMMING else descriptors
    rows = nearest_to_mean(descriptors, group, 7, norm)
    for g, row in enumerate(rows):
        members = np.flatnonzero(group == g)
        x = values[members].astype(float)
        off = ((x - x.mean(axis=0)) ** 2).sum(axis=1)
        assert group[row] == g
        assert off[members.tolist().index(row)] == pytest.approx(off.min(), rel=1e-5)


def test_the_medoid_by_hand():
    """Of 0000, 0001, 0011 the middle one; of a single descriptor that one."""
    descriptors = np.array([[0b0000], [0b1111], [0b0011], [0b0001]], np.uint8)
    assert nearest_to_mean(descriptors, np.array([0, 1, 0, 0]), 2, Norm.HAMMING).tolist() == [3, 1]
