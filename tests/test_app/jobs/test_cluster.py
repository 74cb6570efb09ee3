"""Jobs on a real Dask cluster: what travels, workers that are killed, a scheduler that is lost."""

import os
import signal
import time
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="an extra: pip install 'vesselflow[cluster]'")

import app.jobs.cluster
from app.jobs.runner import run_jobs
from cluster import Cluster, cluster, wait_for
from taichi_sph.errors import InputError, RunError
from taichi_sph.scene import parse_scene
from work import Errand, read_inputs, run_errand

SCENE = """
title = "A tank"
duration = 0.5
frame_interval = 0.002
gravity = [0.0, 0.0, -9.81]
vessel = { surface = "../shapes/lumen.ply" }
openings.top = { centre = [0, 0, 0], flow = 1e-6, waveform = "beat.csv" }
openings.side = { centre = [1, 0, 0], flow = 1e-6, waveform = "common_carotid" }
column = { opening = "top", particles = 9 }
discretization = { spacing = 0.001 }
"""


@pytest.fixture(scope="module")
def two_workers(tmp_path_factory: pytest.TempPathFactory):
    with cluster(tmp_path_factory.mktemp("cluster")) as running:
        yield running


def test_jobs_are_done_and_refused_as_here(two_workers: Cluster) -> None:
    jobs = [Errand(1), Errand(2), Errand(3, "refuse"), Errand(4, "exit")]
    ended = run_jobs(run_errand, jobs, scheduler=two_workers.address)
    found = {done.job.number: done for done in ended}
    assert (found[1].value(), found[2].value()) == (1, 4)
    with pytest.raises(InputError, match="errand 3: refused"):
        found[3].value()
    with pytest.raises(RunError, match=r"errand 4: its process ended with exit code 3, 3 times, "):
        found[4].value()


def test_files_travel_as_content(two_workers: Cluster, tmp_path: Path) -> None:
    for folder in ("shapes", "scene"):
        (tmp_path / folder).mkdir()
    (tmp_path / "shapes" / "lumen.ply").write_text("a surface")
    (tmp_path / "scene" / "beat.csv").write_text("a beat")
    (tmp_path / "weights.npz").write_text("a network")
    scene = parse_scene(SCENE, "scene", tmp_path / "scene", "tank")
    (done,) = run_jobs(
        read_inputs, [(scene, tmp_path / "weights.npz")], scheduler=two_workers.address
    )
    surface, weights, waves, folder = done.value()
    assert (surface, weights, waves[0]) == ("a surface", "a network", "a beat")
    assert len(waves) == 1, "the built-in one is no file"
    assert Path(folder) != tmp_path / "scene"
    assert not Path(folder).exists(), "nothing is left on a worker"


def test_the_job_of_a_killed_worker_is_done_by_another(tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    with cluster(tmp_path) as running:
        jobs = [Errand(1, "slow"), Errand(2, "wait", notes), Errand(3, "slow")]
        ended = run_jobs(run_errand, jobs, scheduler=running.address)
        first = next(ended)
        assert first.value() == first.job.number**2
        wait_for(notes.exists)
        # Whose the waiting process is: it says who its parent is.
        child = int(notes.read_text().split()[1])
        parent = int(Path(f"/proc/{child}/stat").read_text().split()[3])
        (worker,) = [w for w in running.workers if w.pid == parent]
        worker.send_signal(signal.SIGKILL)
        wait_for(lambda: len(notes.read_text().splitlines()) == 2)
        second = int(notes.read_text().splitlines()[1].split()[1])
        assert int(Path(f"/proc/{second}/stat").read_text().split()[3]) != parent
        ended.close()
        # Cancelled: the process on the worker that lives is ended.
        wait_for(lambda: not Path(f"/proc/{second}").exists())


def test_a_lost_scheduler_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(app.jobs.cluster, "LOST_AFTER", 1.0)
    notes = tmp_path / "notes"
    with cluster(tmp_path, 1) as running:
        ended = run_jobs(run_errand, [Errand(1, "wait", notes)], scheduler=running.address)
        begun = time.monotonic()

        def stop(*_: object) -> None:
            wait_for(notes.exists)
            os.kill(running.scheduler.pid, signal.SIGKILL)

        import threading

        threading.Thread(target=stop, daemon=True).start()
        with pytest.raises(RunError, match="the scheduler is lost; the same command goes on"):
            next(ended)
        assert time.monotonic() - begun < 40.0


@pytest.mark.parametrize(
    ("scheduler", "message"),
    [
        ("slurm", "--scheduler slurm: allowed is dask:ADDRESS"),
        ("dask:", "--scheduler dask:: allowed is dask:ADDRESS"),
        ("dask:tcp://127.0.0.1:1", "no scheduler answers there"),
        ("dask:nonsense://x", "no scheduler answers there"),
    ],
)
def test_a_scheduler_that_is_none_is_refused(
    scheduler: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app.jobs.cluster, "CONNECTING", 1.0)
    with pytest.raises(InputError, match=message):
        list(run_jobs(run_errand, [Errand(1)], scheduler=scheduler))
