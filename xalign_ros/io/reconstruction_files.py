"""A reconstruction from a path and back: a name's ending says the format, else a folder is COLMAP's, a file pyTheia's."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from xalign_ros.core.errors import MapError
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.colmap import read_model, write_model
from xalign_ros.io.colmap_conversion import model_of_reconstruction, reconstruction_of_model
from xalign_ros.io.ply import write_ply
from xalign_ros.io.pytheia_binary import read_pytheia
from xalign_ros.io.pytheia_json import write_pytheia_json
from xalign_ros.io.pytheia_writer import write_pytheia

WRITERS: dict[str, Callable[[Reconstruction, Path], None]] = {".json": write_pytheia_json, ".ply": write_ply}


def read_reconstruction(path: Path) -> Reconstruction:
    """Raises MapError on what is neither, is damaged, or has a camera that xalign has not."""
    if not path.exists():
        raise MapError(f"{path}: there is nothing; give the folder of a COLMAP model or a file of pyTheia")
    if not path.is_dir():
        if path.suffix in WRITERS:
            raise MapError(f"{path}: {path.suffix[1:].upper()} is written only, it holds no observations")
        return read_pytheia(path)
    try:
        return reconstruction_of_model(read_model(path))
    except ValueError as error:
        raise MapError(f"{path}: {error}; make the model with another camera model") from error


def write_reconstruction(reconstruction: Reconstruction, path: Path, *, folder: bool, force: bool = False) -> None:
    """In the format that the name ends in, else as COLMAP's binary model in a folder, or as pyTheia's file.

    It gets its name when it is complete. Raises MapError where something is there already without `force`, and on what
    the format cannot hold.
    """
    if path.exists() and not force:
        raise MapError(f"{path} exists; give another name or --force to replace it")
    write = WRITERS.get(path.suffix, None if folder else write_pytheia)
    if write is not None:
        if path.is_dir():
            raise MapError(f"{path} is a folder, which a file cannot replace; give another name")
        write(reconstruction, path)
    else:
        _write_colmap(reconstruction, path)


def _write_colmap(reconstruction: Reconstruction, path: Path) -> None:
    try:
        model = model_of_reconstruction(reconstruction)
    except ValueError as error:
        raise MapError(f"{path}: {error}; give OUT the name of a file for pyTheia's format") from error
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        write_model(model, temporary, binary=True)
        if path.is_dir():
            shutil.rmtree(path)
        elif path.exists():
            path.unlink()
        os.replace(temporary, path)
    except OSError as error:
        raise MapError(f"{path} cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
