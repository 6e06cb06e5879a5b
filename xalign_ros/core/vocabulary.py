"""A vocabulary learned on a map's own descriptors, and its inverted file: nearest map points without looking at them all.

Two levels of k-means (Nister and Stewenius, CVPR 2006) over descriptors as vectors, bits as 0 and 1. What the probed words
hold is compared by code (Hamming embedding, Jegou et al., ECCV 2008): a binary descriptor is its own code, a float one has
a bit for its side of each of CODE_BITS random planes (Charikar, STOC 2002).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xalign_ros.core.descriptors import columns, differing_bits, pair_distance, unit
from xalign_ros.core.lie import Array
from xalign_ros.core.records import Norm

POINTS_PER_WORD = 64  # on average
SAMPLE_PER_WORD = 32  # descriptors that a word is learned from
SWEEPS = 8  # of k-means
PROBES = 8  # words of each level that a query looks into
CODE_BITS = 256
RERANKED = 32  # nearest by code whose true distances are compared, where a code is not the descriptor itself
NUMBER_BITS = 21  # of a candidate's number; the bits that differ have the eleven above
NONE = np.uint32(0xFFFFFFFF)
BLOCK = 1 << 15  # candidates compared at a time: their codes stay in the processor's cache


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """W coarse words of W fine ones each, and the inverted file of M points; arrays may be memory-mapped.

    coarse (W, D) and fine (W, W, D) float32; points of fine word w are word_point[word_offset[w]:word_offset[w + 1]],
    and code (C, M) unsigned, columns of machine words, is in their order.
    """

    coarse: np.ndarray
    fine: np.ndarray
    word_offset: np.ndarray
    word_point: np.ndarray
    code: np.ndarray

    @staticmethod
    def learn(descriptors: np.ndarray, norm: Norm) -> Vocabulary:
        """Vocabulary and inverted file of M points by their descriptors (M, B)."""
        size = max(1, round((len(descriptors) / POINTS_PER_WORD) ** 0.5))
        rng = np.random.default_rng(0)
        some = rng.permutation(len(descriptors))[: SAMPLE_PER_WORD * size * size]
        sample = _vectors(descriptors[some], norm)
        coarse, home = _means(sample, size)
        fine = np.stack([_means(sample[home == c], size)[0] for c in range(size)])
        word = np.empty(len(descriptors), np.int64)
        for start in range(0, len(word), BLOCK):
            part = slice(start, start + BLOCK)
            x = _vectors(descriptors[part], norm)
            top = _nearest(x, coarse)
            for c in np.unique(top):
                own = np.flatnonzero(top == c)
                word[start + own] = c * size + _nearest(x[own], fine[c])
        order = np.argsort(word, kind="stable")
        offset = np.searchsorted(word[order], np.arange(size * size + 1))
        return Vocabulary(coarse, fine, offset, order.astype(np.int32), columns(_codes(descriptors[order], norm)))

    def nearest(
        self, query: np.ndarray, descriptors: np.ndarray, norm: Norm, count: int
    ) -> tuple[np.ndarray, np.ndarray, Array]:
        """Of each query descriptor (N, B) the `count` nearest of the map's (M, B) among the words it probes.

        Returns rows of the query, map points and distances, all (P,); rows may have fewer than `count`.
        """
        if not len(query):
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
        word, row = self._probed(_vectors(query, norm))
        first, size = self.word_offset[word], self.word_offset[word + 1] - self.word_offset[word]
        place = slices(first, size)
        row = np.repeat(row, size)
        begin = np.searchsorted(row, np.arange(len(query) + 1))
        query_code = columns(_codes(query, norm))
        # Bits that differ, then the candidate's number, in one: unique, so that no sort can break a tie in its own way.
        key = np.full((len(query), max(int(np.diff(begin).max()), count)), NONE, np.uint32)
        for start in range(0, len(row), BLOCK):
            p, r = place[start : start + BLOCK], row[start : start + BLOCK]
            bits = differing_bits(query_code, self.code, r, p).astype(np.uint32)
            number = np.arange(start, start + len(p)) - begin[r]
            key[r, number] = (bits << NUMBER_BITS) + number
        key = _smallest(key, count if norm is Norm.HAMMING else RERANKED)
        rows, at = np.nonzero(key != NONE)
        number = key[rows, at] & ((1 << NUMBER_BITS) - 1)
        points = self.word_point[place[begin[rows] + number]].astype(np.int64)
        distance = pair_distance(query[rows], descriptors[points], norm)
        order = np.lexsort((points, distance, rows))
        rank = np.arange(len(rows)) - np.searchsorted(rows, rows)
        order = order[rank < count]
        return rows[order], points[order], distance[order]

    def _probed(self, x: Array) -> tuple[np.ndarray, np.ndarray]:
        """The words that each vector (N, D) looks into, and its row, in the order of rows."""
        size, rows = len(self.coarse), np.arange(len(x))
        top = _columns_of_smallest(_squared(x, self.coarse), PROBES)
        probes = top.shape[1]
        fine = np.empty((len(x) * probes, size), np.float32)
        order = np.argsort(top.ravel(), kind="stable")
        bound = np.searchsorted(top.ravel()[order], np.arange(size + 1))
        for c in range(size):
            own = order[bound[c] : bound[c + 1]]
            if len(own):
                fine[own] = _squared(x[own // probes], self.fine[c])
        best = _columns_of_smallest(fine.reshape(len(x), -1), PROBES)
        word = np.take_along_axis(top, best // size, axis=1) * size + best % size
        return word.ravel(), np.repeat(rows, best.shape[1])


def _vectors(descriptors: np.ndarray, norm: Norm) -> Array:
    """Descriptors (N, B) as vectors (N, D) float32; their L2 distances order as the norm's do."""
    if norm is Norm.HAMMING:
        return np.unpackbits(np.ascontiguousarray(descriptors), axis=1).astype(np.float32)
    return unit(descriptors) if norm is Norm.COSINE_FLOAT32 else descriptors.astype(np.float32)


def _codes(descriptors: np.ndarray, norm: Norm) -> np.ndarray:
    """Codes (N, B) uint8 whose Hamming distance orders about as the norm does."""
    if norm is Norm.HAMMING:
        return np.ascontiguousarray(descriptors)
    width = descriptors.shape[1]
    rng = np.random.default_rng(0)
    planes = rng.normal(size=(width, CODE_BITS)).astype(np.float32)
    planes -= planes.mean(axis=0)  # a descriptor of no negative number lies on one side of most planes through zero
    parts = [
        np.packbits(_vectors(descriptors[s : s + BLOCK], norm) @ planes > 0, axis=1)
        for s in range(0, max(len(descriptors), 1), BLOCK)
    ]
    return np.concatenate(parts)


def _means(x: Array, count: int) -> tuple[Array, np.ndarray]:
    """k-means: means (count, D) and the nearest one of each row (N,). Of fewer rows each is its own mean."""
    if len(x) <= count:
        some = x if len(x) else np.zeros((1, x.shape[1]), np.float32)
        return np.asarray(np.resize(some, (count, x.shape[1]))), np.arange(len(x))
    rng = np.random.default_rng(0)
    means: Array = x[rng.choice(len(x), count, replace=False)]
    for _ in range(SWEEPS):
        home = _nearest(x, means)
        order = np.argsort(home, kind="stable")
        own, first = np.unique(home[order], return_index=True)  # a mean that nothing is nearest to stays where it is
        means[own] = np.add.reduceat(x[order], first, axis=0) / np.diff(np.r_[first, len(x)])[:, None]
    return means, _nearest(x, means)


def slices(first: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """first[n], first[n] + 1, ..., counts[n] of them, one after the other for each n."""
    end = np.cumsum(counts)
    return np.asarray(np.repeat(first - end + counts, counts) + np.arange(end[-1] if len(end) else 0))


def _nearest(x: Array, means: Array) -> np.ndarray:
    from scipy.cluster.vq import vq  # takes half a second to import, and a node never learns

    return np.asarray(vq(x, means, check_finite=False)[0])


def _squared(x: Array, means: Array) -> Array:
    """Squared L2 distances (N, W), less what all of a row have in common."""
    return np.asarray(np.einsum("ij,ij->i", means, means) - 2 * (x @ means.T))


def _smallest(values: np.ndarray, count: int) -> np.ndarray:
    """The `count` smallest values (N, count) of each row, or all of them."""
    return np.partition(values, count - 1, axis=1)[:, :count] if count < values.shape[1] else values


def _columns_of_smallest(values: Array, count: int) -> np.ndarray:
    """Columns (N, count) of the smallest values of each row, or all of them."""
    count = min(count, values.shape[1])
    return np.argpartition(values, count - 1, axis=1)[:, :count]
