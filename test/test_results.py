"""docs/results.md: a picture and a sentence of each run, small enough to be kept."""

import re
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"


def test_each_run_says_at_once_whether_it_was_localized_and_how_good() -> None:
    text = (DOCS / "results.md").read_text()
    parts = text.split("\n## ")[1:]
    assert len(parts) == 4 == text.count("\n| ") - 1
    pictures = {path.name for path in (DOCS / "results").iterdir()}
    for part in parts:
        assert re.search(r"LOCALIZED for \d+ % of \d+ s", part) and ("The position error is" in part) == (
            not part.startswith("tango_loop")
        )
        (picture,) = re.findall(r"\]\(results/(\w+\.png)\)", part)
        assert (DOCS / "results" / picture).stat().st_size < 150_000
        pictures.remove(picture)
    assert not pictures
