"""Distances between descriptors, whatever their kind: Hamming on bits, L2 on uint8 or float32, cosine."""

from __future__ import annotations

import numpy as np

from xalign_ros.core.lie import Array
from xalign_ros.core.records import Norm

CACHED = 1 << 16  # distances computed at a time


def pair_distance(a: np.ndarray, b: np.ndarray, norm: Norm) -> Array:
    """Distances (N,) of rows of a (N, B) to the same rows of b (N, B): bits, L2, or 1 - cosine."""
    if norm is Norm.HAMMING:
        return np.asarray(np.bitwise_count(_words(a) ^ _words(b)).sum(axis=1, dtype=np.int64), float)
    x, y = a.astype(np.float32), b.astype(np.float32)
    if norm is Norm.COSINE_FLOAT32:
        scale = np.linalg.norm(x, axis=1) * np.linalg.norm(y, axis=1)
        return np.asarray(1 - np.einsum("ij,ij->i", x, y) / np.maximum(scale, 1e-12), float)
    return np.asarray(np.linalg.norm(x - y, axis=1), float)


def columns(codes: np.ndarray) -> np.ndarray:
    """Bits of rows (N, B) as columns (W, N) of the longest machine words that a row is made of."""
    return np.ascontiguousarray(_words(codes).T)


def differing_bits(a: np.ndarray, b: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Hamming distances (P,) uint16 of the codes i of columns a (W, N) to the codes j of columns b (W, M)."""
    bits = np.zeros(len(i), np.uint16)
    for x, y in zip(a, b, strict=True):
        bits += np.bitwise_count(x[i] ^ y[j])
    return bits


def nearest(query: np.ndarray, train: np.ndarray, norm: Norm, count: int) -> tuple[np.ndarray, Array]:
    """The `count` nearest rows of train (M, B) to each row of query (N, B): index (N, count) and distance (N, count)."""
    count = min(count, len(train))
    if norm is Norm.COSINE_FLOAT32:
        # For unit vectors L2^2 = 2 (1 - cosine): same order, and the distance converts exactly.
        index, d = nearest(unit(query), unit(train), Norm.L2_FLOAT32, count)
        return index, d * d / 2
    if norm is not Norm.HAMMING:
        return _nearest_l2(query.astype(np.float32), train.astype(np.float32), count)
    return _nearest_hamming(query, train, count)


def _nearest_hamming(query: np.ndarray, train: np.ndarray, count: int) -> tuple[np.ndarray, Array]:
    """XOR and population count, a machine word at a time, over blocks that stay in the processor's cache."""
    words, trained = _words(query), columns(train)
    block = max(1, CACHED // max(len(train), 1))
    index = np.empty((len(query), count), np.int64)
    distance = np.empty((len(query), count))
    for start in range(0, len(query), block):
        q = words[start : start + block]
        d = np.zeros((len(q), len(train)), np.uint16)
        for n, column in enumerate(trained):
            d += np.bitwise_count(column ^ q[:, n, None])
        rows = np.arange(len(q))
        for k in range(count):
            best = d.argmin(axis=1)
            index[start : start + block, k] = best
            distance[start : start + block, k] = d[rows, best]
            d[rows, best] = np.iinfo(np.uint16).max
    return index, distance


def _nearest_l2(query: np.ndarray, train: np.ndarray, count: int) -> tuple[np.ndarray, Array]:
    """By |a|^2 - 2 ab + |b|^2, one matrix product per block of queries."""
    norms = np.einsum("ij,ij->i", train, train)
    index = np.empty((len(query), count), np.int64)
    distance = np.empty((len(query), count))
    for start in range(0, len(query), 512):
        q = query[start : start + 512]
        d = norms - 2 * (q @ train.T)
        part = np.argpartition(d, min(count, d.shape[1] - 1), axis=1)[:, :count]
        value = np.take_along_axis(d, part, 1)
        order = np.argsort(value, axis=1, kind="stable")
        index[start : start + 512] = np.take_along_axis(part, order, 1)
        squared = np.take_along_axis(value, order, 1) + np.einsum("ij,ij->i", q, q)[:, None]
        distance[start : start + 512] = np.sqrt(np.maximum(squared, 0))
    return index, distance


def nearest_to_mean(descriptors: np.ndarray, group: np.ndarray, count: int, norm: Norm) -> np.ndarray:
    """Row (count,) of each group's descriptor nearest to the group's mean: its medoid but for ties.

    descriptors (N, B), group (N,) in 0..count-1, every group present. On bits the mean is that of each bit.
    """
    order = np.argsort(group, kind="stable")
    start = np.searchsorted(group[order], np.arange(count))
    sizes = np.diff(np.r_[start, len(order)])
    distance = np.zeros(len(order))
    for column in np.array_split(np.arange(descriptors.shape[1]), max(1, descriptors.shape[1] // 16)):
        x = descriptors[order][:, column]
        values = (np.unpackbits(x, axis=1) if norm is Norm.HAMMING else x).astype(np.float32)
        mean = np.add.reduceat(values, start, axis=0) / sizes[:, None]
        distance += ((values - np.repeat(mean, sizes, axis=0)) ** 2).sum(axis=1)
    best = np.lexsort((distance, np.repeat(np.arange(count), sizes)))
    return np.asarray(order[best[start]])


def unit(x: np.ndarray) -> np.ndarray:
    return np.asarray(x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12), np.float32)


def _words(x: np.ndarray) -> np.ndarray:
    """The same bits in as few machine words as the row length allows."""
    for kind in (np.uint64, np.uint32, np.uint16):
        if x.shape[1] % np.dtype(kind).itemsize == 0:
            return np.ascontiguousarray(x).view(kind)
    return x
