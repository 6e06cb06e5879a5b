"""A run to report on, its map, and the page that came of it, taken apart."""

from html.parser import HTMLParser

import numpy as np

from xalign_ros.core import lie
from xalign_ros.core.camera import Camera
from xalign_ros.core.evaluation import summarize, summarize_errors
from xalign_ros.core.records import (
    AlignmentState,
    Anchor,
    Correction,
    Norm,
    Rejection,
    State,
    Step,
)
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.transforms import SE3, Sim3
from xalign_ros.io.report import write_report

STEP_NS = 500_000_000
START_NS = 1_403_636_579_763_555_584
PICTURES = {"top_view.png", "space_view.png", "error.png", "scale.png", "anchors.png", "step_time.png"}
LEVEL = SE3(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3))  # T_map_cam looking along y, z up
U, C, L, G, X = State.UNINITIALIZED, State.CANDIDATE, State.LOCALIZED, State.COASTING, State.LOST
STORY = [U, C, C] + 12 * [L] + 5 * [G] + 4 * [X] + 8 * [L]
VOID = {"meta", "img", "br", "hr", "link", "input"}


def a_map(*, metric=True, look=LEVEL, n=9):
    rng = np.random.default_rng(3)
    none = np.zeros((0, 1), np.uint8)
    where = np.c_[np.linspace(0, 10, n), np.zeros(n), np.zeros(n)] @ (look.R @ LEVEL.R.T).T
    camera = Camera("radtan", [400.0, 400, 320, 240], [], 640, 480)
    return ReferenceMap(
        map_id="street",
        version="0123abc",
        frame="map",
        metric=metric,
        source="a test",
        descriptor_name="orb",
        norm=Norm.HAMMING,
        cameras=(camera,),
        points=rng.uniform(-4, 14, (200, 3)),
        point_cov=np.zeros((200, 3, 3), np.float32),
        descriptors=np.zeros((200, 1), np.uint8),
        keyframe_R=np.repeat(look.R[None], n, axis=0),
        keyframe_t=where,
        keyframe_camera=np.zeros(n, int),
        feature_offset=np.zeros(n + 1, int),
        feature_uv=np.zeros((0, 2), np.float32),
        feature_descriptors=none,
        feature_point=np.zeros(0, int),
        sigma_px=1.0,
        descriptor_gate=10.0,
    )


def a_run(story=STORY, *, session=0):
    """(steps, step_s, odometry, truth): half a circle of radius 5 m; poses are 3 cm off in z, odometry half as long."""
    S = Sim3(lie.so3_exp([0.1, 0.2, 0.3]), np.array([1.0, 2, 3]), 2.0)
    steps, odometry, truth = [], [], []
    for n, state in enumerate(story):
        angle = np.pi * n / max(len(story), 2)
        T = SE3(LEVEL.R, np.array([5 - 5 * np.cos(angle), 5 * np.sin(angle), 0.0]))
        seen = SE3(T.R, T.t + np.array([0, 0, 0.03]))
        who = (n, session, START_NS + n * STEP_NS)
        cov = np.diag([1e-4] * 3 + [4e-4] * 3) * (1 + 3 * (state is G))
        anchor = Anchor(*who, seen, cov, 90 + n, 60 + n, 1.0 + 0.01 * n)
        reason = {U: "too_few_matches", C: "inconsistent", L: None, G: "too_few_inliers", X: "bad_pixel"}[state]
        refused = Rejection(*who, reason, "why", 50, 20, 2.0, 0.0, anchor if state is C else None) if reason else None
        known = state in (L, G, X)
        steps.append(
            Step(
                *who,
                AlignmentState(
                    state=state,
                    reason="2 anchors wait for <others>",
                    score=0.5,
                    session=session,
                    stamp_ns=who[2],
                    S_map_odom=S if known else None,
                    scale_sigma=0.02 if known else np.nan,
                    metric_scale=known,
                    since_anchor_s=0.0,
                    since_anchor_m=0.0,
                    keyframes=n + 1,
                    anchors_accepted=0,
                    anchors_rejected=0,
                    window=0,
                ),
                Correction(*who, S, np.eye(7) * 1e-4, seen, cov) if state in (L, G) else None,
                anchor if reason is None else None,
                refused,
            )
        )
        odometry.append((S.inverse() @ T).rigid_pose())
        truth.append(T)
    return steps, [0.004 + 0.0001 * n for n in range(len(story))], odometry, truth


def write(folder, run=None, *, truth=True, map_=None, title="run.mcap", **more):
    steps, step_s, odometry, true = run or a_run()
    result = summarize(steps, step_s, "ab" * 32)
    if truth:
        result |= summarize_errors(steps, odometry, true)
    result |= more
    write_report(folder, result, steps, step_s, odometry, true if truth else None, map_ or a_map(), title)
    return result


class Page(HTMLParser):
    """Tags with their attributes, the text, and whether every tag was closed in order."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words, self.open = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.words.append(data)


def page_of(folder):
    return Page((folder / "index.html").read_text("utf-8"))


def texts(figure):
    return [t.get_text() for legend in figure.legends for t in legend.get_texts()]
