"""What the tests of the aligner share: runs replayed, and how they are measured."""

from dataclasses import fields

import numpy as np
import pytest
import worlds

from xalign_ros.core.aligner import Aligner
from xalign_ros.core.config import Config, with_options
from xalign_ros.core.records import Anchor, Features, Keyframe
from xalign_ros.core.transforms import SE3, Sim3

CONFIG = Config()
CAP = CONFIG.lock.cap
WORLDS = {"line": worlds.line, "circle": worlds.circle, "loop": worlds.loop_with_scale_drift}
every_world = pytest.mark.parametrize("name", WORLDS)


def replay(map_, keyframes, config=CONFIG, after=None):
    """The steps; `after` gets the aligner after each."""
    aligner, steps = Aligner(map_, config), []
    for keyframe in keyframes:
        steps.append(aligner.step(keyframe))
        if after:
            after(aligner)
    return steps


def position_errors(steps, truth):
    """Distance (m) of every correction to the truth, NaN where there is none."""
    return np.array(
        [
            np.linalg.norm(s.correction.T_map_cam.t - T.t) if s.correction else np.nan
            for s, T in zip(steps, truth, strict=True)
        ]
    )


def states(steps):
    return [s.state.state for s in steps]


def same(a, b, but=()):
    """Two records equal to the last bit, field by field."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y, but) for x, y in zip(a, b, strict=True))
    if hasattr(a, "__dataclass_fields__"):
        return all(same(getattr(a, f.name), getattr(b, f.name), but) for f in fields(a) if f.name not in but)
    return a == b or (a != a and b != b)


def nees(correction, T):
    e = (correction.T_map_cam.inverse() @ T).log()
    return float(e @ np.linalg.solve(correction.cov_cam, e))


SIGMAS = np.array([0.002] * 3 + [0.02] * 3)
BARE = Features([[1.0, 1.0]], np.zeros((1, 32), np.uint8), "code")
LIE = SE3.exp([0, 0, 0.4, 3, -2, 0])  # of a look-alike: the same for all of a block
SHORT = with_options(CONFIG, {"window.keyframes": 15}, "test")  # the same problem, solved faster
SURE = with_options(SHORT, {"status.lost_sigma_m": 1e5}, "test")


class Drive:
    """Keyframes on a wide circle, odometry and anchors drawn from their models; `anchors` may be changed."""

    def __init__(self, count, seed, *, metric=False, step=0.5, sigmas=SIGMAS):
        rng = self.rng = np.random.default_rng([31, seed])
        self.truth = worlds.along_circle(count, 8.0, count * step / (2 * np.pi * 8))
        S = worlds.any_similarity(rng)
        T, self.S = worlds.drifting(self.truth, rng, CONFIG.odometry, Sim3(S.R, S.t, 1.0) if metric else S, metric)
        stamp = worlds.START_NS
        self.keyframes = [
            Keyframe(stamp + n * worlds.PERIOD_NS, 1, 10 + n, pose, worlds.CAMERA, BARE, metric)
            for n, pose in enumerate(T)
        ]
        self.sigmas = sigmas
        self.anchors = [self.anchor(n, pose) for n, pose in enumerate(self.truth)]

    def anchor(self, n, T_map_cam):
        k, noise = self.keyframes[n], SE3.exp(self.sigmas * self.rng.normal(size=6))
        return Anchor(k.id, k.session, k.stamp_ns, T_map_cam @ noise, np.diag(self.sigmas**2), 60, 60, 1.0)

    def told(self, wrong):
        """The anchors without the wrong ones."""
        return [None if w else a for a, w in zip(self.anchors, wrong, strict=True)]
