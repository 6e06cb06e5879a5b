"""xalign solve on real graphs and on what is wrong."""

import json

import gtsam
import numpy as np
import pytest

from xalign_ros.apps.main import main
from xalign_ros.io.g2o import read_g2o

OPTIMA = {
    "tinyGrid3D": 9.31391,
    "smallGrid3D": 517.925,
    "parking-garage": 0.634192,
    "sphere2500": 675.701,
    "Klaus3": 0.007028,
}
SQUARE = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 0 0 0
VERTEX_SE2 2 0 0 0
VERTEX_SE2 3 0 0 0
EDGE_SE2 0 1 1 0 1.5707963 9 0 0 9 0 9
EDGE_SE2 1 2 1 0 1.5707963 9 0 0 9 0 9
EDGE_SE2 2 3 1 0 1.5707963 9 0 0 9 0 9
EDGE_SE2 3 0 1 0 1.5707963 9 0 0 9 0 9
EDGE_SE2 1 3 1 1 3.1415927 9 0 0 9 0 9
EDGE_SE2 0 2 5 5 0 9 0 0 9 0 9
"""


@pytest.mark.parametrize("name", OPTIMA)
def test_recorded_graphs_reach_their_optima_in_gtsams_objective(name, data_dir, tmp_path, capsys) -> None:
    source, out = data_dir / "g2o" / f"{name}.g2o", tmp_path / "out.g2o"
    assert main(["solve", str(source), "-o", str(out), "--rotation-info", "angle", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    graph, _ = gtsam.readG2o(str(source), True)
    _, values = gtsam.readG2o(str(out), True)
    # GTSAM's own optima as printed have six digits.
    assert graph.error(values) <= OPTIMA[name] * (1 + 1e-4) and result["cost"] == pytest.approx(
        graph.error(values), rel=1e-6
    )
    assert result["converged"]


@pytest.mark.parametrize("name", ["CSAIL", "intel"])
def test_recorded_graphs_of_the_plane_stay_in_it(name, data_dir, tmp_path, capsys) -> None:
    out = tmp_path / "out.g2o"
    source = str(data_dir / "g2o" / f"{name}.g2o")
    assert main(["solve", source, "-o", str(out), "--rotation-info", "angle", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    solved = read_g2o(out).graph
    assert result["converged"] and result["cost"] < result["initial_cost"] and not solved.t[:, 2].any()
    graph, values = gtsam.readG2o(str(out), False)
    assert graph.error(values) == pytest.approx(result["cost"], rel=1e-6)


def test_a_robust_loss_sets_a_false_loop_aside(tmp_path, capsys) -> None:
    source, out = tmp_path / "square.g2o", tmp_path / "out.g2o"
    source.write_text(SQUARE)
    assert main(["solve", str(source), "-o", str(out), "--robust", "cauchy:1"]) == 0
    corners = read_g2o(out).graph.t[:, :2]
    np.testing.assert_allclose(corners, [[0, 0], [1, 0], [1, 1], [0, 1]], atol=0.15)
    assert main(["solve", str(source), "-o", str(out), "--force"]) == 0
    assert np.abs(read_g2o(out).graph.t[2, :2] - [1, 1]).max() > 0.5
    assert "converged True" in capsys.readouterr().out


def test_what_cannot_be_done_is_said_in_a_sentence(tmp_path, capsys) -> None:
    source, out = tmp_path / "square.g2o", tmp_path / "out.g2o"
    source.write_text(SQUARE + "VERTEX_XY 9 0 0\n")
    out.write_text("mine")
    assert main(["solve", str(source), "-o", str(out)]) == 1
    said = capsys.readouterr()
    assert said.out == "" and "exists; give another name or --force" in said.err and out.read_text() == "mine"
    assert main(["solve", str(tmp_path / "none.g2o"), "-o", str(tmp_path / "new.g2o")]) == 1
    assert "cannot be read" in capsys.readouterr().err and not (tmp_path / "new.g2o").exists()
    assert main(["solve", str(source), "-o", str(tmp_path / "new.g2o")]) == 0
    assert "1 lines of VERTEX_XY skipped" in capsys.readouterr().err
    for wrong in ("tukey", "huber:-1", "huber:x"):
        with pytest.raises(SystemExit) as stop:
            main(["solve", str(source), "-o", str(out), "--robust", wrong])
        assert stop.value.code == 2
