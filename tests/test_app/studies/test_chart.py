"""`vesselflow chart`: its fronts on rows that are known, and the command on a small tank."""

import csv
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from app.cli import invoke
from app.files import read_rows, write_rows
from app.scenes.library import find_scene
from app.studies.chart import Row, load_trace, save_trace, select_methods
from app.studies.chart_report import cheapest_equivalents, network_verdict, pareto_front
from app.studies.methods import METHODS, Method
from app.studies.timed_run import Trace
from builders import vesselflow
from chart_rows import ROW
from taichi_sph.errors import InputError


def row(method: str, wall: float, error: float, **changes: object) -> Row:
    """A method with a cost [s/s] and an error."""
    made = replace(ROW, method=method, curve=method, wall_per_simulated=wall, drained=error)
    return replace(made, **changes)  # type: ignore[arg-type]


ROWS = [
    row("physics", 100.0, 0.01),
    row("coarse", 20.0, 0.05),
    row("worse", 30.0, 0.06),
    row("pcnet", 10.0, 0.04),
    row("dead", 1.0, 0.001, died="it leaked"),
]


def test_the_front_has_what_nothing_living_beats():
    assert [r.method for r in pareto_front(ROWS, "drained")] == ["pcnet", "physics"]


def test_a_rival_is_the_cheapest_that_is_as_good():
    ((mine, rival),) = cheapest_equivalents(ROWS, "pcnet", "drained")
    assert (mine.method, rival.method) == ("pcnet", "physics")
    assert cheapest_equivalents(ROWS[:1] + ROWS[3:], "physics", "drained") == []


def test_a_panel_says_how_the_network_stands():
    assert network_verdict(ROWS, "drained") == "PcNet on the front: up to 10 x the next as good"
    assert (
        network_verdict([*ROWS, row("better", 5.0, 0.03)], "drained") == "PcNet is not on the front"
    )
    assert network_verdict([row("pcnet", 1.0, 2e-4), row("physics", 9.0, 0.0)], "drained") == (
        "all agree to 0.1 %"
    )


def test_cost_is_measured_in_what_the_machine_could_do_meanwhile():
    busy = row("busy", 200.0, 0.01, yardstick=4.0)
    assert busy.normalised_cost == ROWS[0].normalised_cost


def test_rows_survive_the_file(tmp_path):
    path = tmp_path / "chart.csv"
    write_rows(path, ROWS)
    again = read_rows(path, Row)
    # NaN is not equal to itself.
    assert [replace(r, half_drained=0.0) for r in again] == [
        replace(r, half_drained=0.0) for r in ROWS
    ]
    path.write_text("scene,until\nA,0.1\n")
    with pytest.raises(InputError, match=f"^{path}: holds something else"):
        read_rows(path, Row)
    assert read_rows(tmp_path / "none.csv", Row) == []


def test_what_fits_nothing_is_one_sentence():
    with pytest.raises(InputError, match=r"^--only nobody: no method has this in its name"):
        select_methods([], "nobody", False)
    assert {m.name for m in select_methods([], "2 rounds", False)} == {"implicit, 2 rounds"}


def test_methods_have_names_of_their_own_and_keep_the_volume_of_blood():
    assert len({m.name for m in METHODS}) == len(METHODS)
    scene = find_scene("A")
    coarse = Method("x", spacing=2.0, sound_speed_ratio=5.0, newtonian=True).scene(scene)
    assert coarse.discretization.spacing == 2.0 * scene.discretization.spacing
    assert coarse.discretization.sound_speed_ratio == 5.0
    assert scene.column.particles is not None
    assert coarse.column.particles == round(scene.column.particles / 8)
    tank = find_scene("box")
    assert Method("x", spacing=2.0).scene(tank).column == tank.column
    assert msgspec.structs.replace(tank) == Method("x").scene(tank)


def test_a_curve_that_there_is_not_is_a_mistake():
    with pytest.raises(ValueError, match="there is no curve physics, spacings"):
        Method("x", "physics, spacings")
    with pytest.raises(ValueError, match="there is no model implicits"):
        Method("x", model="implicits")


def test_a_reference_survives_the_file_and_another_is_refused(tmp_path: Path):
    path = tmp_path / "chart.A-0.1s.npz"
    trace = Trace(0.01, 1e-3, drained=[0.0, 0.5], centre=[np.zeros(3), np.ones(3)])
    save_trace(path, trace)
    again = load_trace(path)
    assert (again.frame_interval, again.spacing, again.drained) == (0.01, 1e-3, [0.0, 0.5])
    np.testing.assert_array_equal(again.centre, trace.centre)
    for content in (path.read_bytes()[:100], b"", b"text"):
        path.write_bytes(content)
        with pytest.raises(InputError, match="no reference of a chart, or a cut one"):
            load_trace(path)


@pytest.mark.parametrize("command", ["chart", "advise", "compare"])
def test_a_driven_scene_is_refused(command: str, tmp_path: Path):
    given = [command, "aorta_surgery", "--until", "0.1"]
    given += ["--out", str(tmp_path / "c.csv")] if command == "chart" else []
    message, code = invoke(given)
    assert code == 2
    assert message.startswith(f"{command} aorta_surgery: ")
    assert "is driven; runs are judged by what blood does that only falls and leaves" in message
    assert not list(tmp_path.iterdir())


@pytest.mark.validation
def test_the_command_measures_and_draws(box: Path, tmp_path: Path):
    out, picture = tmp_path / "chart.csv", tmp_path / "chart.png"
    command = ("chart", box, "--until", "0.02", "--only", "2 rounds", "--out", out)
    told = vesselflow(*command, "--plot", picture)
    assert "implicit, 2 rounds" in told
    assert picture.read_bytes().startswith(b"\x89PNG")
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert [r["method"] for r in rows] == ["spacing 2/3, c = 20 U", "implicit, 2 rounds"]
    for r in rows:
        assert not r["died"]
        assert float(r["wall_per_simulated"]) > 0.0
        # Blood at rest: what is relative to its motion is not there.
        assert [r[name] for name in ("path", "energy", "field")] == ["nan"] * 3
        assert float(r["drained"]) >= 0.0 and float(r["compression"]) >= 0.0
    (reference,) = tmp_path.glob("chart.*.npz")
    assert len(load_trace(reference).drained) == 4
