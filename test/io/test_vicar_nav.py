"""Navigation files: byte-stable, priorities, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from xalign_ros.core.errors import FormatError
from xalign_ros.io.vicar_nav import read_nav_xml, write_nav_xml
from xalign_ros.io.vicar_nav_text import read_nav_text, write_nav_text

FILES = ["examples/synth4/telemetry.nav", "examples/synth4/truth.nav", "nav/msl_mahli_sample.nav"]
FILES += ["mer1_navcam_pan/telemetry_7dof.nav"]
NAV = """<?xml version="1.0"?>
<pointing_correction mission="M">
<priority>{priority}</priority>
{solutions}
</pointing_correction>
"""
SOLUTION = """<solution solution_id="{solution}">
<image unique_id="{image}"/>
<pointing_parameters type="X">{parameters}</pointing_parameters>
</solution>"""
VALUES = zip("S V1 V2 V3 X Y Z".split(), [1, 0, 0, 0, 1, 2, 3], strict=True)
SEVEN = "".join(f'<parameter id="{k}" value="{v}"/>' for k, v in VALUES)


def solution(name: str, image: str = "A", parameters: str = SEVEN) -> str:
    return SOLUTION.format(solution=name, image=image, parameters=parameters)


def read(tmp_path: Path, text: str):
    path = tmp_path / "a.nav"
    path.write_text(text)
    return read_nav_xml(path)


@pytest.mark.parametrize("name", FILES)
def test_a_file_is_written_as_it_was_read(name: str, data_dir: Path, tmp_path: Path) -> None:
    nav = read_nav_xml(data_dir / "vicar" / name)
    once, twice = tmp_path / "1.nav", tmp_path / "2.nav"
    write_nav_xml(once, nav)
    write_nav_xml(twice, read_nav_xml(once))
    assert once.read_bytes() == twice.read_bytes()
    if "synth4" in name:  # as marsnav2 writes, so equal to the last byte but for the purpose, which is not read
        lines = (data_dir / "vicar" / name).read_text().splitlines()
        assert once.read_text().splitlines() == [line for line in lines if "purpose" not in line]


def test_the_recorded_mahli_solution(data_dir: Path) -> None:
    (p,) = read_nav_xml(data_dir / "vicar/nav/msl_mahli_sample.nav").solution()
    assert p.unique_id == "MSLMM_460261040" and p.model == "MSLmahliCamera" and p.index == (40, 200, 24)
    assert p.parameters[0] == -0.70059502 and p.attributes["image_id"] == "1000384000"
    assert p.camera is not None and p.camera.model == "CAHVOR" and p.original_camera is not None
    assert p.frame is not None and p.frame.name == "ROVER_NAV_FRAME"


def test_priority_chooses_the_last_but_telemetry_and_does_not_fall_back(tmp_path: Path) -> None:
    entries = '<entry solution_id="low"/><entry solution_id="high"/><entry solution_id="telemetry"/>'
    text = NAV.format(priority=entries, solutions=solution("low", "B") + solution("HIGH", "A"))
    nav = read(tmp_path, text)
    assert [p.unique_id for p in nav.solution()] == ["A"] and [p.unique_id for p in nav.solution("LOW")] == ["B"]
    with pytest.raises(ValueError, match="no solution 'other', only low, HIGH"):
        nav.solution("other")
    assert len(read(tmp_path, NAV.format(priority="", solutions=solution("x"))).solution()) == 1
    both = read(tmp_path, NAV.format(priority="", solutions=solution("x") + solution("y")))
    with pytest.raises(ValueError, match="SOLUTION_ID chooses: x, y"):
        both.solution()


def test_six_parameters_are_converted_and_seven_read_in_any_order(tmp_path: Path) -> None:
    values = zip("Azimuth Elevation Twist X Y Z".split(), [90, 0, 0, 1, 2, 3], strict=True)
    six = "".join(f'<parameter id="{k}" value="{v}"/>' for k, v in values)
    (p,) = read(tmp_path, NAV.format(priority="", solutions=solution("x", parameters=six))).solution()
    np.testing.assert_allclose(p.parameters, [np.sqrt(0.5), 0, 0, np.sqrt(0.5), 1, 2, 3], atol=1e-12)
    mixed = SEVEN.replace('id="S"', 'id="q"').replace('id="X"', 'id="S"').replace('id="q"', 'id="X"')
    (p,) = read(tmp_path, NAV.format(priority="", solutions=solution("x", parameters=mixed))).solution()
    assert p.parameters.tolist() == [1, 0, 0, 0, 1, 2, 3]


@pytest.mark.parametrize(
    ("solutions", "words"),
    [
        ("", "has no <solution>"),
        (solution("x", parameters='<parameter id="S" value="1"/>'), "line 7: A has 1 pointing parameters"),
        (solution("x", parameters=SEVEN.replace('"1"', '"0"', 1)), "no quaternion"),
        (solution("x", parameters=SEVEN.replace('"3"', '"inf"')), "'inf' is no number"),
        (solution("x", image=""), "no unique_id"),
        (solution(""), "no solution_id"),
        ('<solution solution_id="x"><image unique_id="A"/></solution>', "no <pointing_parameters>"),
        (
            solution("x").replace("</solution>", '<camera_model type="CAHV"></camera_model></solution>'),
            "has no parameter C",
        ),
        ("<solution>", "mismatched tag"),
    ],
)
def test_what_is_no_navigation_file_is_refused_with_its_line(solutions: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=words) as error:
        read(tmp_path, NAV.format(priority="", solutions=solutions))
    assert "a.nav" in str(error.value)


def test_text_files(data_dir: Path, tmp_path: Path) -> None:
    original, corrected = read_nav_text(data_dir / "vicar/examples/synth4/telemetry_txt.nav")
    assert original.shape == (4, 7) and corrected[1, 0] == 0.999
    values = np.random.default_rng(0).normal(size=(2, 3, 7)).round(9)
    values[..., 0] = 1.0
    write_nav_text(tmp_path / "a.nav", *values)
    np.testing.assert_allclose(read_nav_text(tmp_path / "a.nav"), values, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1.0 2.0 3.0 4.0\n", "line 1 is neither"),
        ("marsnav pointing corrections file, version 1\n", "has no image"),
        ("marsnav pointing corrections file, version 1\n2 1 2 3 4\n", "line 2: 2 pointing parameters"),
        ("marsnav pointing corrections file, version 1\n7 1 2 3\n", "line 2: after 7 come"),
        ("marsnav pointing corrections file, version 1\n7" + " 0" * 14, "line 2: .* no unit quaternion"),
        ("marsnav pointing corrections file, version 1\n7" + " nan" * 14, "line 2: after 7"),
    ],
)
def test_text_that_is_refused(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.nav").write_text(text)
    with pytest.raises(FormatError, match=words):
        read_nav_text(tmp_path / "a.nav")
