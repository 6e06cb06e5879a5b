"""pyTheia's JSON of a reconstruction (WriteReconstructionJson of 1.2.1): poses, points and who sees them, for viewers.

It has no cameras and no pixels, so nothing reads a reconstruction back from it.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from xalign_ros.core.errors import MapError
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.text_files import write_text

NO_STAMP_S = -1.0  # pyTheia's, of a view that has none


def write_pytheia_json(reconstruction: Reconstruction, path: Path) -> None:
    """Estimated views by name with T_world_cam (4 x 4) and all that they see, estimated tracks by id.

    Raises MapError on a name used twice, FormatError where the file cannot be written.
    """
    r = reconstruction
    rows = np.flatnonzero(r.estimated)
    if len({r.names[v] for v in rows}) < len(rows):
        raise MapError(f"{path}: two views have the same name, which pyTheia's JSON cannot hold; make them differ.")
    track = np.repeat(np.arange(len(r.track_ids)), np.diff(r.offsets))
    views = {}
    for v in rows.tolist():
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = r.R[v], r.t[v]
        ids = r.track_ids[track[r.observing_views == v]].tolist()
        views[r.names[v]] = {
            "cameraExtrinsics": T.tolist(),
            "numFeatures": len(ids),
            "timestamp": NO_STAMP_S if r.stamps_ns is None else float(r.stamps_ns[v] / 1e9),
            "trackIds": ids,
        }
    tracks = {}
    for p in np.flatnonzero(r.track_estimated).tolist():
        seers = r.observing_views[r.offsets[p] : r.offsets[p + 1]]
        reference = int(r.view_ids[seers[0]]) if len(seers) else 2**32 - 1
        tracks[str(r.track_ids[p])] = {"point": r.points[p].tolist(), "referenceViewId": reference}
    write_text(path, [json.dumps({"tracks": tracks, "views": views}, separators=(",", ":")), "\n"])
