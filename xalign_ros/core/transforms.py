"""One rigid transform, one similarity. Name them T_a_b and S_a_b: x_a = s R x_b + t, inner names cancel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from xalign_ros.core import lie
from xalign_ros.core.lie import Array


def frozen(value: ArrayLike, shape: tuple[int | None, ...], name: str, dtype: DTypeLike = np.float64) -> np.ndarray:
    """A read-only array of the asked shape (None = any length). Raises ValueError naming the field otherwise."""
    a: np.ndarray = np.array(value, dtype)
    if a.shape != shape:
        fits = len(a.shape) == len(shape)
        for n, wanted in zip(a.shape, shape, strict=False):  # a generator would take longer than all the rest
            if n != wanted and wanted is not None:
                fits = False
        if not fits:
            told = tuple("N" if n is None else n for n in shape)
            raise ValueError(f"{name} has shape {a.shape}, needed is {told}")
    a.setflags(write=False)
    return a


def _rigid(R: Array, t: Array) -> SE3:
    """Of arrays just made here out of checked ones, in a fifth of the time: a step makes dozens of poses."""
    T: SE3 = object.__new__(SE3)
    R.setflags(write=False)
    t.setflags(write=False)
    object.__setattr__(T, "R", R)
    object.__setattr__(T, "t", t)
    return T


def _similar(R: Array, t: Array, s: float) -> Sim3:
    """The same of a similarity."""
    if s <= 0:
        raise ValueError(f"Sim3.s is {s}, a scale is positive")
    S: Sim3 = object.__new__(Sim3)
    R.setflags(write=False)
    t.setflags(write=False)
    object.__setattr__(S, "R", R)
    object.__setattr__(S, "t", t)
    object.__setattr__(S, "s", s)
    return S


@dataclass(frozen=True, slots=True, eq=False)
class SE3:
    """T_a_b: rotation R (3, 3) and translation t (3,), in a's unit of length. Scale is exactly 1."""

    R: Array
    t: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "R", frozen(self.R, (3, 3), "SE3.R"))
        object.__setattr__(self, "t", frozen(self.t, (3,), "SE3.t"))

    @staticmethod
    def identity() -> SE3:
        return SE3(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(T: ArrayLike) -> SE3:
        """From a (4, 4) or (3, 4) matrix."""
        T = np.asarray(T, float)
        return SE3(T[:3, :3], T[:3, 3])

    @staticmethod
    def from_quat(q_xyzw: ArrayLike, t: ArrayLike) -> SE3:
        return SE3(lie.rotation_from_quat(q_xyzw), np.asarray(t, float))

    @staticmethod
    def exp(tangent: ArrayLike) -> SE3:
        return SE3(*lie.se3_exp(tangent))

    def log(self) -> Array:
        return lie.se3_log(self.R, self.t)

    @property
    def q_xyzw(self) -> Array:
        return lie.quat_from_rotation(self.R)

    def matrix(self) -> Array:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R, self.t
        return T

    def inverse(self) -> SE3:
        return _rigid(self.R.T.copy(), -(self.R.T @ self.t))

    def apply(self, x: ArrayLike) -> Array:
        """Points (..., 3) of b, in a."""
        return np.asarray(x, float) @ self.R.T + self.t

    def __matmul__(self, other: SE3) -> SE3:
        if not isinstance(other, SE3):
            return NotImplemented  # a similarity's scale would be lost
        return _rigid(self.R @ other.R, self.R @ other.t + self.t)

    def as_sim3(self) -> Sim3:
        return _similar(self.R, self.t, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Sim3:
    """S_a_b: rotation R (3, 3), translation t (3,) in a's unit, scale s = units of a per unit of b."""

    R: Array
    t: Array
    s: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "R", frozen(self.R, (3, 3), "Sim3.R"))
        object.__setattr__(self, "t", frozen(self.t, (3,), "Sim3.t"))
        object.__setattr__(self, "s", float(self.s))
        if self.s <= 0:  # NaN passes: it is the state's "unknown"
            raise ValueError(f"Sim3.s is {self.s}, a scale is positive")

    @staticmethod
    def identity() -> Sim3:
        return Sim3(np.eye(3), np.zeros(3), 1.0)

    @staticmethod
    def exp(tangent: ArrayLike) -> Sim3:
        R, t, s = lie.sim3_exp(tangent)
        return Sim3(R, t, float(s))

    def log(self) -> Array:
        return lie.sim3_log(self.R, self.t, self.s)

    def adjoint(self) -> Array:
        return lie.sim3_adjoint(self.R, self.t, self.s)

    def inverse(self) -> Sim3:
        return _similar(self.R.T.copy(), -(self.R.T @ self.t) / self.s, 1 / self.s)

    def apply(self, x: ArrayLike) -> Array:
        """Points (..., 3) of b, in a."""
        return self.s * (np.asarray(x, float) @ self.R.T) + self.t

    @overload
    def __matmul__(self, other: SE3) -> Sim3: ...
    @overload
    def __matmul__(self, other: Sim3) -> Sim3: ...
    def __matmul__(self, other: SE3 | Sim3) -> Sim3:
        scale = other.s if isinstance(other, Sim3) else 1.0
        return _similar(self.R @ other.R, self.s * (self.R @ other.t) + self.t, self.s * scale)

    def rigid_pose(self) -> SE3:
        """T_a_b with b's axes and origin, b measured in a's unit from here on: the one way from S_ back to T_."""
        return _rigid(self.R, self.t)
