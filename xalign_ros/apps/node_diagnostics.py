"""/diagnostics: localization (with the names that VDA 5050 has for it), inputs, resources."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from xalign_ros.apps.node_inputs import Input
from xalign_ros.core.records import AlignmentState, State
from xalign_ros.core.transforms import SE3
from xalign_ros.io import ros_fields as ros
from xalign_ros.io.ros_fields import ros_types

DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
OK, WARN, ERROR = (bytes([n]) for n in range(3))
CLOCK_S = 10.0  # between a stamp and the clock, beyond which one of the two is another time
PAGE = os.sysconf("SC_PAGE_SIZE")

Status = tuple[bytes, str, Mapping[str, Any]]  # level, message, key -> value


def localization(
    state: AlignmentState, map_id: str, map_version: str, T_map_base: SE3 | None, why_no_tf: str
) -> Status:
    """mobileRobotPosition of VDA 5050 3.0 and what it rests on; x, y and theta only while localized."""
    level = {State.LOCALIZED: OK, State.COASTING: WARN, State.LOST: ERROR}.get(state.state, WARN)
    values: dict[str, Any] = {"localized": str(state.localized).lower(), "localizationScore": f"{state.score:.3f}"}
    values |= {"mapId": map_id, "mapVersion": map_version}
    if state.localized and T_map_base is not None:
        theta = np.arctan2(T_map_base.R[1, 0], T_map_base.R[0, 0])
        values |= {"x": f"{T_map_base.t[0]:.3f}", "y": f"{T_map_base.t[1]:.3f}", "theta": f"{theta:.4f}"}
    values |= {
        "state": state.state.name,
        "since_anchor_s": f"{state.since_anchor_s:.2f}",
        "since_anchor_m": f"{state.since_anchor_m:.2f}",
        "anchors_accepted": state.anchors_accepted,
        "anchors_rejected": state.anchors_rejected,
        "scale_sigma": f"{state.scale_sigma:.4f}",
        "metric_scale": str(state.metric_scale).lower(),
        "tf": why_no_tf or "sent",
    }
    return level, f"{state.state.name}: {state.reason}", values


def inputs(
    found: Iterable[Input],
    rates: Mapping[str, float],
    silent_after_s: float,
    dropped: int,
    behind_s: float,
    active: bool,
    missing: str,
) -> Status:
    """`rates` in Hz; `behind_s` is the clock minus the newest keyframe's stamp, NaN before the first.

    `missing` is what images wait for, in words.
    """
    level, told, values = (WARN, [missing], dict[str, Any]()) if missing else (OK, [], {})
    found = list(found)
    newest_s = {part: max(one.last_s for one in found if one.part == part) for part in {one.part for one in found}}
    for one in found:
        values[f"{one.topic}: rate_hz"] = f"{rates.get(one.topic, 0.0):.1f}"
        values[f"{one.topic}: received"] = one.received
        values |= {f"{one.topic}: refused as {reason}": n for reason, n in one.refused.items()}
        if one.incompatible:
            level = ERROR
            told.append(f"a publisher of {one.topic} does not suit: QoS {one.incompatible}")
    for part, last_s in sorted(newest_s.items()):
        if active and part and (silent_s := time.monotonic() - last_s) > silent_after_s:
            level = max(level, WARN)
            told.append(f"no message for {silent_s:.0f} s on {part}")
    if abs(behind_s) > CLOCK_S:
        level = max(level, WARN)
        told.append(f"the stamps are {behind_s:.0f} s behind the clock; use_sim_time?")
    values["keyframes dropped under overload"] = dropped
    return level, "; ".join(told) or ("inputs arrive" if active else "not active"), values


def resources(pids: Iterable[int | None], waiting: int, step_s: float, restarts: int) -> Status:
    """Resident memory of the node's processes, how much waits, and how long the last step took."""
    values: dict[str, Any] = {
        name: f"{_resident_mb(pid):.0f}" for name, pid in zip(("node_mb", "alignment_mb"), pids, strict=True)
    }
    values |= {"keyframes_waiting": waiting, "step_ms": f"{1e3 * step_s:.1f}", "alignment_restarts": restarts}
    return (WARN, "the alignment's process died and was started anew", values) if restarts else (OK, "", values)


def _resident_mb(pid: int | None) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 1e6
    except (OSError, IndexError, ValueError):
        return float("nan")


def diagnostics_message(stamp_ns: int, name: str, map_id: str, parts: Mapping[str, Status]) -> Any:
    status, pair = (ros_types(f"diagnostic_msgs/msg/{n}") for n in ("DiagnosticStatus", "KeyValue"))
    array = ros_types(DIAGNOSTICS)(header=ros.header(ros_types, stamp_ns, ""))
    array.status = [
        status(
            level=level,
            name=f"{name}: {part}",
            message=told,
            hardware_id=map_id,
            values=[pair(key=key, value=str(value)) for key, value in values.items()],
        )
        for part, (level, told, values) in parts.items()
    ]
    return array
