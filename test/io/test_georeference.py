"""Rows of name, latitude, longitude, height."""

import numpy as np
import pytest

from xalign_ros.core.errors import FormatError
from xalign_ros.io.georeference import read_georeference


def test_rows_blank_lines_and_comments(tmp_path) -> None:
    path = tmp_path / "gnss.txt"
    path.write_text("# name lat lon height\ncam0/1.jpg 48.1 11.5 520.25\n\n2 -33 -151.2 0 # Sydney\n")
    found = read_georeference(path)
    assert list(found) == ["cam0/1.jpg", "2"]
    np.testing.assert_array_equal(found["2"], [-33, -151.2, 0])


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("a 1 2", "is not name, latitude"),
        ("a 1 2 three", "not a name and three numbers"),
        ("a 91 2 3", "90 deg"),
        ("a 1 181 3", "180 deg"),
        ("a 1 2 nan", "is not name"),
        ("b 1 2 3", "already"),
    ],
)
def test_other_rows_are_refused_by_their_line(row, said, tmp_path) -> None:
    path = tmp_path / "gnss.txt"
    path.write_text(f"b 1 2 3\n{row}\n")
    with pytest.raises(FormatError, match=rf"gnss\.txt line 2: .*{said}"):
        read_georeference(path)
