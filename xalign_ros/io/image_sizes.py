"""The size of an image from its first bytes."""

from __future__ import annotations

import warnings
from pathlib import Path

from PIL import Image


def image_size(path: Path) -> tuple[int, int] | None:
    """Width and height (px) as stored, not turned by what EXIF says; None where there is no image."""
    try:
        with warnings.catch_warnings():  # of many pixels, none of which is read
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                return image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):  # what Pillow raises on what is none
        return None
