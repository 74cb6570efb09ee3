"""`vesselflow stability`: its starts and checks are what they say, and the command."""

import csv
from types import SimpleNamespace

import numpy as np
import pytest

from app.models import MODELS
from app.studies.cases import (
    AORTA,
    CASES,
    CHANNEL,
    Case,
    StartedRun,
    ball_start,
    check_free_fall,
    check_rest,
    check_uniform_motion,
    fast_particle_start,
    hole_start,
    nan_start,
    narrowed,
    pair_start,
    particles_start,
    turned,
)
from app.studies.methods import METHODS
from app.studies.stability import QUICK, main, select_jobs, wilson
from builders import vesselflow
from taichi_sph.errors import InputError
from taichi_sph.geometry.vessel import read_vessel

D = 1e-3
LATTICE = np.stack(np.meshgrid(*[np.arange(10.0)] * 3, indexing="ij"), -1).reshape(-1, 3) * D
GRAVITY = np.array([0.0, -9.81, 0.0])


def simulation(x: np.ndarray = LATTICE, v: np.ndarray | None = None) -> SimpleNamespace:
    """As much of a simulation as starts and checks look at."""
    return SimpleNamespace(
        positions=lambda: x,
        velocities=lambda: np.zeros_like(x) if v is None else v,
        derived=SimpleNamespace(expected_speed=1.0),
        scene=SimpleNamespace(discretization=SimpleNamespace(spacing=D), gravity=tuple(GRAVITY)),
    )


def start(begin) -> tuple[np.ndarray, np.ndarray]:
    """What a start makes of the lattice."""
    return begin(simulation(), np.random.default_rng(0))


def nearest(x: np.ndarray) -> np.ndarray:
    """Distance of each particle to its nearest [m]."""
    r = np.linalg.norm(x[:, None] - x[None], axis=-1) + np.eye(len(x))
    return r.min(axis=1)


def test_faults_are_injected():
    x, v = start(pair_start)
    assert len(x) == 1000
    assert np.isclose(nearest(x), 0.1 * D).sum() == 2
    np.testing.assert_allclose(v, np.tile([0.0, -0.3, 0.0], (1000, 1)))
    _, v = start(fast_particle_start)
    assert (np.linalg.norm(v, axis=1) > 0.31).sum() == 1
    assert np.linalg.norm(v, axis=1).max() == pytest.approx(3.0)
    x, v = start(hole_start)
    # A ball of two spacings about the middle of a lattice's cell: 4/3 pi 8 = 33, here 32.
    assert len(x) == len(v) == 1000 - 32
    _, v = start(nan_start)
    assert np.isnan(v).sum() == 1


def test_balls_and_drops_are_where_they_should_be():
    x, v = start(ball_start(0.5, radius=3.0))
    assert np.linalg.norm(x - LATTICE.mean(axis=0), axis=1).max() < 3.0 * D
    np.testing.assert_allclose(v, np.tile([0.0, 0.0, -0.5], (len(x), 1)))
    x, _ = start(particles_start(2, 0.6))
    assert np.linalg.norm(x[1] - x[0]) == pytest.approx(0.6 * D)


def started(x: np.ndarray, v: np.ndarray, begun: tuple[np.ndarray, np.ndarray]) -> StartedRun:
    """A run of 0.1 s that ended with these."""
    pour = SimpleNamespace(simulation=simulation(x, v))
    case = Case("x", lambda _: None, 0.1)  # type: ignore[arg-type, return-value]
    return StartedRun(pour, begun, case)  # type: ignore[arg-type]


def test_checks_tell_right_from_wrong():
    rest = np.zeros_like(LATTICE)
    begun = LATTICE, rest
    assert check_rest(started(LATTICE, rest, begun)) == ""
    assert check_rest(started(LATTICE, rest + [0.0, 0.03, 0.0], begun)) == "still moves at 0.03 m/s"
    fallen = LATTICE + 0.5 * GRAVITY * 0.1**2
    assert check_free_fall(started(fallen, rest, begun)) == ""
    assert (
        check_free_fall(started(fallen + [0.0, D, 0.0], rest, begun)) == "1 spacings from free fall"
    )
    assert check_free_fall(started(fallen[1:], rest, begun)) == "left the vessel"
    moving = rest + [0.0, 0.0, -0.5]
    assert check_uniform_motion(started(LATTICE, moving, (LATTICE, moving))) == ""
    noise = 0.1 * np.random.default_rng(0).normal(size=moving.shape)
    assert "velocities spread by" in check_uniform_motion(
        started(LATTICE, moving + noise, (LATTICE, moving))
    )


def test_wilson_is_the_textbooks():
    assert wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-3)
    assert wilson(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-3)


def test_a_turned_scene_is_the_same_vessel_elsewhere(tmp_path):
    scene, plain = turned(*CHANNEL)(tmp_path), AORTA(tmp_path)
    there, here = read_vessel(scene), read_vessel(plain)
    assert there.volume == pytest.approx(here.volume, rel=1e-5)
    assert [o.name for o in there.openings] == [o.name for o in here.openings]
    for a, b in zip(there.openings, here.openings, strict=True):
        assert a.radius == pytest.approx(b.radius, rel=1e-4)
        # As steep against gravity as before.
        assert a.normal @ scene.gravity == pytest.approx(b.normal @ plain.gravity, abs=1e-3)


def test_a_narrower_throat_is_as_narrow_as_said(tmp_path):
    for percent in (50.0, 75.0):
        folder = tmp_path / f"{percent:g}"
        folder.mkdir()
        vessel = read_vessel(narrowed(percent, 6e-4, 0.005)(folder))
        # Of a bore of 10 mm, by the diameter of the largest ball that passes.
        assert vessel.narrowest == pytest.approx(10e-3 * (1.0 - 0.01 * percent), rel=0.03)


def test_what_fits_nothing_is_one_sentence(tmp_path):
    out = tmp_path / "s.csv"
    with pytest.raises(
        InputError, match=r'^--only nobody: no "METHOD, CASE" has this; methods are'
    ):
        main(out, 1, False, "nobody", [], 1, None, "cpu")
    assert not out.exists()


def test_names_are_their_own():
    assert len({case.name for case in CASES}) == len(CASES)
    assert len({method.name for method in METHODS}) == len(METHODS)


def test_quick_has_one_start_short_cases_and_the_models_of_run(tmp_path):
    jobs = select_jobs(3, True, "", [], "cpu")
    assert {job.method.name for job in jobs} == set(MODELS)
    assert {job.starts for job in jobs} == {1}
    assert all(CASES[job.case].until <= QUICK for job in jobs)
    assert len(jobs) < len(select_jobs(3, False, "", [], "cpu")) / 2


@pytest.mark.validation
def test_the_command_measures_and_draws(tmp_path):
    out, picture = tmp_path / "s.csv", tmp_path / "s.png"
    asked = ("stability", "--starts", "1", "--only", "implicit, one NaN", "--out", out)
    told = vesselflow(*asked, "--plot", picture)
    # It passes by stopping with a sentence.
    assert "1/1" in told
    assert picture.read_bytes().startswith(b"\x89PNG")
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["method"], r["case"], r["start"]) for r in rows] == [
        ("implicit", "one NaN", "0"),
    ]


@pytest.mark.validation
def test_a_full_tank_lives(tmp_path):
    """The last defence once looked too little to the side: blood left through the edges."""
    out = tmp_path / "s.csv"
    vesselflow("stability", "--starts", "1", "--only", "2 x step, rest", "--out", out)
    with out.open() as file:
        (row,) = csv.DictReader(file)
    assert row["died"] == ""
    # Of 1 280 particles one, in the corner of three walls, may stand outside at a frame.
    assert int(row["leaks"]) <= 1
