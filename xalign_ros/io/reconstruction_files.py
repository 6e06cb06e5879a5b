"""A reconstruction from a path and back: a name's ending says the format, else a folder is COLMAP's, a file pyTheia's."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from xalign_ros.core.errors import MapError
from xalign_ros.core.reconstruction import Reconstruction
from xalign_ros.io.bundler import list_path, read_bundler, write_bundler
from xalign_ros.io.colmap import read_model, write_model
from xalign_ros.io.colmap_conversion import model_of_reconstruction, reconstruction_of_model
from xalign_ros.io.nvm import read_nvm, write_nvm
from xalign_ros.io.ply import write_ply
from xalign_ros.io.pytheia_binary import read_pytheia
from xalign_ros.io.pytheia_json import write_pytheia_json
from xalign_ros.io.pytheia_writer import write_pytheia
from xalign_ros.io.view_lists import Tell

READERS: dict[str, Callable[[Path, Tell], Reconstruction]] = {".nvm": read_nvm, ".out": read_bundler}
WRITERS: dict[str, Callable[[Reconstruction, Path, Tell], None]] = {
    ".json": lambda reconstruction, path, tell: write_pytheia_json(reconstruction, path),
    ".nvm": write_nvm,
    ".out": write_bundler,
    ".ply": lambda reconstruction, path, tell: write_ply(reconstruction, path),
}


def nobody(words: str) -> None:
    """Whom to tell where nobody listens."""


def read_reconstruction(path: Path, tell: Tell = nobody) -> Reconstruction:
    """`tell` gets a sentence for each thing that the file does not say and that had to be assumed.

    Raises MapError on what is no reconstruction, is damaged, or has a camera that xalign has not.
    """
    if not path.exists():
        raise MapError(f"{path}: there is nothing; give the folder of a COLMAP model or the file of a reconstruction")
    if not path.is_dir():
        if path.suffix in READERS:
            return READERS[path.suffix](path, tell)
        if path.suffix in WRITERS:
            raise MapError(f"{path}: {path.suffix[1:].upper()} is written only, it holds no observations")
        return read_pytheia(path)
    try:
        return reconstruction_of_model(read_model(path))
    except ValueError as error:
        raise MapError(f"{path}: {error}; make the model with another camera model") from error


def as_folder(path: Path) -> bool:
    """Whether what a reconstruction at `path` becomes is COLMAP's folder, where its name says nothing: all but pyTheia's."""
    return path.is_dir() or path.suffix in READERS


def refuse_existing(path: Path) -> None:
    """Raises MapError where something is there that an output of this name would replace."""
    for there in (path, *([list_path(path)] if path.suffix == ".out" else [])):
        if there.exists():
            raise MapError(f"{there} exists; give another name or --force to replace it")


def write_reconstruction(
    reconstruction: Reconstruction, path: Path, *, folder: bool, force: bool = False, tell: Tell = nobody
) -> None:
    """In the format that the name ends in, else as COLMAP's binary model in a folder, or as pyTheia's file.

    It gets its name when it is complete. `tell` gets a sentence for what the format bends. Raises MapError where
    something is there already without `force`, and on what the format cannot hold.
    """
    if not force:
        refuse_existing(path)
    if reconstruction.at_infinity is not None and (folder or path.suffix in WRITERS):
        finite = ~reconstruction.at_infinity
        tell(f"{(~finite).sum()} tracks are at infinity, where only pyTheia's files have points; they are left out")
        kept = reconstruction.track_estimated & finite
        reconstruction = replace(reconstruction, track_estimated=kept, at_infinity=None)
    if path.suffix not in WRITERS and folder:
        _write_colmap(reconstruction, path)
    elif path.is_dir():
        raise MapError(f"{path} is a folder, which a file cannot replace; give another name")
    elif path.suffix in WRITERS:
        WRITERS[path.suffix](reconstruction, path, tell)
    else:
        write_pytheia(reconstruction, path)


def _write_colmap(reconstruction: Reconstruction, path: Path) -> None:
    try:
        model = model_of_reconstruction(reconstruction)
    except ValueError as error:
        raise MapError(f"{path}: {error}; give OUT the name of another format") from error
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
