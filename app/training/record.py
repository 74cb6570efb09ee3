"""Record runs of the physics for training: a process for each run, one file for all."""

import contextlib
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Console
from rich.markup import escape

from app import version
from app.files import check_output, write_bytes
from app.jobs.cluster import address_of
from app.jobs.process import ProcessError, report
from app.jobs.runner import Finished, run_jobs
from app.progress import duration
from nn.dataset.reader import Dataset
from nn.dataset.schema import (
    SIGNATURE,
    Proxies,
    RecordedState,
    RunMetadata,
    mean_acceleration,
    require_same,
    size_of,
)
from nn.dataset.writer import RunWriter, committed_states, merge
from nn.features import PAPER_COUNT, TABLE_VERSION, FeatureScales
from nn.training.rollout import ReplaySimulation
from taichi_sph.assemble import initial_state
from taichi_sph.derived import derive
from taichi_sph.errors import InputError, RunError
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.runtime import start
from taichi_sph.scene import Scene, read_scene
from taichi_sph.scene_files import read_files, sha256


@dataclass(frozen=True)
class RecordingJob:
    """All that a process needs to record a run."""

    number: int
    scene: Scene
    """With the run's own column."""
    metadata: RunMetadata
    part: Path
    """The run's file while it is under way."""
    threads: int | None
    files: dict[str, bytes]
    """Contents of what the scene names, by the name there."""

    def __str__(self) -> str:
        return f"{self.part}"


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
        particles = ", ".join(str(run.particles) for run in self.runs)
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
        scheduler: "dask:ADDRESS" records on a Dask cluster, whose workers need none of the files.

    Raises:
        InputError: something given is of no use; found before anything is simulated.
        RunError: a run diverged, or its process was killed.
        OSError: the disk is full.
    """
    began = time.perf_counter()
    check_output(out, "--out", SIGNATURE)
    if scheduler is not None:
        address_of(scheduler)
    jobs = plan(scene_path, heights, frames, out, substeps, features, arch, threads, seed)
    runs = tuple(job.metadata for job in jobs)
    if out.exists() and out.stat().st_size > 0:
        _require_recorded(out, runs)
        return Recording(out, runs, len(runs) * (frames + 1), out.stat().st_size, 0.0)
    there = {job.number: committed_states(job.part, job.metadata) for job in jobs}
    _require_room(jobs)
    wanted = [job for job in jobs if there[job.number] <= frames]
    work: Callable[[RecordingJob], bytes | None] = record_run if scheduler is None else record_apart
    title = f"{jobs[0].scene.name}, {len(runs)} runs"
    with contextlib.closing(run_jobs(work, wanted, processes, scheduler, title)) as ended:
        for run in ended:
            content = _recorded(run)
            if content is not None:
                write_bytes(run.job.part, content)
    with Console(file=sys.stderr).status(f"compressing into {escape(str(out))}"):
        merge([job.part for job in jobs], out)
    wall_time = time.perf_counter() - began
    return Recording(out, runs, sum(there.values()), out.stat().st_size, wall_time)


def _recorded(run: Finished[RecordingJob, bytes | None]) -> bytes | None:
    """What a run that has ended left to write here, if anything.

    Raises:
        InputError, RunError, OSError: what it ended with, or that its process was killed.
    """
    if isinstance(run.error, ProcessError):
        raise RunError(f"{run.error}; the same command goes on with it")
    return run.value()


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
) -> list[RecordingJob]:
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
    contents = read_files(scene)
    jobs = []
    for number, height in enumerate(heights):
        if not height > 0.0:
            raise InputError(f"--heights {height:g}: a height is greater than 0 m")
        column = msgspec.structs.replace(
            scene.column, height=float(height), particles=None, full=False
        )
        column_scene = msgspec.structs.replace(scene, column=column)
        blood = initial_state(column_scene, vessel, seed).blood
        derived = derive(scene, vessel, len(blood), 0)
        metadata = RunMetadata(
            scene=scene.text,
            scene_name=scene.name,
            scene_folder=scene.folder,
            surface_sha256=sha256(contents[scene.vessel.surface]),
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
            tool_sha256=sha256(contents[scene.tool.surface]) if scene.tool else "",
        )
        part = out.with_name(f"{out.name}.run{number}.part")
        jobs.append(
            RecordingJob(
                number,
                column_scene,
                metadata,
                part,
                threads,
                contents,
            )
        )
    known = {job.part for job in jobs}
    for path in sorted(out.parent.iterdir()):
        ours = path.name.startswith(f"{out.name}.run") and path.name.endswith(".part")
        if ours and path not in known:
            raise InputError(
                f"{path}: left by a recording of more heights; delete it, or record those"
            )
    return jobs


def _feature_count(metadata: RunMetadata) -> int:
    return PAPER_COUNT if metadata.feature_version else 0


def _require_recorded(out: Path, runs: Sequence[RunMetadata]) -> None:
    """Refuse to write over a dataset; the one that is wanted may stay.

    Raises:
        InputError: it holds something else.
    """
    advice = "name another file, or delete it"
    with Dataset(out) as data:
        if len(data.runs) != len(runs):
            raise InputError(f"--out {out}: holds {len(data.runs)} runs, not {len(runs)}; {advice}")
        for run, wanted in zip(data.runs, runs, strict=True):
            require_same(run.facts, wanted, f"--out {out}", advice)


def _require_room(jobs: Sequence[RecordingJob]) -> None:
    """Refuse a recording that the disk cannot hold, before hours are spent on it.

    Raises:
        InputError: what is missing of the runs does not fit, uncompressed and once more.
    """
    needed = sum(
        size_of(job.metadata, _feature_count(job.metadata)) * (1 if job.part.exists() else 2)
        for job in jobs
    )
    folder = jobs[0].part.parent
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise InputError(
            f"--out: {needed / 1e9:.3g} GB are needed meanwhile in {folder}, "
            f"{free / 1e9:.3g} GB are free"
        )


def record_run(job: RecordingJob) -> None:
    """Record a run, or go on with it; starts Taichi, so it needs a process of its own.

    Raises:
        InputError: the run's file holds something else.
        RunError: the run diverged.
        OSError: the disk is full.
    """
    metadata = job.metadata
    start(metadata.architecture, "f32", job.threads, random_seed=metadata.seed)
    replay = ReplaySimulation(job.scene, read_vessel(job.scene), metadata.seed)
    scales = FeatureScales(
        metadata.support_radius, metadata.spacing, metadata.frame_interval, metadata.sound_speed,
        job.scene.discretization.wall_spacing_ratio,
    )  # fmt: skip
    wall = replay.simulation.wall
    proxies = Proxies(*(f.to_numpy() for f in (wall.position, wall.normal, wall.volume)))
    count = _feature_count(metadata)
    with RunWriter(job.part, metadata, proxies, job.files, count) as writer:
        there = writer.states
        before: RecordedState | None = None
        if there:
            before = writer.state(there - 1)
            replay.restore(before, (there - 1) * metadata.frame_interval, writer.steps())
        else:
            replay.settle()
        for frame in range(there, metadata.frames + 1):
            if frame:
                replay.advance_to(frame * metadata.frame_interval)
                replay.settle()
            now = replay.state()
            acceleration = np.zeros_like(now.velocity)
            if before is not None:
                acceleration = mean_acceleration(
                    before.velocity, now.velocity, now.alive, metadata.frame_interval
                )
            found = None
            if metadata.feature_version and frame < metadata.frames:
                replay.set_acceleration(acceleration)
                found = replay.features(scales)[:, :PAPER_COUNT]
            writer.append(now, acceleration, found, replay.substeps())
            before = now
            report((frame + 1 - there) / (metadata.frames + 1 - there))


def record_apart(job: RecordingJob) -> bytes:
    """Record a run on another machine, or go on with what came along; the content of its file."""
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / "part"
        if job.part.is_file():
            shutil.copyfile(job.part, part)
        record_run(replace(job, part=part))
        return part.read_bytes()
