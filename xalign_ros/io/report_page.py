"""What all reports have in common: a page that loads nothing and runs nothing, in a folder with its pictures as PNG."""

from __future__ import annotations

import json
import tempfile
from base64 import b64encode
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any

from xalign_ros.core.errors import FormatError

MARK = '<meta name="generator" content="xalign_ros report">'
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">{mark}<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title} – xalign report</title><style>:root{{color-scheme:light}}
body{{margin:0 auto;max-width:46rem;padding:2rem 1rem 4rem;font:1rem/1.5 system-ui,sans-serif;color:#222}}
h1,h2{{font-weight:600;line-height:1.2;margin:2.5rem 0 .75rem}} h1{{font-size:1.75rem;margin-top:0}}
h2{{font-size:1.25rem}} h1,p,th,td{{overflow-wrap:anywhere}} .lead{{font-size:1.125rem}}
table{{border-collapse:collapse;width:100%}} th,td{{border-top:1px solid #e4e4e4;padding:.4rem 0;vertical-align:top}}
th{{font-weight:400;padding-right:1rem;text-align:left;width:68%}} small{{display:block}} td code{{font-size:.8125rem}}
td{{font-variant-numeric:tabular-nums;text-align:right}} small,figcaption,.quiet{{color:#5f5f5f}}
i{{border-radius:2px;display:inline-block;height:.7rem;width:.7rem}}
svg{{border-radius:3px;display:block;height:1.25rem;margin:1.25rem 0 .75rem;width:100%}}
.side td{{padding-left:.75rem}} .side th{{width:auto}} figure{{margin:2.5rem 0 0}} img{{display:block;height:auto;width:100%}}
</style></head><body>
{body}
</body></html>
"""


def filled(title: str, parts: Iterable[str]) -> str:
    """The page of a title and of parts in HTML, empty ones left out."""
    return PAGE.format(mark=MARK, title=escape(title), body="\n".join(filter(None, parts)))


def picture(name: str, png: bytes, caption: str) -> str:
    """A picture within the page; the caption in HTML."""
    source = f"data:image/png;base64,{b64encode(png).decode()}"
    return f'<figure><img src="{source}" alt="{escape(name)}"><figcaption>{caption}</figcaption></figure>'


def check_report_folder(folder: Path) -> None:
    """A report goes where nothing is yet, or only an empty folder or a report. Raises FormatError elsewhere."""
    page = folder / "index.html"
    if not folder.resolve().parent.is_dir():
        raise FormatError(f"there is no folder {folder.parent} to write the report {folder.name} to")
    if folder.exists() and not folder.is_dir():
        raise FormatError(f"{folder} is a file; name a folder for the report")
    ours = page.is_file() and MARK in page.read_text(errors="replace")
    if folder.exists() and any(folder.iterdir()) and not ours:
        raise FormatError(f"{folder} is neither empty nor a report that could be replaced; name another folder")


def write_folder(folder: Path, page: str, result: Any, pictures: Mapping[str, bytes]) -> None:
    """Write index.html, result.json and the pictures; an existing report is replaced with all that its folder holds.

    Raises FormatError where the folder holds anything else or cannot be written; nothing is left of a failed report.
    """
    place = folder.resolve()
    files = {**pictures, "index.html": page.encode("utf-8", "replace")}
    files["result.json"] = (json.dumps(result, indent=2, allow_nan=False) + "\n").encode()
    try:
        check_report_folder(folder)
        with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.parent) as box:
            new, old = Path(box, "new"), Path(box, "old")
            new.mkdir()
            for name, content in files.items():
                (new / name).write_bytes(content)
            if place.exists():
                place.rename(old)
            try:
                new.rename(place)
            except OSError:
                if old.exists():
                    old.rename(place)
                raise
    except OSError as e:
        raise FormatError(f"the report {folder} cannot be written: {e.strerror}") from e
