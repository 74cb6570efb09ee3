"""Record runs of the physics for training: a process for each run, one file for all."""

import contextlib
import hashlib
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from app import version
from app.files import check_output
from app.progress import Progress, duration
from nn import dataset
from nn.dataset import Proxies, RecordedState, RunMetadata, RunWriter
from nn.features import COUNT, TABLE_VERSION, FeatureScales
from nn.training.rollout import ReplaySimulation
from taichi_sph.derived import derive
from taichi_sph.errors import InputError, RunError
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.runtime import start
from taichi_sph.scene import Scene, read_scene

Show = Callable[[int, int, int], None]
"""Told a run's number, its states so far and its sub-steps so far."""


@dataclass(frozen=True)
class Task:
    """All that a process needs to record a run."""

    number: int
    scene: Scene
    """With the run's own column."""
    facts: RunMetadata
    part: Path
    """The run's file while it is under way."""
    threads: int | None


@dataclass(frozen=True)
class Recording:
    """What was recorded."""

    out: Path
    runs: tuple[RunMetadata, ...]
    resumed: int
    """States that were there already."""
    size: int
    """Of the file [bytes]."""
    wall_time: float
    """[s]"""

    def __str__(self) -> str:
        first = self.runs[0]
        particles = ", ".join(str(facts.particles) for facts in self.runs)
        there = f", {self.resumed} states were there already" if self.resumed else ""
        return (
            f"{self.out}: {len(self.runs)} runs of {first.frames} frames, "
            f"{self.size / 1e6:.1f} MB, {duration(self.wall_time)}{there}\n"
            f"  blood particles {particles}; frame interval {1e3 * first.frame_interval:.4g} ms, "
            f"{first.substeps} sub-steps of {1e3 * first.substep:.4g} ms"
        )


def record(
    scene_path: Path,
    heights: Sequence[float],
    frames: int,
    out: Path,
    substeps: int = 8,
    features: bool = False,
    processes: int = 1,
    arch: str = "cpu",
    threads: int | None = None,
    seed: int = 0,
    scheduler: str | None = None,
) -> Recording:
    """Record one run of a scene for each column height into a dataset.

    A recording that was cut short goes on where it was: every run has a file of its own beside
    `out` until all are done.

    Args:
        scene_path: the scene's file.
        heights: of the blood column [m], one a run.
        frames: frames with a target, a run.
        out: the dataset.
        substeps: sub-steps M in a frame interval.
        features: store features and targets too.
        processes: how many runs at once; the result is the same.
        arch: cpu or gpu.
        threads: CPU threads of each process; all of them shared out by default.
        seed: of the proxies' places.
        scheduler: "dask:ADDRESS" records on a cluster that sees the same folders.

    Raises:
        InputError: something given is of no use; found before anything is simulated.
        RunError: a run diverged, or its process was killed.
        OSError: the disk is full.
    """
    began = time.perf_counter()
    check_output(out, "--out", dataset.SIGNATURE)
    tasks = plan(scene_path, heights, frames, out, substeps, features, arch, threads, seed)
    runs = tuple(task.facts for task in tasks)
    if out.exists() and out.stat().st_size > 0:
        _require_recorded(out, runs)
        return Recording(out, runs, len(runs) * (frames + 1), out.stat().st_size, 0.0)
    there = {task.number: dataset.committed_states(task.part, task.facts) for task in tasks}
    _require_room(tasks)
    interval = runs[0].frame_interval
    progress = Progress(len(runs) * frames * interval, f"{tasks[0].scene.name}, {len(runs)} runs")
    seen = {number: (states, 0) for number, states in there.items()}
    wanted = [task for task in tasks if there[task.number] <= frames]

    def show(number: int, states: int, steps: int) -> None:
        seen[number] = states, steps
        simulated = sum(max(0, states - 1) for states, _ in seen.values()) * interval
        progress.show(simulated, sum(steps for _, steps in seen.values()), 0)

    try:
        if scheduler is None:
            record_here(wanted, processes, show)
        else:
            record_on_cluster(wanted, scheduler, show)
    finally:
        progress.close()
    with Console(file=sys.stderr).status(f"compressing into {out}"):
        dataset.merge([task.part for task in tasks], out)
    wall_time = time.perf_counter() - began
    return Recording(out, runs, sum(there.values()), out.stat().st_size, wall_time)


def plan(
    scene_path: Path,
    heights: Sequence[float],
    frames: int,
    out: Path,
    substeps: int,
    features: bool,
    arch: str,
    threads: int | None,
    seed: int,
) -> list[Task]:
    """What there is to do, as for `record`; every column is tried, so that none fails hours later.

    Raises:
        InputError: a height or the scene cannot be used, or files of another recording are there.
    """
    if not heights:
        raise InputError("--heights: none given; at least one height [m] is needed")
    if len(set(heights)) < len(heights):
        given = ", ".join(f"{height:g}" for height in heights)
        raise InputError(f"--heights {given}: one is given twice; runs would be the same")
    for option, value in (("--frames", frames), ("--substeps", substeps)):
        if value < 1:
            raise InputError(f"{option} {value}: at least 1 is needed")
    scene = read_scene(scene_path)
    vessel = read_vessel(scene)
    surface = (Path(scene.folder) / scene.vessel.surface).read_bytes()
    tasks = []
    for number, height in enumerate(heights):
        if not height > 0.0:
            raise InputError(f"--heights {height:g}: a height is greater than 0 m")
        column = msgspec.structs.replace(
            scene.column, height=float(height), particles=None, full=False
        )
        blood = vessel.fill_column(column, scene.discretization.spacing)
        derived = derive(scene, vessel, len(blood), 0)
        facts = RunMetadata(
            scene=scene.text,
            scene_name=scene.name,
            scene_folder=scene.folder,
            surface_sha256=hashlib.sha256(surface).hexdigest(),
            program_version=version(),
            architecture=arch,
            seed=seed,
            height=float(height),
            frames=frames,
            particles=len(blood),
            spacing=scene.discretization.spacing,
            support_radius=derived.support_radius,
            sound_speed=derived.sound_speed,
            substep=derived.step,
            substeps=substeps,
            frame_interval=substeps * derived.step,
            feature_version=TABLE_VERSION if features else 0,
        )
        part = out.with_name(f"{out.name}.run{number}.part")
        tasks.append(
            Task(number, msgspec.structs.replace(scene, column=column), facts, part, threads)
        )
    known = {task.part for task in tasks}
    for path in sorted(out.parent.iterdir()):
        ours = path.name.startswith(f"{out.name}.run") and path.name.endswith(".part")
        if ours and path not in known:
            raise InputError(
                f"{path}: left by a recording of more heights; delete it, or record those"
            )
    return tasks


def _feature_count(facts: RunMetadata) -> int:
    return COUNT if facts.feature_version else 0


def _require_recorded(out: Path, runs: Sequence[RunMetadata]) -> None:
    """Refuse to write over a dataset; the one that is wanted may stay.

    Raises:
        InputError: it holds something else.
    """
    advice = "name another file, or delete it"
    with dataset.Dataset(out) as data:
        if len(data.runs) != len(runs):
            raise InputError(f"--out {out}: holds {len(data.runs)} runs, not {len(runs)}; {advice}")
        for run, facts in zip(data.runs, runs, strict=True):
            dataset.require_same(run.facts, facts, f"--out {out}", advice)


def _require_room(tasks: Sequence[Task]) -> None:
    """Refuse a recording that the disk cannot hold, before hours are spent on it.

    Raises:
        InputError: what is missing of the runs does not fit, uncompressed and once more.
    """
    needed = sum(
        dataset.size_of(task.facts, _feature_count(task.facts)) * (1 if task.part.exists() else 2)
        for task in tasks
    )
    folder = tasks[0].part.parent
    files = os.statvfs(folder)
    free = files.f_bavail * files.f_frsize
    if needed > free:
        raise InputError(
            f"--out: {needed / 1e9:.3g} GB are needed meanwhile in {folder}, "
            f"{free / 1e9:.3g} GB are free"
        )


def record_run(task: Task, report: Callable[[int, int], None]) -> None:
    """Record a run in this process, or go on with it; reports states and sub-steps so far.

    Starts Taichi, so it needs a process of its own.

    Raises:
        InputError: the run's file holds something else.
        RunError: the run diverged.
        OSError: the disk is full.
    """
    facts = task.facts
    start(facts.architecture, "f32", task.threads, random_seed=facts.seed)
    replay = ReplaySimulation(task.scene, read_vessel(task.scene), facts.seed)
    scales = FeatureScales(
        facts.support_radius, facts.spacing, facts.frame_interval, facts.sound_speed,
        task.scene.discretization.wall_spacing_ratio,
    )  # fmt: skip
    wall = replay.simulation.wall
    proxies = Proxies(*(f.to_numpy() for f in (wall.position, wall.normal, wall.volume)))
    with RunWriter(task.part, facts, proxies, _feature_count(facts)) as writer:
        there = writer.committed
        before: RecordedState | None = None
        if there:
            before = writer.state(there - 1)
            replay.restore(before, (there - 1) * facts.frame_interval, writer.steps())
        else:
            replay.settle()
        report(there, replay.simulation.steps)
        for frame in range(there, facts.frames + 1):
            if frame:
                replay.advance_to(frame * facts.frame_interval)
                replay.settle()
            now = replay.state()
            acceleration = np.zeros_like(now.velocity)
            if before is not None:
                acceleration = dataset.mean_acceleration(
                    before.velocity, now.velocity, now.alive, facts.frame_interval
                )
            found = None
            if facts.feature_version and frame < facts.frames:
                replay.set_acceleration(acceleration)
                found = replay.features(scales)[:, :COUNT]
            writer.append(now, acceleration, found, replay.substeps())
            before = now
            report(frame + 1, replay.simulation.steps)


def work(task: Task, parent: Connection) -> None:
    """A process that records a run: reports, or the error it ended with, go to `parent`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    with contextlib.suppress(BrokenPipeError):  # the parent is gone: so are we
        try:
            record_run(task, lambda states, steps: parent.send((states, steps)))
        except BrokenPipeError:
            raise
        except (InputError, RunError, OSError) as error:
            parent.send(error)


def record_here(
    tasks: Sequence[Task],
    processes: int,
    show: Show,
    target: Callable[[Task, Connection], None] = work,
) -> None:
    """Record runs, each in a process of its own, a number of them at once.

    Raises:
        InputError, RunError, OSError: what a run ended with, or that its process was killed.
    """
    context = multiprocessing.get_context("spawn")
    shared = max(1, (os.cpu_count() or 1) // max(1, min(processes, len(tasks))))
    waiting = deque(tasks)
    running: dict[Any, tuple[Any, Task]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < processes:
                task = waiting.popleft()
                if task.threads is None:
                    task = Task(task.number, task.scene, task.facts, task.part, shared)
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=target, args=(task, theirs), daemon=True)
                process.start()
                theirs.close()
                running[ours] = process, task
            ready: list[Any] = wait(list(running))
            for connection in ready:
                process, task = running[connection]
                try:
                    message = connection.recv()
                except EOFError:
                    process.join()
                    del running[connection]
                    if process.exitcode:
                        raise RunError(
                            f"{task.part}: the process that recorded it ended with exit code "
                            f"{process.exitcode}; the same command goes on with it"
                        ) from None
                    continue
                if isinstance(message, Exception):
                    raise message
                show(task.number, *message)
    finally:
        for process, _ in running.values():
            process.terminate()
            process.join()


def record_on_cluster(tasks: Sequence[Task], scheduler: str, show: Show) -> None:
    """Record runs on the workers of a Dask cluster that see the same folders.

    Raises:
        InputError: the scheduler cannot be used; else as `record_here`.
    """
    kind, _, address = scheduler.partition(":")
    if kind != "dask" or not address:
        raise InputError(f"--scheduler {scheduler}: allowed is dask:ADDRESS")
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise InputError(
            f"--scheduler {scheduler}: needs Dask; install it with: pip install distributed"
        ) from None
    try:
        client = Client(address, timeout=20)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {scheduler}: no answer ({type(error).__name__})") from None
    with client:
        for future in as_completed(client.map(record_apart, tasks, pure=False)):
            show(*future.result())


def record_apart(task: Task) -> tuple[int, int, int]:
    """Record a run in a process of its own, from anywhere; returns number, states, sub-steps.

    Dask's workers are daemons with threads: they may not use multiprocessing, nor start Taichi.
    """
    program = "from app.training.record import serve; serve()"
    done = subprocess.run(
        [sys.executable, "-c", program], input=pickle.dumps(task), capture_output=True, check=False
    )
    if done.returncode:
        raise RunError(f"{task.part}: {done.stderr.decode(errors='replace').strip()[-2000:]}")
    answer = pickle.loads(done.stdout)
    if isinstance(answer, Exception):
        raise answer
    return task.number, *answer


def serve() -> None:
    """Record the run given on standard input; the last report, or the error, goes to output."""
    task = pickle.load(sys.stdin.buffer)
    answer: tuple[int, int] | Exception = (0, 0)

    def report(states: int, steps: int) -> None:
        nonlocal answer
        answer = states, steps

    try:
        record_run(task, report)
    except (InputError, RunError, OSError) as error:
        answer = error
    sys.stdout.buffer.write(pickle.dumps(answer))
