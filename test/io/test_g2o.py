"""g2o files: hand-written ones, round trips, GTSAM's reading of the same file, and what is refused."""

import re

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xalign_ros.core import lie
from xalign_ros.core.errors import FormatError
from xalign_ros.core.graph import solve
from xalign_ros.core.pose_graph import Chart, PoseGraph, SimilarityEdges
from xalign_ros.io.g2o import G2o, read_g2o, write_g2o

UPPER_3 = "1 0 0 2 0 3"
UPPER_6 = "1 .1 .2 .3 .4 .5 2 0 0 0 0 3 0 0 0 4 0 0 5 0 6"
UPPER_7 = "1 .1 .2 .3 .4 .5 .6 2 0 0 0 0 0 3 0 0 0 0 4 0 0 0 5 0 0 6 0 7"
SE3 = f"""# two vertices
VERTEX_SE3:QUAT 4 1 2 3 0 0 0 2
EDGE_SE3:QUAT 4 7 1 0 0 0 0 .6 .8 {UPPER_6}   # before its vertex

FIX 7 4
VERTEX_SE3:QUAT 7 0 0 0 0 0 0 1
PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1
"""


def read(tmp_path, text, **options):
    path = tmp_path / "in.g2o"
    path.write_text(text)
    return read_g2o(path, **options)


def written(tmp_path, g2o):
    write_g2o(tmp_path / "out.g2o", g2o, g2o.graph.R, g2o.graph.t, g2o.graph.s)
    return read_g2o(tmp_path / "out.g2o", g2o.rotation_info)


def test_se3_numbers_go_where_they_belong(tmp_path) -> None:
    g2o = read(tmp_path, SE3, rotation_info="angle")
    graph, edges = g2o.graph, g2o.graph.similarities
    assert graph.keys.tolist() == [4, 7] and graph.fixed.all() and not graph.free_scale
    assert g2o.skipped == {"PARAMS_SE3OFFSET": 1} and edges.chart is Chart.LOG
    np.testing.assert_array_equal(graph.R[0], np.eye(3))
    np.testing.assert_allclose(edges.R[0], lie.rotation_from_quat([0, 0, 0.6, 0.8]))
    information = edges.information[0]
    assert np.diag(information).tolist() == [4, 5, 6, 1, 2, 3, 1]
    np.testing.assert_array_equal(information[3], [0.3, 0.4, 0.5, 1, 0.1, 0.2, 0])
    np.testing.assert_array_equal(information, information.T)


def test_g2o_means_the_vector_of_the_quaternion(tmp_path) -> None:
    """Half the angle: a quarter of the information on rotation, and the exact error of g2o in the cost."""
    g2o = read(tmp_path, SE3.replace("FIX 7 4\n", ""))
    edges = g2o.graph.similarities
    assert edges.chart is Chart.QUATERNION and np.diag(edges.information[0]).tolist() == [1, 1.25, 1.5, 1, 2, 3, 1]
    assert edges.information[0, 3, 0] == 0.15
    Rz = edges.R[0]
    E_t = Rz.T @ (g2o.graph.t[1] - g2o.graph.t[0] - edges.t[0])
    error = np.r_[E_t, lie.quat_from_rotation(Rz.T)[:3]]
    omega = np.zeros((6, 6))
    omega[np.triu_indices(6)] = [float(x) for x in UPPER_6.split()]
    omega = omega + omega.T - np.diag(np.diag(omega))
    assert solve(g2o.graph, max_iterations=0).cost == pytest.approx(error @ omega @ error / 2)


def test_sim3_and_the_plane(tmp_path) -> None:
    sim3 = read(tmp_path, f"VERTEX_SIM3:QUAT 0 0 0 0 0 0 0 1 2\nVERTEX_SIM3:QUAT 1 1 0 0 0 0 0 1 .5\n"
                f"EDGE_SIM3:QUAT 0 1 1 2 3 0 0 0 1 4 {UPPER_7}\n", rotation_info="angle")  # fmt: skip
    assert sim3.graph.free_scale and sim3.graph.s.tolist() == [2, 0.5] and sim3.graph.similarities.s.tolist() == [4]
    assert np.diag(sim3.graph.similarities.information[0]).tolist() == [4, 5, 6, 1, 2, 3, 7]
    flat = read(tmp_path, f"VERTEX_SE2 0 1 2 .5\nVERTEX_SE2 1 2 2 -.5\nEDGE_SE2 0 1 1 0 -1 {UPPER_3}\n").graph
    np.testing.assert_allclose(lie.so3_log(flat.R), [[0, 0, 0.5], [0, 0, -0.5]])
    assert np.diag(flat.similarities.information[0]).tolist() == [1, 1, 3, 1, 2, 1, 1]
    solution = solve(flat)
    assert not solution.t[:, 2].any() and np.abs(solution.R[:, 2, :2]).max() == 0


def test_the_exponential_form_of_sim3(tmp_path) -> None:
    """Logs of camera-to-world, rotation first; the numbers after it are a camera's."""
    x = np.array([[0.1, 0.2, 0.3, 1, 2, 3, 0.5], [0, 0, 0, 0, 0, 1, -0.5]])
    rows = [" ".join(map(str, row)) for row in x]
    g2o = read(tmp_path, f"VERTEX_SIM3:EXPMAP 0 {rows[0]} 500 500 320 240\nVERTEX_SIM3:EXPMAP 1 {rows[1]}\n"
               f"EDGE_SIM3:EXPMAP 0 1 {rows[1]} {UPPER_7}\n")  # fmt: skip
    R, t, s = lie.sim3_exp(x)
    np.testing.assert_allclose(g2o.graph.R, R)
    np.testing.assert_allclose(g2o.graph.t, t)
    np.testing.assert_allclose(g2o.graph.s, s)
    assert g2o.graph.similarities.chart is Chart.LOG
    assert np.diag(g2o.graph.similarities.information[0]).tolist() == [1, 2, 3, 4, 5, 6, 7]
    back = written(tmp_path, g2o)
    np.testing.assert_array_equal(back.graph.similarities.information, g2o.graph.similarities.information)
    np.testing.assert_allclose(back.graph.t, t)


def test_without_vertices_those_of_the_edges_are_meant(tmp_path) -> None:
    g2o = read(tmp_path, f"EDGE_SE2 9 3 1 0 0 {UPPER_3}\nEDGE_SE2 9 5 1 0 0 {UPPER_3}\n")
    assert g2o.graph.keys.tolist() == [3, 5, 9] and g2o.graph.similarities.i.tolist() == [2, 2]


@given(st.integers(0, 10**6), st.sampled_from(["SE2", "SE3", "SIM3"]), st.sampled_from(["vec", "angle"]))
def test_written_and_read_is_the_same(tmp_path_factory, seed, grammar, rotation_info) -> None:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(5, 7))
    x[:, 6] *= grammar == "SIM3"
    x[:, [0, 1, 5]] *= grammar != "SE2"
    R, t, s = lie.sim3_exp(x)
    A = rng.normal(size=(4, 7, 7))
    information = np.swapaxes(A, 1, 2) @ A
    silent = {"SE2": [0, 1, 5, 6], "SE3": [6], "SIM3": []}[grammar]
    information[:, silent] = information[:, :, silent] = 0
    information[:, silent, silent] = 1
    edges = SimilarityEdges(np.arange(4), [1, 3, 0, 2], R[:4], t[:4], s[:4], information)
    fixed = rng.random(5) < 0.3
    graph = PoseGraph([3, 1, 10, 4, 5], R, t, s, similarities=edges, fixed=fixed, free_scale=grammar == "SIM3")
    back = written(tmp_path_factory.mktemp("g2o"), G2o(graph, grammar, rotation_info, {})).graph
    assert back.keys.tolist() == graph.keys.tolist() and back.fixed.tolist() == fixed.tolist()
    for a, b in ((back, graph), (back.similarities, edges)):
        np.testing.assert_allclose(a.R, b.R, atol=1e-14)
        np.testing.assert_array_equal(a.t, b.t)
        np.testing.assert_array_equal(a.s, b.s)
    np.testing.assert_array_equal(back.similarities.information, information)


@pytest.mark.parametrize("plane", [False, True])
def test_gtsam_reads_the_same_cost(tmp_path, plane) -> None:
    edge = f"EDGE_SE2 0 1 1 .2 .3 {UPPER_3}" if plane else f"EDGE_SE3:QUAT 0 1 1 .5 -.2 .1 .2 .3 .9 {UPPER_6}"
    poses = ["0 0 .1", "2 1 -.6"] if plane else ["0 0 0 0 0 .1 .9", "2 1 0 .3 .1 -.2 .8"]
    tag = "SE2" if plane else "SE3:QUAT"
    text = "".join(f"VERTEX_{tag} {n} {pose}\n" for n, pose in enumerate(poses)) + edge + "\n"
    ours = solve(read(tmp_path, text, rotation_info="angle").graph, max_iterations=0).cost
    graph, values = gtsam.readG2o(str(tmp_path / "in.g2o"), not plane)
    assert ours == pytest.approx(graph.error(values), rel=1e-9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no edges of SE2"),
        ("VERTEX_SE2 0 0 0 0\n", "no edges"),
        ("VERTEX_SE2 0 0 0\n", r"line 1: VERTEX_SE2 with 3 numbers, needed are 4"),
        ("VERTEX_SE2 0 0 0 x\n", "line 1: '0 0 x' are not all numbers"),
        ("VERTEX_SE2 0 0 0 nan\n", "line 1: VERTEX_SE2 has a number that is not finite"),
        ("VERTEX_SE2 -1 0 0 0\n", "'-1' is no vertex number"),
        ("VERTEX_SE2 1 0 0 0\nVERTEX_SE2 1 0 0 0\n", "line 2: vertex 1 is there already"),
        ("VERTEX_SE3:QUAT 1 0 0 0 0 0 0 0\n", "quaternion is zero"),
        ("VERTEX_SIM3:QUAT 1 0 0 0 0 0 0 1 -2\n", "the scale is -2.0"),
        ("VERTEX_SE2 1 0 0 0\nVERTEX_SE3:QUAT 2 0 0 0 0 0 0 1\n", "line 2: VERTEX_SE3:QUAT after SE2"),
        (f"EDGE_SE2 1 1 0 0 0 {UPPER_3}\n", "line 1: an edge from vertex 1 to itself"),
        (f"VERTEX_SE2 1 0 0 0\nEDGE_SE2 1 2 0 0 0 {UPPER_3}\n", "line 2: there is no vertex 2"),
        (f"EDGE_SE2 1 2 0 0 0 {UPPER_3}\nFIX 5\n", "line 2: there is no vertex 5 to fix"),
        ("EDGE_SE2 1 2 0 0 0 1 0 0 -2 0 3\n", "line 1: the information is not positive semi-definite"),
    ],
)
def test_what_is_refused_is_named_with_its_line(tmp_path, text, words) -> None:
    with pytest.raises(FormatError, match=re.escape(str(tmp_path)) + ".*" + words):
        read(tmp_path, text)


def test_files_that_cannot_be_had(tmp_path) -> None:
    with pytest.raises(FormatError, match="cannot be read"):
        read_g2o(tmp_path / "none.g2o")
    (tmp_path / "binary.g2o").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="no text"):
        read_g2o(tmp_path / "binary.g2o")
    g2o = read(tmp_path, f"EDGE_SE2 1 2 0 0 0 {UPPER_3}\n")
    with pytest.raises(FormatError, match="cannot be written"):
        written(tmp_path / "missing", g2o)
