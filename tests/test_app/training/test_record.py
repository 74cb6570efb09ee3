import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial import cKDTree

from app.jobs.process import in_own_process
from app.scenes.library import vessels_folder
from app.training.record import Recording, RecordingJob, plan, record, record_run
from cluster import cluster, wait_for
from nn.dataset.reader import Dataset, check
from nn.dataset.schema import RecordedState
from nn.dataset.writer import RunWriter, committed_states
from nn.training.rollout import ReplaySimulation
from taichi_sph.errors import InputError, RunError
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.scene import read_scene

SCENE = """
title = "A column that falls out of a tube"
duration = 0.5
frame_interval = 0.002
gravity = [0.0, 0.0, -9.81]

[vessel]
surface = "lumen.ply"

[openings.top]
centre = [0.0, 0.0, 0.03]

[openings.bottom]
centre = [0.0, 0.0, -0.03]

[column]
opening = "bottom"
height = 0.01

[discretization]
spacing = 0.0015
sound_speed_ratio = 2.0
"""
HEIGHTS = (0.004, 0.006)
FRAMES = 10
SUBSTEPS = 16
KILLED_AFTER = 7
"""Frames; some of the blood has left by then."""


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tube")
    shutil.copy(vessels_folder() / "tube" / "lumen.ply", folder)
    (folder / "scene.toml").write_text(SCENE)
    return folder / "scene.toml"


Maker = Callable[..., Recording]


@pytest.fixture(scope="module")
def make(scene_file: Path) -> Maker:
    """Record the scene of this file."""
    return partial(record, scene_file, substeps=SUBSTEPS, features=True)


@pytest.fixture(scope="module")
def recorded(make: Maker, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Both runs at once, a thread each."""
    out = tmp_path_factory.mktemp("recorded") / "data.h5"
    return make(HEIGHTS, FRAMES, out, processes=2, threads=1)


@pytest.mark.validation
def test_a_state_says_all_that_its_future_needs(scene_file: Path) -> None:
    scene = read_scene(scene_file)
    simulation = ReplaySimulation(scene, read_vessel(scene), 0)
    interval = 2 * simulation.simulation.derived.step  # lists last longer than that

    def advance(frame: int) -> RecordedState:
        simulation.advance_to(frame * interval)
        simulation.settle()
        return simulation.state()

    # Stirred, so that the order in which neighbours are summed makes a difference.
    start = simulation.state()
    stirred = np.random.default_rng(0).normal(0.0, 0.1, start.velocity.shape)
    states = [replace(start, velocity=stirred.astype(start.velocity.dtype))]
    simulation.restore(states[0], 0.0, 0)
    states += [advance(frame) for frame in range(1, 10)]
    for first in range(1, 9):
        simulation.restore(states[first], first * interval, 2 * first)
        for frame in range(first + 1, 10):
            again = advance(frame)
            for name in ("alive", "position", "velocity"):
                found, expected = getattr(again, name), getattr(states[frame], name)
                np.testing.assert_array_equal(found, expected, f"{name} {first} {frame}")


def die_under_way(job: RecordingJob) -> None:
    """Record until some states are written, then end as by kill -9."""
    append = RunWriter.append

    def append_or_die(writer: RunWriter, *state: Any) -> None:
        append(writer, *state)
        if writer.states == KILLED_AFTER:
            os.kill(os.getpid(), signal.SIGKILL)

    RunWriter.append = append_or_die  # type: ignore[method-assign, assignment]
    record_run(job)


@pytest.fixture(scope="module")
def begun(scene_file: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """What a killed recording leaves of the first run."""
    out = tmp_path_factory.mktemp("begun") / "data.h5"
    job = plan(scene_file, HEIGHTS[:1], FRAMES, out, SUBSTEPS, True, "cpu", 2, 0)[0]
    with pytest.raises(RunError, match="its process was ended by SIGKILL"):
        in_own_process(die_under_way, job)
    assert committed_states(job.part, job.metadata) == KILLED_AFTER
    return job.part.read_bytes()


@pytest.mark.validation
def test_killed_or_not_the_file_is_the_same_to_the_bit(
    recorded: Recording, begun: bytes, make: Maker, tmp_path: Path
) -> None:
    out = tmp_path / "data.h5"
    (tmp_path / "data.h5.run0.part").write_bytes(begun)
    with pytest.raises(InputError, match=r"holds a run of frames 10, asked for is 11"):
        make(HEIGHTS, FRAMES + 1, out)
    with pytest.raises(InputError, match=r"run0\.part: holds a run of height 0\.004, asked for is"):
        make(HEIGHTS[1:], FRAMES, out)
    (tmp_path / "data.h5.run7.part").write_bytes(b"")
    with pytest.raises(InputError, match=r"run7\.part: left by a recording of more heights"):
        make(HEIGHTS, FRAMES, out)
    (tmp_path / "data.h5.run7.part").unlink()
    assert not out.exists()

    again = make(HEIGHTS, FRAMES, out, processes=1)
    assert again.resumed == KILLED_AFTER
    assert out.read_bytes() == recorded.out.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["data.h5"]


def has_children(process: int) -> bool:
    return any(file.read_text() for file in Path(f"/proc/{process}/task").glob("*/children"))


@pytest.mark.validation
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_a_cluster_records_the_same_bits_and_bears_the_loss_of_a_worker(
    recorded: Recording, begun: bytes, make: Maker, tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="an extra: pip install 'vesselflow[cluster]'")
    out = tmp_path / "data.h5"
    # A run that was begun here goes on there.
    (tmp_path / "data.h5.run0.part").write_bytes(begun)
    killed: list[subprocess.Popen] = []

    def kill_one(workers: list[subprocess.Popen]) -> None:
        wait_for(lambda: any(has_children(worker.pid) for worker in workers))
        killed.append(next(worker for worker in workers if has_children(worker.pid)))
        killed[0].kill()

    (tmp_path / "cluster").mkdir()
    with cluster(tmp_path / "cluster") as running:
        threading.Thread(target=kill_one, args=(running.workers,), daemon=True).start()
        again = make(HEIGHTS, FRAMES, out, threads=1, scheduler=running.address)
        assert killed[0].wait(5.0) == -signal.SIGKILL
    assert again.resumed == KILLED_AFTER
    assert out.read_bytes() == recorded.out.read_bytes()


def test_a_recording_keeps_the_promises_of_the_schema(recorded: Recording) -> None:
    check(recorded.out)
    assert recorded.size == recorded.out.stat().st_size
    with Dataset(recorded.out) as data:
        assert tuple(run.facts for run in data.runs) == recorded.runs
        assert [run.facts.height for run in data.runs] == list(HEIGHTS)
        for run in data.runs:
            assert run.scene.column.height == run.facts.height
            assert run.facts.frame_interval == SUBSTEPS * run.facts.substep
            assert run.substeps(0).count == SUBSTEPS
            assert run.substeps(0).largest <= run.facts.substep * (1.0 + 1e-9)


def test_targets_are_those_of_blood_that_falls(recorded: Recording) -> None:
    # Out of its reach of the wall nothing holds the column yet: it falls freely.
    with Dataset(recorded.out) as data:
        for run in data.runs:
            target = run.target(0).mean(axis=0)
            np.testing.assert_allclose(target, (0.0, 0.0, -9.81), atol=0.1)
            change = (run.velocity(1).astype(float) - run.velocity(0)) / run.facts.frame_interval
            np.testing.assert_allclose(run.target(0), change, rtol=1e-6)
            # Where blood parts, shifting moves a few; half of it only falls.
            moved = np.median((run.position(1) - run.position(0))[:, 2])
            # Symplectic Euler with M equal steps: g T^2 (M + 1)/(2 M).
            fall = -9.8 * run.facts.frame_interval**2 * (SUBSTEPS + 1) / (2 * SUBSTEPS)
            assert moved == pytest.approx(fall, rel=0.02)


def test_drained_blood_keeps_its_row_which_is_zero(recorded: Recording) -> None:
    with Dataset(recorded.out) as data:
        run = data.runs[0]
        alive = run.alive(slice(None))
        left = alive.sum(axis=1)
        assert left[0] == run.facts.particles
        assert 0 < left[KILLED_AFTER - 1] < left[0], "some must leave, and not all"
        assert (np.diff(left) <= 0).all()
        position, velocity = run.position(slice(None)), run.velocity(slice(None))
        assert not position[~alive].any()
        assert not velocity[~alive].any()
        assert position[alive].any(axis=1).all()
        # The rest is still where it was: rows are particles.
        moved = np.linalg.norm(np.diff(position, axis=0), axis=2)[alive[1:]]
        fastest = np.linalg.norm(velocity, axis=2).max()
        assert moved.max() < 2.0 * fastest * run.facts.frame_interval
        bottom = -0.03
        assert (position[..., 2][alive] >= bottom).all()


def test_features_are_those_of_the_stored_frame(recorded: Recording) -> None:
    with Dataset(recorded.out) as data:
        run = data.runs[1]
        facts = run.facts
        lattice = 4.0 / 3.0 * np.pi * (facts.support_radius / facts.spacing) ** 3
        wall = cKDTree(run.proxies().position.astype(float))
        for frame in (0, 3, KILLED_AFTER):
            alive = run.alive(frame)
            found = run.features(frame)[alive]
            expected = run.acceleration(frame)[alive]
            scale = facts.frame_interval**2 / facts.support_radius
            np.testing.assert_allclose(found[:, :3], scale * expected, rtol=1e-5, atol=1e-7)
            position = run.position(frame)[alive].astype(float)
            # A hair inside R: a pair of the lattice may stand at R itself.
            for reach, compare in ((0.9999, np.less_equal), (1.0001, np.greater_equal)):
                radius = reach * facts.support_radius
                near = cKDTree(position).query_ball_point(position, radius, return_length=True)
                behind = wall.query_ball_point(position, radius, return_length=True)
                assert compare(near - 1, np.rint(found[:, 3] * lattice)).all()
                assert compare(behind, np.rint(found[:, 16] * lattice)).all()
            assert not run.features(frame)[~alive].any()


def test_a_finished_recording_is_neither_made_again_nor_written_over(
    recorded: Recording, make: Maker
) -> None:
    before = recorded.out.stat()
    again = make(HEIGHTS, FRAMES, recorded.out)
    assert again.resumed == 2 * (FRAMES + 1)
    with pytest.raises(InputError, match=r"holds a run of height 0\.006, asked for is 0\.005"):
        make((0.004, 0.005), FRAMES, recorded.out)
    with pytest.raises(InputError, match="holds 2 runs, not 1; name another file"):
        make((0.004,), FRAMES, recorded.out)
    assert recorded.out.stat() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"heights": ()}, "--heights: none given"),
        ({"heights": (0.004, -1.0)}, "--heights -1: a height is greater than 0 m"),
        ({"heights": (0.004, float("nan"))}, "--heights nan: a height is greater than 0 m"),
        ({"heights": (0.004, 0.004)}, "--heights 0.004, 0.004: one is given twice"),
        ({"heights": (0.004, 0.5)}, "column.height: 0.5 m below an offset"),
        ({"frames": 0}, "--frames 0: at least 1 is needed"),
        ({"substeps": 0}, "--substeps 0: at least 1 is needed"),
        ({"frames": 10**12}, "GB are needed meanwhile in"),
        ({"scheduler": "slurm"}, "--scheduler slurm: allowed is dask:ADDRESS"),
    ],
)
def test_mistakes_are_found_before_anything_is_simulated(
    make: Maker, tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        make(**{"heights": (0.004,), "frames": 2, "out": tmp_path / "data.h5", **options})
    assert not list(tmp_path.iterdir())


def test_a_cluster_needs_dask(make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match="needs Dask; install it with"):
        make((0.004,), 2, tmp_path / "data.h5", scheduler="dask:tcp://10.0.0.1:8786")


def test_a_file_of_another_kind_is_not_written_over(make: Maker, tmp_path: Path) -> None:
    out = tmp_path / "notes.txt"
    out.write_text("mine")
    with pytest.raises(InputError, match="is something else; name another"):
        make((0.004,), 2, out)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(InputError, match="an HDF5 file of another program"):
        make((0.004,), 2, tmp_path / "other.h5")
    assert out.read_text() == "mine"


def diverge(job: RecordingJob) -> None:
    """End as a diverged run does."""
    raise RunError("the run diverged: particle 3 is not finite")


def test_a_diverged_run_ends_the_recording_with_its_sentence(
    make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.training.record.record_run", diverge)
    with pytest.raises(RunError, match=r"^the run diverged: particle 3 is not finite$"):
        make(HEIGHTS, FRAMES, tmp_path / "data.h5")
    assert not (tmp_path / "data.h5").exists()


def kill_itself(job: RecordingJob) -> None:
    """End as where memory has run out."""
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.validation
def test_a_recording_that_is_killed_again_and_again_says_how_it_goes_on(
    make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.training.record.record_run", kill_itself)
    with pytest.raises(RunError, match=r"run0\.part: its process was ended by SIGKILL, 3 times; "):
        make(HEIGHTS[:1], FRAMES, tmp_path / "data.h5")


def test_a_moved_folder_is_still_the_same_run(
    recorded: Recording, scene_file: Path, tmp_path: Path
) -> None:
    moved = tmp_path / "elsewhere"
    shutil.copytree(scene_file.parent, moved)
    shutil.copy(recorded.out, moved / "data.h5")
    again = record(
        moved / "scene.toml", HEIGHTS, FRAMES, moved / "data.h5", SUBSTEPS, features=True
    )
    assert again.resumed == 2 * (FRAMES + 1)
    surface = moved / "lumen.ply"
    surface.write_bytes(surface.read_bytes().replace(b"lumen of", b"LUMEN of", 1))
    with pytest.raises(InputError, match="holds a run of another surface_sha256"):
        record(moved / "scene.toml", HEIGHTS, FRAMES, moved / "data.h5", SUBSTEPS, features=True)
