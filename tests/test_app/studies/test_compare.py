"""`vesselflow compare`: its measures on runs whose differences are known, and the command."""

import json
import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from app.studies.compare import result_of
from app.studies.timed_run import TimedRun, Trace
from places import ROOT

INTERVAL = 0.1
FALL = np.array([0.0, -0.01, 0.0])
"""Way of the centre of mass in a frame [m]."""


def run(drained: list[float], offset: float = 0.0, seconds: float = 1.0) -> TimedRun:
    """A run whose centre falls by FALL a frame, `offset` [m] to the side."""
    frames = len(drained)
    simulation = SimpleNamespace(
        steps=10 * frames,
        wall_corrections=0,
        fallback_share=0.0,
        derived=SimpleNamespace(blood_particles=100),
        particles=SimpleNamespace(mass=0.01, count={None: 100}),
    )
    trace = Trace(
        INTERVAL,
        drained=drained,
        centre=[k * FALL + np.array([offset, 0.0, 0.0]) for k in range(frames)],
        energy=[1.0] * frames,
        compression=[0.01 * k for k in range(frames)],
    )
    seconds_each = [9.0] + [seconds] * (frames - 1)
    return TimedRun("x", simulation, trace, seconds=seconds_each, compiled=10)  # type: ignore[arg-type]


def test_a_run_beside_itself_differs_in_nothing():
    one = run([0.0, 0.0, 0.25, 0.75, 1.0])
    result = result_of(one, one)
    assert (result.path_error, result.drained_error, result.speed_up) == (0.0, 0.0, 1.0)
    # Linear between 0.3 s and 0.4 s.
    assert result.half_drained == pytest.approx(0.35)
    assert result.compression_p99 == pytest.approx(0.04)


def test_a_shifted_run_is_as_wrong_as_its_shift_over_the_path():
    first = run([0.0, 0.0, 0.1, 0.2, 0.9])
    # The last frame has too little blood for a centre of mass: three steps of a path remain.
    result = result_of(run([0.0, 0.1, 0.1, 0.5, 0.9], offset=0.003), first)
    assert result.path_error == pytest.approx(0.003 / 0.03)
    assert result.drained_error == pytest.approx(0.3)


def test_the_frame_that_compiles_is_not_timed():
    result = result_of(run([0.0] * 5, seconds=0.5), run([0.0] * 5, seconds=2.0))
    assert result.speed_up == pytest.approx(4.0)
    assert result.milliseconds_per_step == pytest.approx(50.0)
    assert result.wall_per_simulated == pytest.approx(5.0)
    assert math.isnan(result.half_drained)


def test_a_run_that_died_is_measured_while_it_lived_and_says_so():
    dead = run([0.0, 0.1], offset=0.001)
    dead.failure = "the run diverged"
    result = result_of(dead, run([0.0, 0.1, 0.5]))
    assert result.died == "the run diverged"
    assert result.path_error == pytest.approx(0.001 / 0.01)


@pytest.mark.validation
def test_the_command_pours_physics_network_and_soft_physics(tmp_path):
    figures, picture = tmp_path / "c.json", tmp_path / "c.png"
    command = [sys.executable, "-m", "app", "compare", "aortoiliac", "--height", "0.004"]
    command += ["--until", "0.01", "--soft", "5", "--json", str(figures), "--plot", str(picture)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert result.returncode == 0, result.stderr
    told = json.loads(figures.read_text())["results"]
    assert [row["name"] for row in told] == ["physics", "implicit", "pcnet", "physics, c = 5 U"]
    physics, implicit, network, soft = told
    assert physics["drained_error"] == 0.0
    # Free fall: after t a semi-implicit step T is ahead by T/t of the way, here 5 %.
    for long in (implicit, network):
        assert long["path_error"] < 0.06
        assert physics["steps"] > 6 * long["steps"]
    assert 1.5 < physics["steps"] / soft["steps"] < 2.0  # (10 + 1)/(5 + 1): sound and fall
    assert picture.read_bytes().startswith(b"\x89PNG")
    # Units stay in the table: "[s]" is no markup.
    for label in ("half drained after [s]", "peak kinetic energy [mJ]"):
        assert label in result.stdout
    assert "nan" not in result.stdout
