"""Command lines in VICAR's syntax."""

from dataclasses import fields

import pytest

from xalign_ros.core.errors import ConfigError
from xalign_ros.io.tae import UsageError, help_of, image_numbers, parse
from xalign_ros.io.vicar_parameters import WITHOUT_EFFECT, Options

MUST = ["inp=a.lis", "out=o.nav", "out_g2o=o.g2o", "in_tpt=t.tpt", "out_solution_id=x"]
VICARS = """INP OUT OUT_G2O IN_TPT NAVTABLE FORMAT OUT_SOLUTION_ID SOLUTION_ID SOLVER SUMMARY CM_ORI REFIMAGE UNTIL
IGNORE IGNORE_INTRA START_KEY OMP_ON CONFIG_PATH POINT_METHOD RSF DEBUG_RSF COORD COORD_INDEX FIXED_SITE SAVE_CONNECT
BEFORE_AFTER EDGE_DIST USE_ESSENTIAL MAX_RAND_NOISE MAX_QUAT_ERROR MAX_POS_ERROR""".split()


def given(*words: str) -> Options:
    return parse(Options, [*MUST, *words])


def test_all_parameters_of_the_help_are_there_with_their_defaults() -> None:
    assert [f.name.upper() for f in fields(Options)][: len(VICARS)] == VICARS and len(VICARS) == 31
    o = given()
    assert (o.format, o.solver, o.summary, o.cm_ori) == ("XML", "DENSE_NORMAL_CHOLESKY", "FULL_SUM", False)
    assert (o.edge_dist, o.max_rand_noise, o.max_quat_error, o.max_pos_error) == (0.05, 0.01, 0.05, 0.1)
    assert o.omp_on and o.save_connect and o.before_after and not o.use_essential and not o.until
    page = help_of(Options, "usage", "about")
    assert all(f"\n{name} " in page for name in VICARS)


def test_what_posegraphs_users_write() -> None:
    o = given("REF=(1,3,-6)", "-UNTIL", "-USE_ESSENTIAL", "-omp_off", "Edge_Dist=0.2", "IGNORE=2,", "4", "-nosave")
    assert o.refimage == (1, 3, -6) and o.until and o.use_essential and not o.omp_on and o.edge_dist == 0.2
    assert o.ignore == (2, 4) and not o.save_connect
    assert parse(Options, ["inp=(a, b,c)", "out=o", "out_g20=g", "in_tpt=t"]).inp == ("a", "b", "c")
    assert parse(Options, ["inp=(a,", "b)", "out=o", "out_g2o=g", "in_tpt=t"]).inp == ("a", "b")
    assert parse(Options, ["a.lis", "o.nav", "out_g2o=g", "in_tpt=t"]).out == "o.nav"
    assert given("refimage=-1").refimage == (-1,) and given("use_essential=nouse").use_essential is False
    assert given("summary=no").summary == "NO_SUM" and given("-BRIEF").summary == "BRIEF_SUM"


def test_ordinary_flags() -> None:
    o = given("--use-essential", "--edge-dist", "0.1", "--ref=2,3", "--no-omp-on", "--seed=7", "--json")
    assert o.use_essential and o.edge_dist == 0.1 and o.refimage == (2, 3) and not o.omp_on and o.seed == 7 and o.json
    assert parse(Options, ["--inp", "a", "--out", "o", "--out-g2o", "g", "--in-tpt", "t"]).inp == ("a",)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["OU=x"], "'OU' may be OUT or OUT_G2O or OUT_SOLUTION_ID or OUT_TPT"),
        (["foo=1"], "no parameter 'foo'"),
        (["out=p"], "OUT is given twice"),
        (["-FOO"], "no keyword '-FOO'"),
        (["-NO"], "may be -"),
        (["edge_dist=x"], "EDGE_DIST=x is no number"),
        (["edge_dist=nan"], "no number to work with"),
        (["start_key=1.5"], "no whole number"),
        (["refimage=(1,2"], "no closing parenthesis"),
        (["refimage="], "no value"),
        (["refimage=1,,2"], "empty value"),
        (["format=csv"], "none of XML, TXT"),
        (["a", "b", "c"], "one argument too many"),
        (["--edge-dist"], "needs a value"),
    ],
)
def test_wrong_words_are_refused_in_a_sentence(words: list[str], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        parse(Options, [*MUST, *words], positional=())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["edge_dist=0.6"], "EDGE_DIST=0.6 is not within"),
        (["solver=MAGIC"], "no SOLVER MAGIC"),
        (["-UNTIL"], "UNTIL needs REFIMAGE"),
        (["-IGNORE_INTRA"], "IGNORE_INTRA needs REFIMAGE"),
        (["loss=tukey"], "no loss 'tukey'"),
        (["min_ties=5"], "MIN_TIES=5"),
    ],
)
def test_values_that_do_not_go_together(words: list[str], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        given(*words).check()
    with pytest.raises(UsageError, match="OUT_SOLUTION_ID is required"):
        parse(Options, MUST[:-1]).check()


def test_what_is_required_is_named() -> None:
    with pytest.raises(UsageError, match="OUT and OUT_G2O and IN_TPT are required"):
        parse(Options, ["inp=a"])


def test_parameters_without_effect_are_told() -> None:
    o = given("point_method=GENERIC=7DOF", "rsf=a,b", "-DEBUG_RSF", "coord=SITE", "coord_index=(1,2)", "fixed_site=3")
    assert o.point_method == "GENERIC=7DOF" and o.without_effect() == [name.upper() for name in WITHOUT_EFFECT]
    assert given().without_effect() == []


def test_image_numbers_and_their_ranges() -> None:
    assert image_numbers("X", (1, 3, -6, 8, 11, -15), 15) == (0, 2, 3, 4, 5, 7, 10, 11, 12, 13, 14)
    for bad in ((0,), (-3,), (5, -3), (16,), (1, -16), (1, -3, -5)):
        with pytest.raises(ConfigError):
            image_numbers("X", bad, 15)
