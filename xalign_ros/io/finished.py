"""What a batch leaves behind for each log: NAME.tum, and last of all NAME.json, which says of what input it is the result.

So a folder can be worked on by many processes, and whatever was stopped in the middle is simply not finished.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from xalign_ros.core.errors import LogError
from xalign_ros.io.text_files import write_text
from xalign_ros.io.tum import Trajectory, write_tum

Row = dict[str, Any]


def fingerprint(log: Path, settings: Mapping[str, Any]) -> str:
    """sha256 over the bytes of a log, of each file of a folder with its name, and over the settings as JSON.

    Raises LogError where the log cannot be read.
    """
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    try:
        files = sorted(p for p in log.rglob("*") if p.is_file()) if log.is_dir() else [log]
        for path in files:
            with path.open("rb") as file:
                content = hashlib.file_digest(file, "sha256").digest()
            digest.update(str(path.relative_to(log)).encode() + b"\0" + content)
    except OSError as error:
        raise LogError(f"{log} cannot be read: {error.strerror}") from error
    return digest.hexdigest()


def read_finished(folder: Path, name: str, mark: str) -> Row | None:
    """The row of a log that is finished with this fingerprint, and whose trajectory is as it was written; else None."""
    try:
        row = json.loads((folder / f"{name}.json").read_text())
        return row if row["fingerprint"] == mark and row["trajectory_sha256"] == _digest(folder, name) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def write_finished(folder: Path, name: str, mark: str, trajectory: Trajectory, row: Row) -> Row:
    """Write both files, the JSON last; gives the row as it is written. Raises FormatError where that is not possible."""
    forget(folder, name)
    write_tum(folder / f"{name}.tum", trajectory)
    row = row | {"fingerprint": mark, "trajectory_sha256": _digest(folder, name)}
    write_text(folder / f"{name}.json", [json.dumps(row, allow_nan=False), "\n"])
    return row


def forget(folder: Path, name: str) -> None:
    """No results of this name: what stands there is of other input. The JSON goes first."""
    for suffix in (".json", ".tum"):
        (folder / f"{name}{suffix}").unlink(missing_ok=True)


def _digest(folder: Path, name: str) -> str:
    return hashlib.sha256((folder / f"{name}.tum").read_bytes()).hexdigest()
