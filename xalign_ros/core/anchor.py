"""Features and map to an Anchor or the Rejection that says why there is none."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from xalign_ros.core.config import Config, Pnp
from xalign_ros.core.lie import Array
from xalign_ros.core.map_error import pose_influence, shared_covariance, telling
from xalign_ros.core.matching import NO_MATCHES, Matches, guided_matches, place_matches, places
from xalign_ros.core.pnp import Points2D3D, Pose, estimate_pose, evidence, refine_pose, sample_pose, upper_median
from xalign_ros.core.records import Anchor, Keyframe, Rejection
from xalign_ros.core.reference_map import MapIndex
from xalign_ros.core.transforms import SE3
from xalign_ros.core.window_lock import WindowPose, window_pose

COARSE_PAIRS = 15_000  # of a feature and a point, compared to narrow a wide prediction
CERTAIN = np.zeros((6, 6))

DETAILS = {
    "too_few_matches": "{matches} matches with the map, needed are {needed}",
    "too_few_inliers": "fewer than {needed} of {matches} matches agree on one pose",
    "high_residual": "the best pose leaves residuals far above the keypoint noise",
    "degenerate": "the matched points do not fix the pose, or they are in a corner of the image",
    "ambiguous": "a second place of the map explains {runner_up:.0%} as many matches",
}


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What a keyframe may have seen of the map: its matches within each place that it looks like."""

    keyframe: Keyframe
    places: tuple[Matches, ...]


def seed_of(keyframe: Keyframe) -> int:
    """Seed of a keyframe's random choices: of its identity alone, so that no other input can change them."""
    digest = hashlib.sha256(f"{keyframe.session}:{keyframe.id}".encode()).digest()
    return int.from_bytes(digest[:4], "little") & 0x7FFFFFFF


class _Search:
    """One keyframe and the map it is looked for in."""

    def __init__(self, keyframe: Keyframe, index: MapIndex, config: Config) -> None:
        assert keyframe.camera is not None
        self.keyframe = keyframe
        self.features, self.camera, self.seed = keyframe.features, keyframe.camera, seed_of(keyframe)
        self.index, self.config = index, config
        self.few = replace(config.pnp, min_inliers=config.pnp.cold_inliers)
        own = keyframe.features.sigma_px
        sigma = np.full(len(self.features), config.pnp.sigma_px) if own is None else own
        self.sigma_px = np.maximum(sigma, index.map.sigma_px)  # not below what the map's own observations leave

    def around(
        self, points: np.ndarray, T_map_cam: SE3, cov_cam: Array = CERTAIN, most_pairs: float = np.inf
    ) -> tuple[Matches, bool]:
        return guided_matches(
            self.features,
            self.camera,
            self.index.map,
            points,
            T_map_cam,
            cov_cam,
            upper_median(self.sigma_px),
            self.config.matching,
            most_pairs,
        )

    def coarse(self, matches: Matches) -> SE3 | str:
        """A pose that few matches agree on; a wrong one is found out by the search around it."""
        return sample_pose(self.pairs(matches), self.camera, self.seed, self.few)

    def pose(self, matches: Matches, config: Pnp, start: SE3) -> Pose | str:
        return estimate_pose(self.pairs(matches), self.camera, self.seed, config, start)

    def refined(self, matches: Matches, T_map_cam: SE3) -> Pose | str:
        return refine_pose(T_map_cam, self.pairs(matches), self.camera, self.few)

    def pairs(self, matches: Matches) -> Points2D3D:
        map_, f, p = self.index.map, matches.feature, matches.point
        return Points2D3D(self.features.uv[f], self.sigma_px[f], map_.points[p], map_.point_cov[p].astype(float))

    def result(self, matches: Matches, found: Pose | str, runner_up: float, config: Pnp) -> Anchor | Rejection:
        who = (self.keyframe.id, self.keyframe.session, self.keyframe.stamp_ns)
        if isinstance(found, str):
            detail = DETAILS[found].format(matches=len(matches), needed=config.min_inliers, runner_up=runner_up)
            return Rejection(*who, found, detail, len(matches))
        cov = found.cov_cam + self._map_covariance(matches, found)
        anchor = Anchor(*who, found.T_map_cam, cov, len(matches), _inliers(found), found.rms_px, runner_up)
        if runner_up > config.max_runner_up:
            detail = DETAILS["ambiguous"].format(runner_up=runner_up)
            return Rejection(*who, "ambiguous", detail, len(matches), anchor.inliers, anchor.rms_px, runner_up, anchor)
        return anchor

    def _map_covariance(self, matches: Matches, found: Pose) -> Array:
        """What the map's keyframes err: that of the points' own ones, and what any pose is off from where it was given."""
        variance = np.square(self.index.map.keyframe_sigma)
        if not variance.any():
            return CERTAIN
        some = _kept(matches, telling(found.inlier))
        m, sources = self.pairs(some), self.index.sources(some.point)
        influence = pose_influence(found.T_map_cam, m, self.camera)
        rotation, position = shared_covariance(influence, m.xyz, m.cov, sources)
        return np.asarray(np.diag(np.repeat(variance, 3)) + variance[0] * rotation + variance[1] * position)


def find_guided(
    keyframe: Keyframe, index: MapIndex, T_map_cam: SE3, cov_cam: Array, config: Config
) -> Anchor | Rejection:
    """Anchor from matches around a predicted pose with covariance (6, 6), camera axes.

    Where the prediction is wide, a part of the points is enough to narrow it.
    """
    search = _Search(keyframe, index, config)
    points = index.visible_points(T_map_cam, index.keyframes_near(T_map_cam, config.matching.guided_keyframes))
    matches, complete = search.around(points, T_map_cam, cov_cam, COARSE_PAIRS)
    if not complete:
        coarse = search.coarse(matches)
        if isinstance(coarse, SE3):
            T_map_cam, cov_cam = coarse, CERTAIN
        matches, _ = search.around(points, T_map_cam, cov_cam)
    return search.result(matches, search.pose(matches, config.pnp, T_map_cam), 0.0, config.pnp)


def find_anywhere(keyframe: Keyframe, index: MapIndex, config: Config) -> Anchor | Rejection:
    """Anchor from the whole map by one keyframe alone."""
    return sight(keyframe, index, config)[0]


def sight(keyframe: Keyframe, index: MapIndex, config: Config) -> tuple[Anchor | Rejection, Sighting]:
    """Anchor from the whole map: places by vote, a pose from the matches in each, what is seen around it; the second best
    place as a warning.

    Places are compared by the features that speak for each: its inliers, but for those whose descriptor is clearly nearer
    (by the ratio of a match) to an inlier of another place. Returns also what may be found together with other keyframes.
    """
    search, tried, seen = _Search(keyframe, index, config), list[tuple[Matches, Pose | str]](), list[Matches]()
    for place in places(keyframe.features, index, config.matching):
        matches = place_matches(keyframe.features, index, place, config.matching)
        seen.append(matches)
        coarse = search.coarse(matches)
        found = coarse if isinstance(coarse, str) else search.refined(matches, coarse)
        if isinstance(coarse, SE3) and _inliers(found) < config.pnp.min_inliers:  # is there more to see around it?
            matches, _ = search.around(index.visible_points(coarse, place), coarse)
            found = search.pose(matches, search.few, coarse)
        tried.append((matches, found))
    sighting, poses = Sighting(keyframe, tuple(seen)), [(m, p) for m, p in tried if isinstance(p, Pose)]
    if not poses:
        most = max(tried, key=lambda t: len(t[0]), default=(NO_MATCHES, "too_few_matches"))
        return search.result(*most, 0.0, search.few), sighting
    distance = np.full((len(poses), len(keyframe.features)), np.inf)
    for row, (matches, pose) in zip(distance, poses, strict=True):
        row[matches.feature[pose.inlier]] = matches.distance[pose.inlier]
    support = (np.isfinite(distance) & (config.matching.cold_ratio * distance <= distance.min(axis=0))).sum(axis=1)
    first = int(support.argmax())
    others = [int(n) for n, hypothesis in zip(support, poses, strict=True) if _elsewhere(hypothesis, poses[first])]
    result = search.result(*poses[first], max(others, default=0) / int(support[first]), search.few)
    return result, sighting


def find_together(sightings: Sequence[Sighting], index: MapIndex, config: Config) -> dict[int, Anchor]:
    """Anchors by keyframe id of keyframes that agree with their odometry between them on where they are, each with what it
    sees around there; one alone need not be sure. None where another place explains them about as well.
    """
    searches = [_Search(s.keyframe, index, config) for s in sightings]
    keyframes, newest = [s.keyframe for s in sightings], sightings[-1].keyframe
    matches = [_joined(s.places) for s in sightings]
    best, explained, rest = _window(searches, matches, keyframes)
    if best is None:
        return {}
    other, of_other, _ = _window(searches, rest, keyframes)
    runner_up = sum(len(m) for m in of_other) / sum(len(m) for m in explained)
    seen = sum(evidence(s.features.uv[m.feature], s.camera) for s, m in zip(searches, explained, strict=True))
    if seen < config.pnp.min_spread or (
        other is not None
        and runner_up > config.pnp.max_runner_up
        and _far(best.prediction(newest), other.prediction(newest))
    ):
        return {}
    anchors = {}
    for search in searches:
        T, cov = best.prediction(search.keyframe)
        near = index.keyframes_near(T, config.matching.guided_keyframes)
        around, _ = search.around(index.visible_points(T, near), T, cov)
        pose = search.pose(around, search.few, T)
        found = search.result(around, pose, 0.0, search.few)
        sure = isinstance(found, Anchor) and found.inliers >= config.pnp.min_inliers
        if isinstance(found, Anchor) and sure and not _far((T, cov), (found.T_map_cam, found.cov_cam)):
            anchors[found.keyframe_id] = found
    return anchors


def _window(
    searches: Sequence[_Search], matches: Sequence[Matches], keyframes: Sequence[Keyframe]
) -> tuple[WindowPose | None, list[Matches], list[Matches]]:
    """The window's pose by these matches of each keyframe, and which of them it explains and which it does not."""
    search = searches[-1]
    pairs = [s.pairs(m) for s, m in zip(searches, matches, strict=True)]
    found = window_pose(keyframes, pairs, search.index.map.anchor_sigma, search.seed, search.config)
    if found is None:
        return None, [NO_MATCHES] * len(matches), list(matches)
    parts = list(zip(matches, np.split(found.inlier, np.cumsum([len(m) for m in matches])[:-1]), strict=True))
    return found, [_kept(m, p) for m, p in parts], [_kept(m, ~p) for m, p in parts]


def _kept(m: Matches, rows: np.ndarray) -> Matches:
    return Matches(m.feature[rows], m.point[rows], m.distance[rows])


def _joined(matches: Sequence[Matches]) -> Matches:
    if not matches:
        return NO_MATCHES
    return Matches(*(np.concatenate([getattr(m, name) for m in matches]) for name in ("feature", "point", "distance")))


def _inliers(pose: Pose | str) -> int:
    return int(pose.inlier.sum()) if isinstance(pose, Pose) else 0


def _far(a: tuple[SE3, Array], b: tuple[SE3, Array]) -> bool:
    """Whether more than five sigma of both lie between the positions of two poses with covariance (6, 6)."""
    sigma = np.sqrt(np.trace(a[1][3:, 3:]) + np.trace(b[1][3:, 3:]))
    return bool(np.linalg.norm(a[0].t - b[0].t) > 5 * sigma)


def _elsewhere(a: tuple[Matches, Pose], b: tuple[Matches, Pose]) -> bool:
    """Two poses are two hypotheses when they are far from each other, and other points are under them."""
    points = [m.point[p.inlier] for m, p in (a, b)]
    shared = len(np.intersect1d(*points)) / min(len(x) for x in points)
    return shared < 0.5 and _far(*((p.T_map_cam, p.cov_cam) for _, p in (a, b)))
