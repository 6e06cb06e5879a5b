"""pyTheia's priors of a camera's intrinsics: what is known of a lens beforehand, each with whether it is."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.core.lie import Array

__all__ = ["CameraIntrinsicsPrior", "PriorScalar", "PriorVector2d", "PriorVector3d", "PriorVector4d"]

FOCAL_PER_SIZE = 1.2  # focal length over the larger side of an image whose prior says none, as there


class _Prior:
    """value (size,) and is_set."""

    size: ClassVar[int]

    def __init__(self) -> None:
        self._value, self.is_set = np.zeros(self.size), False

    @property
    def value(self) -> Array:
        return self._value

    @value.setter
    def value(self, value: ArrayLike) -> None:
        new = np.array(value, float).reshape(-1)
        if len(new) != self.size or not np.isfinite(new).all():
            raise ValueError(f"a {type(self).__name__} has {self.size} finite numbers, not {new.tolist()}")
        self._value = new

    def given(self, default: float) -> list[float]:
        return self._value.tolist() if self.is_set else [default] * self.size


class PriorScalar(_Prior):
    size = 1


class PriorVector2d(_Prior):
    size = 2


class PriorVector3d(_Prior):
    size = 3


class PriorVector4d(_Prior):
    size = 4


@dataclass(eq=False, slots=True)
class CameraIntrinsicsPrior:
    """Sizes and lengths in px; the fields from `position` on are EXIF's, which nothing here uses."""

    image_width: int = 0
    image_height: int = 0
    camera_intrinsics_model_type: str = "PINHOLE"
    focal_length: PriorScalar = field(default_factory=PriorScalar)
    principal_point: PriorVector2d = field(default_factory=PriorVector2d)
    aspect_ratio: PriorScalar = field(default_factory=PriorScalar)
    skew: PriorScalar = field(default_factory=PriorScalar)
    radial_distortion: PriorVector4d = field(default_factory=PriorVector4d)
    tangential_distortion: PriorVector2d = field(default_factory=PriorVector2d)
    position: PriorVector3d = field(default_factory=PriorVector3d)
    orientation: PriorVector3d = field(default_factory=PriorVector3d)
    latitude: PriorScalar = field(default_factory=PriorScalar)
    longitude: PriorScalar = field(default_factory=PriorScalar)
    altitude: PriorScalar = field(default_factory=PriorScalar)

    def pinhole(self) -> Array:
        """fx, fy, cx, cy; what is not set is 1.2 times the larger side, its middle, square pixels.

        Raises ValueError on a lens that is no pinhole without distortion, and on lengths that are not positive.
        """
        lens = {name: getattr(self, name).given(0.0) for name in ("skew", "radial_distortion", "tangential_distortion")}
        bent = [f"{name.replace('_', ' ')} {values}" for name, values in lens.items() if any(values)]
        if self.camera_intrinsics_model_type != "PINHOLE" or bent:
            what = ", ".join([self.camera_intrinsics_model_type, *bent])
            raise ValueError(f"a prior of {what}: cameras here are pinholes without distortion")
        size = max(self.image_width, self.image_height)
        (f,), (aspect,) = self.focal_length.given(FOCAL_PER_SIZE * size if size else 1.0), self.aspect_ratio.given(1.0)
        if not (f > 0 and aspect > 0):
            raise ValueError(f"a prior has the focal length {f:g} px and the aspect ratio {aspect:g}")
        middle = [self.image_width / 2, self.image_height / 2]
        return np.array([f, f * aspect, *(self.principal_point.value if self.principal_point.is_set else middle)])
