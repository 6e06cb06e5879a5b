"""Tiepoint files: all types, both formats, what is left out and what is refused."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from xalign_ros.core.errors import FormatError
from xalign_ros.core.ties import Frame, Ties
from xalign_ros.io.vicar_ties import read_ties
from xalign_ros.io.vicar_ties_old import write_ties_old
from xalign_ros.io.vicar_ties_xml import write_ties_xml

HEAD = '<?xml version="1.0"?>\n<tiepoint_file version="1.0">\n<tiepoint_set>\n'
IMAGES = '<images><image unique_id="A" key="5"/><image unique_id="B" key="6"/></images>\n'
TIE = '<left line="1" samp="2"/><right line="3" samp="4"/><flags quality="1" interactive="0"/>'
TAIL = "</tiepoint_set>\n</tiepoint_file>\n"


def same(a: Ties, b: Ties) -> None:
    for f in fields(Ties):
        if f.name != "notes":
            x, y = getattr(a, f.name), getattr(b, f.name)
            if isinstance(x, np.ndarray):
                np.testing.assert_array_equal(x, y, err_msg=f.name)
            else:
                assert x == y, f.name


def read(tmp_path: Path, text: str) -> Ties:
    path = tmp_path / "t.tpt"
    path.write_text(text)
    return read_ties(path)


def test_all_types_of_the_recorded_file(data_dir: Path) -> None:
    ties = read_ties(data_dir / "vicar/examples/all_tie_types.tpt")
    assert ties.type.tolist() == [*range(11), 0]
    assert ties.images == ("IMG_A", "IMG_B", "IMG_C") and ties.frames == (Frame("SITE", (3,)),)
    assert ties.left.tolist() == [0] * 11 + [1] and ties.right.tolist() == [1, -1, 1, 1, -1, -1, -1, -1, 1, 1, 1, 2]
    assert ties.left_px[0].tolist() == [356.2353, 53.43125] and ties.right_px[0].tolist() == [44.43252, 634.4556]
    assert ties.xyz[1].tolist() == [0.43156, 1.3455, -0.65425] and ties.xyz[8, 2] == -0.387
    assert ties.xyz[4, :2].tolist() == [550.3551, -215.5531] and ties.angle_deg[[2, 6, 7]].tolist() == [
        22.5316,
        54.5312,
        65.5315,
    ]
    assert ties.residual_px[8] == 1.5 and ties.track[10] == 4 and np.isnan(ties.projected_px[9]).all()
    assert ties.of_two.tolist() == [t in (0, 8, 9, 10) for t in ties.type]


@pytest.mark.parametrize(
    "name", ["examples/all_tie_types.tpt", "examples/cattp_doc_example.tpt", "nav/marsnav2_ext_tie_sample.tpt"]
)
def test_what_is_written_reads_back_the_same(name: str, data_dir: Path, tmp_path: Path) -> None:
    ties = read_ties(data_dir / "vicar" / name)
    out = tmp_path / "out.tpt"
    assert ties.images is not None
    write_ties_xml(out, ties, ties.images, start_key=40)
    again = read_ties(out)
    rows = np.lexsort((np.arange(len(ties)), ties.frame))  # a set for each frame
    same(ties.take(rows), again)
    assert 'key="40"' in out.read_text()


def test_old_and_xml_convert_into_each_other(data_dir: Path, tmp_path: Path) -> None:
    folder = data_dir / "vicar/examples/synth4"
    xml, old = read_ties(folder / "ties.tpt"), read_ties(folder / "ties_old_v2.txt")
    for name in ("left", "right", "left_px", "right_px", "projected_px", "quality"):
        np.testing.assert_array_equal(getattr(xml, name), getattr(old, name))
    write_ties_old(tmp_path / "old.txt", xml)
    assert (tmp_path / "old.txt").read_text().split() == (folder / "ties_old_v2.txt").read_text().split()
    write_ties_xml(tmp_path / "new.tpt", old, ("a", "b", "c", "d"))
    np.testing.assert_array_equal(read_ties(tmp_path / "new.tpt").left_px, xml.left_px)


def test_old_files_of_both_versions(data_dir: Path) -> None:
    one, two = (read_ties(data_dir / f"vicar/examples/old_v{n}.txt") for n in (1, 2))
    same(one, two)
    assert one.left.tolist() == [0, 1] and one.interactive.tolist() == [0, 1] and one.images is None
    assert one.left_px[0].tolist() == [356.2353, 53.43125]


def test_numbers_keep_all_their_digits(tmp_path: Path) -> None:
    ties = read(tmp_path, HEAD + IMAGES + f'<tie type="0" left_key="5" right_key="6">{TIE}</tie>' + TAIL)
    px = np.array([[np.pi, 1e-7 / 3]])
    more = Ties(**{f.name: px if f.name == "left_px" else getattr(ties, f.name) for f in fields(Ties)})
    write_ties_xml(tmp_path / "x.tpt", more, ("A", "B"))
    np.testing.assert_array_equal(read_ties(tmp_path / "x.tpt").left_px, px)


def test_aliases_duplicates_and_either_spelling_of_angles(tmp_path: Path) -> None:
    images = (
        '<images><image unique_id="A" key="1"/><image unique_id="a" key="2"/><image unique_id="B" key="3"/>'
        '<image unique_id="C" key="3"/></images>\n'
    )
    ties = read(
        tmp_path,
        HEAD + images + f'<tie type="0" left_key="1" right_key="3">{TIE}</tie>'
        f'<tie type="0" left_key="2" right_key="3">{TIE}</tie>'
        '<tie type="6" left_key="1"><azimuth degrees="7"/><left line="1" samp="2"/>'
        '<flags quality="1" interactive="0"/></tie>' + TAIL,
    )
    assert ties.left.tolist() == [0, 0, 0] and ties.right.tolist() == [1, 1, -1] and ties.angle_deg[2] == 7
    assert ties.images == ("A", "B") and "DUPLICATE KEY" in ties.notes[0]


@pytest.mark.parametrize(
    ("tie", "words"),
    [
        ('<tie type="0" left_key="5" right_key="6"><left line="1" samp="2"/></tie>', "no <flags>"),
        (f'<tie type="12" left_key="5">{TIE}</tie>', "type 12"),
        (f'<tie type="0" left_key="5">{TIE}</tie>', "no right_key"),
        (f'<tie type="0" left_key="x" right_key="6">{TIE}</tie>', "'x' is no number"),
        (f'<tie type="0" left_key="5" right_key="6">{TIE.replace("3", "nan")}</tie>', "nan"),
        (f'<tie type="8" left_key="5" right_key="6">{TIE}</tie>', "no <z>"),
        (f'<tie type="0" left_key="5" right_key="9">{TIE}</tie>', "keys that no <image>"),
    ],
)
def test_a_bad_tie_is_left_out_with_its_reason(tie: str, words: str, tmp_path: Path) -> None:
    good = f'<tie type="0" left_key="5" right_key="6">{TIE}</tie>'
    ties = read(tmp_path, HEAD + IMAGES + tie + good + TAIL)
    assert len(ties) == 1 and words in ties.notes[0]
    with pytest.raises(FormatError, match="no ties"):
        read(tmp_path, HEAD + IMAGES + tie + TAIL)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEAD + IMAGES, "line 5: no element found"),
        (HEAD + "<images></tiepoint_set>", "line 4: mismatched tag"),
        ('<?xml version="1.0"?>\n<!DOCTYPE a [<!ENTITY b "c">]>\n<tiepoint_file/>', "line 2: a DOCTYPE"),
        ('<?xml version="1.0"?>\n<other/>', "line 2: <other> where <tiepoint_file> begins"),
        (HEAD + '<images><image key="1"/></images>' + TAIL, "line 4: <image> has no unique_id"),
        ('<?xml version="1.0" encoding="klingon"?><tiepoint_file/>', "line 1: unknown encoding"),
        ("", "begins no tiepoint file"),
        ("hello\n1\n", "line 1: 'hello' begins no tiepoint file"),
        ("mars_tiepoint_list v2\nx\n", "line 2: here must be the number of ties"),
        ("mars_tiepoint_list v2\n0\n", "has no ties"),
        ("mars_tiepoint_list v2\n2\n0 1 1 1 1 1 1 1 1 0\n", "announces 2 ties and has 1"),
        ("mars_tiepoint_list v2\n1\n0 1 1 1 1 1 1 1\n", "line 3: 8 numbers"),
        ("mars_tiepoint_list v2\n1\n0 1 1 a 1 1 1 1 1 0\n", "line 3: .* are not all numbers"),
        ("mars_tiepoint_list v2\n1\n0 -1 1 1 1 1 1 1 1 0\n", "line 3: .* is no tie"),
        ("mars_tiepoint_list v2\n1\n0 1 1 nan 1 1 1 1 1 0\n", "line 3: .* is no tie"),
    ],
)
def test_what_is_no_tiepoint_file_is_refused_with_its_line(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=words) as error:
        read(tmp_path, text)
    assert str(tmp_path) in str(error.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="cannot be read"):
        read_ties(tmp_path / "none.tpt")
