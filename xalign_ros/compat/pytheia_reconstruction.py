"""pyTheia's reconstruction as far as alignment needs it: mutable, by id, world to camera."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from xalign_ros.compat.pytheia_views import Feature, View, vector
from xalign_ros.core.lie import Array, sim3_exp, sim3_log
from xalign_ros.core.transforms import Sim3

__all__ = [
    "GetSim3LieFromView",
    "Reconstruction",
    "RelativeSim3BetweenViews",
    "SetViewCameraFromSim3Lie",
    "Sim3FromRotationTranslationScale",
    "Sim3ToHomogeneousMatrix",
    "Sim3ToRotationTranslationScale",
    "Track",
    "kInvalidTrackId",
    "kInvalidViewId",
]

kInvalidViewId = kInvalidTrackId = 2**32 - 1  # pyTheia's names
SOPHUS = [3, 4, 5, 0, 1, 2, 6]  # where our rotation, translation, log-scale stand in its tangent, and back


class Track:
    def __init__(self) -> None:
        self._point, self._estimated, self._views = np.zeros(4), False, set[int]()
        self.features: dict[int, Feature] = {}  # by view, the reference view first
        self._inverse_depth, self._bearing, self._reference = 0.0, np.zeros(3), kInvalidViewId

    def Point(self) -> Array:
        """Homogeneous (4,); zeros until it is set."""
        return self._point.copy()

    def SetPoint(self, point: ArrayLike) -> None:
        self._point = vector(point, 4, "a point (homogeneous)")

    def IsEstimated(self) -> bool:
        return self._estimated

    def SetIsEstimated(self, estimated: bool) -> None:
        self._estimated = bool(estimated)

    def AddView(self, view_id: int) -> None:
        if not self._views:
            self._reference = int(view_id)
        self._views.add(int(view_id))

    def ReferenceViewId(self) -> int:
        """The view that was added first."""
        return self._reference

    def InverseDepth(self) -> float:
        """1 / z in the reference view, 0 at infinity and where it is not known."""
        return self._inverse_depth

    def SetInverseDepth(self, inverse_depth: float) -> None:
        self._inverse_depth = float(inverse_depth)

    def ReferenceBearingVector(self) -> Array:
        """(3,) with z = 1, of the point in the reference view; zeros where it is not known."""
        return self._bearing.copy()

    def SetReferenceBearingVector(self, bearing: ArrayLike) -> None:
        self._bearing = vector(bearing, 3, "a bearing")

    def NumViews(self) -> int:
        return len(self._views)

    def ViewIds(self) -> set[int]:
        return set(self._views)


class Reconstruction:
    """Views and tracks by id. View(id), Track(id) of an unknown id are None; AddView of a known name or time fails."""

    def __init__(self) -> None:
        self._views: dict[int, View] = {}
        self._groups: dict[int, int] = {}
        self._tracks: dict[int, Track] = {}

    def AddView(self, name: str, *group_and_timestamp: float) -> int:
        """AddView(name, timestamp) or (name, intrinsics group, timestamp): the new view's id.

        kInvalidViewId where the name or the timestamp is taken. Views of a group share intrinsics; without one a view has
        its own.
        """
        if len(group_and_timestamp) not in (1, 2):
            raise TypeError("AddView takes a name, perhaps an intrinsics group, and a timestamp")
        timestamp = float(group_and_timestamp[-1])
        if any(name == v.Name() or timestamp == v.GetTimestamp() for v in self._views.values()):
            return kInvalidViewId
        self._views[len(self._views)] = View(name, timestamp)
        view_id = len(self._views) - 1
        own = max(self._groups.values(), default=-1) + 1
        self._groups[view_id] = int(group_and_timestamp[0]) if len(group_and_timestamp) == 2 else own
        return view_id

    def CameraIntrinsicsGroupIdFromViewId(self, view_id: int) -> int:
        return self._groups.get(view_id, kInvalidViewId)

    def View(self, view_id: int) -> View | None:
        return self._views.get(view_id)

    MutableView = View

    def ViewIds(self) -> list[int]:
        return list(self._views)

    def NumViews(self) -> int:
        return len(self._views)

    def ViewIdFromName(self, name: str) -> int:
        return next((k for k, v in self._views.items() if v.Name() == name), kInvalidViewId)

    def AddTrack(self) -> int:
        self._tracks[len(self._tracks)] = Track()
        return len(self._tracks) - 1

    def AddObservation(self, view_id: int, track_id: int, feature: Feature | None = None) -> bool:
        """False for an unknown view or track and where the view has the track. Only with a feature is it for reprojection."""
        if view_id not in self._views or track_id not in self._tracks or view_id in self._tracks[track_id].ViewIds():
            return False
        self._tracks[track_id].AddView(view_id)
        if feature is not None:
            self._tracks[track_id].features[view_id] = self._views[view_id].features[track_id] = feature
        return True

    def Track(self, track_id: int) -> Track | None:
        return self._tracks.get(track_id)

    MutableTrack = Track

    def TrackIds(self) -> list[int]:
        return list(self._tracks)

    def NumTracks(self) -> int:
        return len(self._tracks)

    def InitializeInverseDepth(self) -> None:
        """Inverse depths and bearings of estimated tracks as their points and reference views are.

        Bundle adjustment starts from the points, with this or without it, and does it at its end.
        """
        for track in self._tracks.values():
            view = self._views.get(track.ReferenceViewId())
            if view is None or not (view.IsEstimated() and track.IsEstimated()):
                continue
            *X, w = track.Point()
            x = view.Camera().GetOrientationAsRotationMatrix() @ (X - w * view.Camera().GetPosition())
            if x[2] > 0:
                track.SetInverseDepth(w / x[2])
                track.SetReferenceBearingVector(x / x[2])


def Sim3FromRotationTranslationScale(R: ArrayLike, t: ArrayLike, scale: float) -> Array:
    """Sophus' tangent (7,): translation, rotation, log-scale."""
    return Sim3(np.asarray(R, float), np.asarray(t, float), scale).log()[SOPHUS]


def Sim3ToRotationTranslationScale(lie: ArrayLike) -> tuple[Array, Array, float]:
    S = similarity(lie, "a Sim(3) tangent")
    return S.R, S.t, S.s


def Sim3ToHomogeneousMatrix(lie: ArrayLike) -> Array:
    """[s R, t; 0, 1] (4, 4)."""
    S = similarity(lie, "a Sim(3) tangent")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = S.s * S.R, S.t
    return T


def GetSim3LieFromView(view: View) -> Array:
    """Log of world to camera, with scale 1, in Sophus' order. Raises ValueError where there is no view."""
    return _of_view(view).log()[SOPHUS]


def RelativeSim3BetweenViews(view_i: View, view_j: View) -> Array:
    """Log(S_i^-1 S_j) of the two views' world-to-camera similarities, in Sophus' order."""
    return (_of_view(view_i).inverse() @ _of_view(view_j)).log()[SOPHUS]


def SetViewCameraFromSim3Lie(view: View, lie: ArrayLike) -> None:
    """The view's camera at R, c = -R^T t of a world-to-camera similarity; the scale has no place in a camera."""
    S = similarity(lie, "a Sim(3) tangent")
    _of_view(view)
    view.Camera().SetOrientationFromRotationMatrix(S.R)
    view.Camera().SetPosition(-S.R.T @ S.t)


def _of_view(view: View | None) -> Sim3:
    if view is None:
        raise ValueError("there is no such view in the reconstruction")
    R = view.Camera().GetOrientationAsRotationMatrix()
    return Sim3(R, -R @ view.Camera().GetPosition(), 1.0)


def similarity(lie: ArrayLike, what: str) -> Sim3:
    """Of Sophus' tangent (7,). Raises ValueError on other shapes and on numbers that are not finite."""
    x = vector(lie, 7, what)
    R, t, s = sim3_exp(x[SOPHUS])
    return Sim3(R, t, float(s))


def tangents(R: Array, t: Array, s: Array) -> Array:
    """(N, 7) in Sophus' order."""
    return sim3_log(R, t, s)[:, SOPHUS]


def views_of(reconstruction: Reconstruction, ids: list[int], role: str) -> Mapping[int, View]:
    """The views by id. Raises ValueError on an id that is not there or is named twice."""
    views: dict[int, View] = {}
    for view_id in ids:
        view = reconstruction.View(int(view_id))
        if view is None:
            raise ValueError(f"{role} view {view_id} is not in its reconstruction")
        if int(view_id) in views:
            raise ValueError(f"{role} view {view_id} is named twice")
        views[int(view_id)] = view
    return views
