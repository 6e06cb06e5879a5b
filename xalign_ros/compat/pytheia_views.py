"""pyTheia's views, their cameras and priors, and features: mutable, world to camera."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.compat import pytheia_intrinsics as intrinsics
from xalign_ros.core.lie import Array, so3_exp, so3_log

__all__ = ["Camera", "Feature", "View"]

Prior = tuple[Array, Array]  # value (3,), root of its information (3, 3)


class Camera:
    """A camera's position (3,) in the world, its world-to-camera rotation (3, 3), and a pinhole's intrinsics (px)."""

    def __init__(self) -> None:
        self._position, self._rotation = np.zeros(3), np.eye(3)
        self.intrinsics, self.size = np.array([1.0, 1.0, 0.0, 0.0]), (0, 0)  # fx, fy, cx, cy; width, height

    def GetPosition(self) -> Array:
        return self._position.copy()

    def SetPosition(self, position: ArrayLike) -> None:
        self._position = vector(position, 3, "a position")

    def GetOrientationAsRotationMatrix(self) -> Array:
        return self._rotation.copy()

    def SetOrientationFromRotationMatrix(self, rotation: ArrayLike) -> None:
        R = np.array(rotation, float)
        if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise ValueError("an orientation must be a rotation matrix (3, 3)")
        self._rotation = R

    def GetOrientationAsAngleAxis(self) -> Array:
        return so3_log(self._rotation)

    def SetOrientationFromAngleAxis(self, angle_axis: ArrayLike) -> None:
        self._rotation = so3_exp(vector(angle_axis, 3, "an angle-axis"))

    def FocalLength(self) -> float:
        return float(self.intrinsics[0])

    def SetFocalLength(self, focal_length: float) -> None:
        """Of both axes, in their ratio."""
        self.intrinsics[:2] *= float(focal_length) / self.intrinsics[0]

    def PrincipalPointX(self) -> float:
        return float(self.intrinsics[2])

    def PrincipalPointY(self) -> float:
        return float(self.intrinsics[3])

    def SetPrincipalPoint(self, x: float, y: float) -> None:
        self.intrinsics[2:] = x, y

    def ImageWidth(self) -> int:
        return self.size[0]

    def ImageHeight(self) -> int:
        return self.size[1]

    def SetImageSize(self, width: int, height: int) -> None:
        self.size = int(width), int(height)

    def SetFromCameraIntrinsicsPriors(self, prior: intrinsics.CameraIntrinsicsPrior) -> None:
        """Raises ValueError on a prior that is no pinhole without distortion."""
        self.intrinsics = prior.pinhole()
        self.SetImageSize(prior.image_width, prior.image_height)

    def CameraIntrinsicsPriorFromIntrinsics(self) -> intrinsics.CameraIntrinsicsPrior:
        prior, (fx, fy, cx, cy) = intrinsics.CameraIntrinsicsPrior(*self.size), self.intrinsics.tolist()
        known = {"focal_length": fx, "aspect_ratio": fy / fx, "principal_point": (cx, cy), "skew": 0.0}
        for name, value in known.items():
            getattr(prior, name).value, getattr(prior, name).is_set = value, True
        return prior

    def GetCalibrationMatrix(self) -> Array:
        fx, fy, cx, cy = self.intrinsics.tolist()
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    def GetProjectionMatrix(self) -> Array:
        """(3, 4), to homogeneous pixels."""
        R = self._rotation
        return np.asarray(self.GetCalibrationMatrix() @ np.c_[R, -R @ self._position])

    def ProjectPoint(self, point: ArrayLike) -> tuple[float, Array]:
        """Depth and pixel (2,) of a homogeneous point (4,); behind the camera the depth is negative."""
        X = vector(point, 4, "a point (homogeneous)")
        with np.errstate(divide="ignore", invalid="ignore"):
            x = self._rotation @ (X[:3] / X[3] - self._position)
            return float(x[2]), self.intrinsics[:2] * x[:2] / x[2] + self.intrinsics[2:]

    def PixelToNormalizedCoordinates(self, pixel: ArrayLike) -> Array:
        """(3,) in the camera's axes, with z = 1."""
        return np.append((vector(pixel, 2, "a pixel") - self.intrinsics[2:]) / self.intrinsics[:2], 1.0)

    def PixelToUnitDepthRay(self, pixel: ArrayLike) -> Array:
        """The same in the world's axes."""
        return np.asarray(self._rotation.T @ self.PixelToNormalizedCoordinates(pixel))


class View:
    """With priors of position (world), orientation (angle-axis, world to camera) and gravity (camera), or None."""

    def __init__(self, name: str, timestamp: float = 0.0) -> None:
        self._name, self._timestamp, self._estimated, self._camera = name, timestamp, False, Camera()
        self.features: dict[int, Feature] = {}  # by track
        self._intrinsics_prior = intrinsics.CameraIntrinsicsPrior()
        self.position_prior: Prior | None = None
        self.orientation_prior: Prior | None = None
        self.gravity_prior: Prior | None = None

    def Name(self) -> str:
        return self._name

    def GetTimestamp(self) -> float:
        return self._timestamp

    def IsEstimated(self) -> bool:
        return self._estimated

    def SetIsEstimated(self, estimated: bool) -> None:
        self._estimated = bool(estimated)

    def Camera(self) -> Camera:
        return self._camera

    MutableCamera = Camera

    def GetFeature(self, track_id: int) -> Feature | None:
        return self.features.get(track_id)

    def TrackIds(self) -> list[int]:
        return list(self.features)

    def NumFeatures(self) -> int:
        return len(self.features)

    def CameraIntrinsicsPrior(self) -> intrinsics.CameraIntrinsicsPrior:
        return self._intrinsics_prior

    MutableCameraIntrinsicsPrior = CameraIntrinsicsPrior

    def SetCameraIntrinsicsPrior(self, prior: intrinsics.CameraIntrinsicsPrior) -> None:
        """A copy of it."""
        self._intrinsics_prior = deepcopy(prior)

    def SetPositionPrior(self, position: ArrayLike, sqrt_information: ArrayLike) -> None:
        self.position_prior = _prior(position, sqrt_information, "a position prior")

    def SetOrientationPrior(self, angle_axis: ArrayLike, sqrt_information: ArrayLike) -> None:
        self.orientation_prior = _prior(angle_axis, sqrt_information, "an orientation prior")

    def SetGravityPrior(self, gravity: ArrayLike, sqrt_information: ArrayLike) -> None:
        self.gravity_prior = _prior(gravity, sqrt_information, "a gravity prior")

    def HasPositionPrior(self) -> bool:
        return self.position_prior is not None

    def HasOrientationPrior(self) -> bool:
        return self.orientation_prior is not None

    def HasGravityPrior(self) -> bool:
        return self.gravity_prior is not None

    def GetPositionPrior(self) -> Array:
        return _value(self.position_prior)

    def GetOrientationPrior(self) -> Array:
        return _value(self.orientation_prior)

    def GetGravityPrior(self) -> Array:
        return _value(self.gravity_prior)

    def GetPositionPriorSqrtInformation(self) -> Array:
        """(3, 3), as set; the identity where there is no prior."""
        return _root(self.position_prior)

    def GetOrientationPriorSqrtInformation(self) -> Array:
        return _root(self.orientation_prior)

    def GetGravityPriorSqrtInformation(self) -> Array:
        return _root(self.gravity_prior)


class Feature:
    """Where a view sees a track: point (2,) px, and its covariance (2, 2) px^2."""

    def __init__(self, *point: Any) -> None:  # (2,), or x and y
        self.point = vector(point[0] if len(point) == 1 else point, 2, "a feature") if point else np.zeros(2)
        self.covariance = np.eye(2)


def vector(value: ArrayLike, size: int, what: str) -> Array:
    """(size,) numbers. Raises ValueError on others and on what is not finite."""
    x = np.array(value, float).reshape(-1) if np.size(value) == size else np.zeros(0)
    if len(x) != size:
        raise ValueError(f"{what} has {size} numbers, not {np.size(value)}")
    if not np.isfinite(x).all():
        raise ValueError(f"{what} has a number that is not finite")
    return x


def _prior(value: ArrayLike, root: ArrayLike, what: str) -> Prior:
    return vector(value, 3, what), vector(root, 9, f"the root of the information of {what}").reshape(3, 3)


def _root(prior: Prior | None) -> Array:
    return np.eye(3) if prior is None else prior[1].copy()


def _value(prior: Prior | None) -> Array:
    return np.zeros(3) if prior is None else prior[0].copy()
