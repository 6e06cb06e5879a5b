"""The .xmap folder: map.yaml and memory-mapped .npy arrays. No pickle; written to a temporary name and renamed."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import DTypeLike

from xalign_ros.core.camera import Camera
from xalign_ros.core.errors import MapError
from xalign_ros.core.records import Norm
from xalign_ros.core.reference_map import MapIndex, ReferenceMap, Visibility
from xalign_ros.core.transforms import Sim3
from xalign_ros.core.vocabulary import Vocabulary

FORMAT = 3
ARRAYS = {
    "points": "<f8",
    "point_cov": "<f4",
    "descriptors": None,  # by the norm
    "keyframe_R": "<f8",
    "keyframe_t": "<f8",
    "keyframe_camera": "<i4",
    "feature_offset": "<i8",
    "feature_uv": "<f4",
    "feature_descriptors": None,
    "feature_point": "<i4",
}
VISIBILITY: dict[str, str | None] = {
    "point_keyframe": "<i4",
    "point_offset": "<i8",
    "keyframe_point": "<i4",
    "keyframe_offset": "<i8",
    "median_depth": "<f8",
    "view": "<f4",
    "distances": "<f4",
}
VOCABULARY: dict[str, str | None] = {
    "coarse": "<f4",
    "fine": "<f4",
    "word_offset": "<i8",
    "word_point": "<i4",
    "code": None,
}  # of code: by its width

SIGMAS = ("rotation_rad", "translation_m")
GEOREFERENCE = ("latitude_deg", "longitude_deg", "height_m")


def write_map(map_: ReferenceMap, folder: Path, *, force: bool = False) -> str:
    """Write a map; returns its version, from the arrays' checksums. Raises MapError where `folder` exists, unless forced."""
    folder = Path(folder)
    if folder.exists() and not force:
        raise MapError(f"{folder} exists; give another name or --force to replace it")
    if not folder.parent.is_dir():
        raise MapError(f"there is no folder {folder.parent} to write {folder.name} to")
    work = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        work.chmod(0o755)
        arrays = {n: _write_array(work, n, getattr(map_, n), k or map_.norm.dtype) for n, k in ARRAYS.items()}
        version = hashlib.sha256("".join(a["sha256"] for a in arrays.values()).encode()).hexdigest()[:12]
        index = MapIndex(map_)
        for part, kinds in ((index.visibility, VISIBILITY), (index.vocabulary, VOCABULARY)):
            arrays |= {n: _write_array(work, n, getattr(part, n), k) for n, k in kinds.items()}
        header = _header(map_, version, arrays)
        (work / "map.yaml").write_text(yaml.safe_dump(header, sort_keys=False, width=120))
        if folder.exists():
            shutil.rmtree(folder) if folder.is_dir() and not folder.is_symlink() else folder.unlink()
        work.rename(folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return version


def _write_array(work: Path, name: str, array: np.ndarray, kind: DTypeLike | None) -> dict[str, Any]:
    a = np.ascontiguousarray(array, kind)
    path = work / f"{name}.npy"
    np.save(path, a, allow_pickle=False)
    return {"dtype": a.dtype.str, "shape": list(a.shape), "sha256": _checksum(path)}


def _header(map_: ReferenceMap, version: str, arrays: dict[str, Any]) -> dict[str, Any]:
    S = map_.S_map_refmap
    return {
        "format": FORMAT,
        "id": map_.map_id,
        "version": version,
        "frame": map_.frame,
        "metric": bool(map_.metric),
        "source": map_.source,
        "points": len(map_.points),
        "keyframes": len(map_.keyframe_t),
        "features": len(map_.feature_uv),
        "descriptor": {"name": map_.descriptor_name, "norm": map_.norm.name, "gate": float(map_.descriptor_gate)},
        "sigma_px": float(map_.sigma_px),
        **{n: dict(zip(SIGMAS, map(float, getattr(map_, n)), strict=True)) for n in ("anchor_sigma", "keyframe_sigma")},
        "T_map_refmap": {"rotation": S.R.tolist(), "translation": S.t.tolist(), "scale": S.s},
        "georeference": dict(zip(GEOREFERENCE, map_.georeference, strict=True)) if map_.georeference else None,
        "cameras": [
            {"model": c.model, "K": c.K.tolist(), "D": c.D.tolist(), "width": c.width, "height": c.height}
            for c in map_.cameras
        ],
        "arrays": arrays,
    }


def read_map(folder: Path, *, verify: bool = False) -> ReferenceMap:
    """Open a map; arrays stay on disk until they are used. `verify` reads them through and compares their checksums.

    Raises MapError saying which file is missing, malformed or changed.
    """
    folder = Path(folder)
    header = read_header(folder)
    arrays, seen, words = (
        {name: _read_array(folder, name, header, verify) for name in names}
        for names in (ARRAYS, VISIBILITY, VOCABULARY)
    )
    try:
        S, d = header["T_map_refmap"], header["descriptor"]
        return ReferenceMap(
            map_id=str(header["id"]),
            version=str(header["version"]),
            frame=str(header["frame"]),
            metric=bool(header["metric"]),
            source=str(header["source"]),
            descriptor_name=str(d["name"]),
            norm=Norm[d["norm"]],
            descriptor_gate=float(d["gate"]),
            cameras=tuple(Camera(c["model"], c["K"], c["D"], c["width"], c["height"]) for c in header["cameras"]),
            sigma_px=float(header["sigma_px"]),
            anchor_sigma=_sigmas(header["anchor_sigma"]),
            keyframe_sigma=_sigmas(header["keyframe_sigma"]),
            S_map_refmap=Sim3(np.array(S["rotation"]), np.array(S["translation"]), S["scale"]),
            georeference=_origin(header.get("georeference")),
            **arrays,
            visibility=Visibility(**seen),
            vocabulary=Vocabulary(**words),
        )
    except (KeyError, TypeError, ValueError) as e:
        raise MapError(f"{folder / 'map.yaml'} does not describe a map ({e!r}); build the map anew") from None


def _origin(earth: dict[str, float] | None) -> tuple[float, float, float] | None:
    if earth is None:
        return None
    latitude, longitude, height = (float(earth[name]) for name in GEOREFERENCE)
    return latitude, longitude, height


def read_header(folder: Path) -> dict[str, Any]:
    """map.yaml as it stands. Raises MapError."""
    path = Path(folder) / "map.yaml"
    if not path.is_file():
        raise MapError(f"{folder} is not a map: it has no map.yaml; make one with 'xalign map build'")
    try:
        header = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError):
        raise MapError(f"{path} is not readable YAML; build the map anew") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        have = header.get("format") if isinstance(header, dict) else None
        raise MapError(f"{path} has format {have}, this version reads format {FORMAT}; build the map anew")
    return header


def _sigmas(entry: dict[str, Any]) -> tuple[float, float]:
    rotation, translation = (float(entry[name]) for name in SIGMAS)
    return rotation, translation


def _read_array(folder: Path, name: str, header: dict[str, Any], verify: bool) -> np.ndarray:
    path = folder / f"{name}.npy"
    try:
        want = header["arrays"][name]
        shape, dtype, checksum = tuple(want["shape"]), str(want["dtype"]), str(want["sha256"])
    except (KeyError, TypeError):
        raise MapError(f"{folder / 'map.yaml'} does not list array {name}; build the map anew") from None
    try:
        # An array of no elements cannot be mapped.
        a = np.load(path, mmap_mode="r" if 0 not in shape else None, allow_pickle=False)
    except FileNotFoundError:
        raise MapError(f"{path} is missing; build the map anew") from None
    except (ValueError, OSError, EOFError):
        raise MapError(f"{path} is cut short or not an array; build the map anew") from None
    if a.shape != shape or a.dtype.str != dtype:
        raise MapError(f"{path} holds {a.dtype.str} {a.shape}, map.yaml says {dtype} {shape}; build the map anew")
    if verify and _checksum(path) != checksum:
        raise MapError(f"{path} does not match its checksum in map.yaml; it was changed or damaged, build the map anew")
    return a


def _checksum(path: Path) -> str:
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()
