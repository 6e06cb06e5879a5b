"""One log of a batch, as a worker takes it: read, smoothed, written; its row says what came of it."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import xalign_ros
from xalign_ros.core.config import Config, options
from xalign_ros.core.errors import MapError, XalignError
from xalign_ros.core.reference_map import ReferenceMap
from xalign_ros.core.status import position_sigma
from xalign_ros.core.whole_run import Arrival, SmoothedRun, smooth
from xalign_ros.io.adapter import SourceOptions
from xalign_ros.io.adapter_log import Chosen, log_keyframes
from xalign_ros.io.finished import Row, fingerprint, forget, read_finished, write_finished
from xalign_ros.io.log import Log
from xalign_ros.io.tum import Trajectory
from xalign_ros.io.xmap import read_map

MAPS_OPEN = 2  # of a worker
EMPTY: Row = {
    "status": "failed",
    "keyframes": None,
    "poses": None,
    "coverage": None,
    "sessions": None,
    "sessions_locked": None,
    "anchors": None,
    "anchors_found": None,
    "anchors_dropped": None,
    "position_sigma_m": None,
    "scale_min": None,
    "scale_max": None,
    "seconds": None,
    "words": "",
}


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """A log and all that its result depends on; paths are absolute, since a worker may stand elsewhere."""

    log: Path
    name: str
    folder: Path
    map: Path
    map_version: str
    config: Config
    source: SourceOptions
    chosen: Chosen
    xalign: str = xalign_ros.__version__

    def settings(self) -> dict[str, Any]:
        """Of the fingerprint, as JSON has it."""
        s, T = self.source, self.source.T_base_cam
        camera = s.camera
        return {
            "xalign": self.xalign,
            "map": self.map_version,
            "options": {key: value for key, value, _ in options(self.config)},
            "source": [s.kind, s.features, s.metric_scale, s.odom_frame],
            "camera": camera and [camera.model, camera.K.tolist(), camera.D.tolist(), camera.width, camera.height],
            "base_from_cam": T and [T.R.tolist(), T.t.tolist()],
            "topics": list(self.chosen),
        }


def work(job: Job) -> Row:
    """Never raises: what went wrong is the row's, in words."""
    try:
        return done(job)
    except XalignError as error:
        words = str(error)
    except Exception as error:  # a fault of ours is this log's row, and no reason to lose the others
        words = f"{job.log}: unexpected {type(error).__name__}: {error}"
    forget(job.folder, job.name)
    return failed(job, words)


def failed(job: Job, words: str) -> Row:
    return EMPTY | {"log": str(job.log), "words": " ".join(words.split())}


def done(job: Job) -> Row:
    """The row of a log that is finished, or is now. Raises XalignError on bad input."""
    if job.xalign != xalign_ros.__version__:
        raise MapError(f"a worker has xalign {xalign_ros.__version__}, this is {job.xalign}; give all the same")
    mark = fingerprint(job.log, job.settings())
    if row := read_finished(job.folder, job.name, mark):
        return row | {"status": "unchanged", "log": str(job.log)}
    start = time.perf_counter()
    map_ = opened(job.map, job.map_version)
    with Log(job.log) as log:
        smoothed = smooth(_arrivals(log, job, map_), map_, job.config)
    row = EMPTY | _row(job, smoothed) | {"seconds": round(time.perf_counter() - start, 3)}
    R, t = (np.array([getattr(T, part) for T in smoothed.T_map_cam]) for part in ("R", "t"))
    stamps = np.array(smoothed.stamps_ns, np.int64)
    return write_finished(job.folder, job.name, mark, Trajectory(stamps, R.reshape(-1, 3, 3), t.reshape(-1, 3)), row)


@functools.lru_cache(MAPS_OPEN)
def opened(path: Path, version: str) -> ReferenceMap:
    """The map, once per process; its arrays stay on disk until they are used, and are shared by all processes there."""
    map_ = read_map(path)
    if map_.version != version:
        raise MapError(f"{path} is version {map_.version} where a worker sees it, not {version}; give all the same map")
    return map_


def _arrivals(log: Log, job: Job, map_: ReferenceMap) -> Iterator[Arrival]:
    for _, keyframe, fault in log_keyframes(log, job.source, job.config.selection, map_, job.chosen):
        yield keyframe, fault


def _row(job: Job, run: SmoothedRun) -> Row:
    sigma = [position_sigma(cov) for cov in run.cov_cam]
    low, high = run.scale or (None, None)
    return {
        "status": "done",
        "log": str(job.log),
        "keyframes": run.keyframes,
        "poses": len(run.stamps_ns),
        "coverage": len(run.stamps_ns) / run.keyframes if run.keyframes else 0.0,
        "sessions": run.chains,
        "sessions_locked": run.chains_locked,
        "anchors": run.anchors,
        "anchors_found": run.anchors_found,
        "anchors_dropped": run.anchors_dropped,
        "position_sigma_m": float(np.median(sigma)) if sigma else None,
        "scale_min": low,
        "scale_max": high,
        "words": run.reason,
    }
