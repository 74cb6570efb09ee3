"""The command `vesselflow validate` itself; its physics is in tests/validation."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.validation.pipes import harmonic
from app.validation.report import Curve, Report, Row, relative_l2, watched
from app.validation.validate import CASES, Case, main, table_of
from taichi_sph.errors import InputError


def test_an_unknown_case_is_refused_with_the_names_that_exist():
    with pytest.raises(
        InputError, match=r"validate couette: no such case; allowed are kernel, momentum"
    ):
        main(only=["couette"])


def test_case_names_are_unique():
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.mark.parametrize(
    ("error", "passed"), [(0.049, True), (0.05, True), (0.051, False), (math.nan, False)]
)
def test_a_row_passes_within_its_tolerance_only(error, passed):
    assert Row("q", "1", "1", error, 0.05, 0.0).passed is passed


def test_a_row_that_misses_says_so():
    rows = [
        Row("a", "1", "1", 0.0, 0.05, 0.1), Row("b", "2", "1", 1.0, 0.05, 0.1),
        Row("c", "2", "1", 1.0, 0.05, 0.1, "too coarse"),
        Row("d", "1", "1", 0.0, 0.05, 0.1, "too coarse"),
    ]  # fmt: skip
    verdicts = [str(cell) for cell in table_of(rows).columns[5].cells]
    assert verdicts == ["pass", "MISS", "known miss", "pass"]


@pytest.mark.parametrize(("known", "code"), [("", 1), ("too coarse", 0)])
def test_only_a_miss_that_is_not_known_fails(known, code, monkeypatch, capsys):
    def run(report, quick):
        report.compare("speed", 2.0, 1.0, 0.05, known=known)

    monkeypatch.setattr("app.validation.validate.start", lambda *_: None)
    monkeypatch.setattr("app.validation.validate.CASES", (Case("one", "a case", "f32", run),))
    assert main() == code
    assert ("known to miss: speed: too coarse" in capsys.readouterr().out) == (code == 0)


def test_a_long_case_runs_when_it_is_named_and_rows_go_to_a_file(monkeypatch, capsys, tmp_path):
    ran = []

    def run(name):
        def case(report, quick):
            ran.append(name)
            report.compare("speed", 1.02, 1.0, 0.05)

        return case

    cases = (Case("one", "a case", "f32", run("one")), Case("two", "long", "f32", run("two"), 30))
    monkeypatch.setattr("app.validation.validate.start", lambda *_: None)
    monkeypatch.setattr("app.validation.validate.CASES", cases)
    out = tmp_path / "rows.json"
    assert main(json_file=out) == 0
    assert ran == ["one"]
    assert "30 min: vesselflow validate two" in capsys.readouterr().out
    assert main(["two"], json_file=out) == 0
    assert ran == ["one", "two"]
    (row,) = json.loads(out.read_text())["rows"]
    assert row["quantity"] == "speed" and row["passed"] is True and row["tolerance"] == 0.05
    out.write_text('{"mine": 1}')
    with pytest.raises(InputError, match="something else; name another"):
        main(["two"], json_file=out)
    assert out.read_text() == '{"mine": 1}'


def test_the_relative_error_is_of_the_norms():
    assert relative_l2(np.array([3.0, 0.0]), np.array([3.0, 4.0])) == pytest.approx(0.8)


def test_a_harmonic_is_found_beside_a_constant_and_another_one():
    w, time = 3.0, np.arange(1, 41) / 40.0 * 2.0 * math.pi / 3.0
    amplitude = 2.0 * np.exp(-1.1j)
    values = np.real(amplitude * np.exp(1j * w * time)) + 0.7 + 0.5 * np.cos(2.0 * w * time)
    assert harmonic(time, values, w) == pytest.approx(amplitude)


class Clock:
    """Stands in for a `Simulation`: steps of at most 0.4 s; remembers the force of each."""

    def __init__(self):
        self.time, self.steps, self.gravity = 0.0, 0, (0.0, 0.0, 0.0)
        self.forces = []

    def step(self, remaining):
        self.forces.append(self.gravity)
        self.time += min(0.4, remaining)
        self.steps += 1


def test_a_changing_force_is_set_anew_before_each_step():
    clock: Any = Clock()
    assert list(watched(clock, [0.6, 1.0], Report(lambda f: None), 0.0, 1.0, lambda t: -t)) == [
        0,
        1,
    ]
    assert [z for _, _, z in clock.forces] == pytest.approx([0.0, -0.4, -0.6])


def test_a_compared_row_carries_the_relative_difference_and_units():
    report = Report(lambda fraction: None)
    report.compare("viscosity", 3.6, 4.0, 0.05, "mPa s")
    row = report.rows[0]
    assert (row.computed, row.theory) == ("3.6 mPa s", "4 mPa s")
    assert row.error == pytest.approx(0.1)


def test_profiles_are_drawn_one_file_a_picture(tmp_path: Path):
    pytest.importorskip("matplotlib", reason="pictures need vesselflow[plot]")
    from app.validation.validate import draw_pictures

    report = Report(lambda fraction: None)
    line = np.linspace(0.0, 1.0, 5)
    report.draw("pipe", "r", "u", Curve("coarse", line, line, line, line))
    report.draw("pipe", "r", "u", Curve("fine", line, line, line, line))
    files = draw_pictures(report, tmp_path)
    assert [f.name for f in files] == ["pipe.png"]
    assert files[0].stat().st_size > 1000
