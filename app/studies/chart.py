"""`vesselflow chart`: what each method costs against how far it is from a finer pour.

Every method of `app.studies.methods` pours the same column in a process of its own, since Taichi
frees no field, one after the other.  Wall times are divided by what a small fixed loop took
meanwhile, so that a machine that is busy now and then does not favour anyone.
"""

import math
import os
import statistics
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from app.files import read_rows, write_rows
from app.jobs.process import in_own_process, report
from app.jobs.runner import run_jobs
from app.jobs.study import run_study
from app.progress import duration
from app.studies.methods import (
    CHARTED,
    DISCRETISATION_FLOOR,
    PEERS,
    REFERENCE,
    Method,
    method_of_weights,
)
from app.studies.splishsplash import require_peer
from app.studies.timed_run import (
    RULES,
    Errors,
    Grid,
    Rules,
    TimedRun,
    Trace,
    errors_of,
    require_falling,
)
from taichi_sph.errors import InputError, RunError
from taichi_sph.scene import Scene
from taichi_sph.system import replaced

CELL = 4.0
"""Width of the coarse cells over the scene's spacing."""
PROBES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Step factors tried for the largest that lives, upwards until one dies; then once in between."""


@dataclass(frozen=True)
class Row:
    """One method on one scene."""

    scene: str
    until: float
    """Simulated time [s]."""
    method: str
    curve: str
    blood_particles: int
    died: str
    """Empty, or the rule that it broke."""
    survived: float
    """Part of the time that it lived."""
    steps: int
    step_factor: float
    milliseconds_per_step: float
    wall_per_simulated: float
    """Wall seconds for a simulated second."""
    yardstick: float
    """What the fixed loop took meanwhile, median [ms]."""
    leaks: int
    path: float
    drained: float
    energy: float
    field: float
    compression: float
    half_drained: float

    @property
    def key(self) -> tuple[str, float, str]:
        """Scene, time and method."""
        return self.scene, self.until, self.method

    @property
    def normalised_cost(self) -> float:
        """Wall seconds for a simulated second on a machine where the loop takes 1 ms."""
        return self.wall_per_simulated / self.yardstick


@dataclass(frozen=True)
class Job:
    """A method on a scene."""

    scene: Scene
    method: Method
    until: float
    """[s]"""
    reference: Path | None
    """File of the trace that it is compared with; None if it is measured only."""
    arch: str
    threads: int | None

    @property
    def key(self) -> tuple[str, float, str]:
        """Scene, time and method."""
        return self.scene.name, self.until, self.method.name

    @property
    def frames(self) -> int:
        """Frames to the end."""
        return round(self.until / self.scene.frame_interval)

    def __str__(self) -> str:
        return f"{self.scene.name}, {self.method.name}"


def machine_load() -> Callable[[], float]:
    """A loop that gathers and computes on all threads; calling it gives its wall time [ms]."""
    import taichi as ti

    n = 1 << 18
    values = ti.field(float, n)

    @ti.kernel
    def gather() -> float:
        total = 0.0
        for i in range(n):
            x = values[(i * 7919) % n] + float(i)
            for _ in range(8):
                x = ti.sqrt(x + 1.0)
            total += x
        return total

    gather()

    def measure() -> float:
        before = time.perf_counter()
        gather()
        return 1e3 * (time.perf_counter() - before)

    return measure


def _grid_of(scene: Scene, simulation: Any) -> Grid:
    """The coarse grid of a scene, the same for all methods."""
    corners = simulation.vessel.vertices
    return Grid.over(corners.min(axis=0), corners.max(axis=0), CELL * scene.discretization.spacing)


def check_end(scene: Scene, until: float) -> None:
    """Refuse a time [s] too short to measure.

    Raises:
        InputError: it is.
    """
    if round(until / scene.frame_interval) < 2:
        raise InputError(
            f"--until {until:g}: the first frame compiles and is not timed; give at least "
            f"{2 * scene.frame_interval:g} s, two frames of {scene.name}"
        )


def run_timed(job: Job, rules: Rules | None) -> tuple[TimedRun, float]:
    """Run a method, with what `machine_load` gave meanwhile, median [ms]; starts Taichi."""
    from taichi_sph.runtime import start

    start(job.arch, "f32", job.threads)
    if job.threads:
        os.environ["OMP_NUM_THREADS"] = str(job.threads)  # of a peer, which is not loaded yet
    interval = job.scene.frame_interval
    simulation = job.method.simulation(job.scene)
    grid = _grid_of(job.scene, simulation)
    trace = Trace.of(job.scene)
    run = TimedRun(job.method.name, simulation, trace, grid, rules)
    load, loads = machine_load(), []
    for frame in range(1, job.frames + 1):
        run.frame(frame * interval)
        loads.append(load())
        report(frame / job.frames)
        if run.failure or run.empty:
            break
    return run, statistics.median(loads)


def reference_trace(job: Job) -> Trace:
    """The reference's trace; starts Taichi.

    Raises:
        RunError: it failed.
    """
    run, _ = run_timed(job, None)
    if run.failure:
        raise RunError(f"{job.scene.name}: the reference itself died: {run.failure}")
    return run.trace


def measure(job: Job) -> Row:
    """A method's row; starts Taichi."""
    assert job.reference is not None
    run, load = run_timed(job, RULES)
    simulation, lived = run.simulation, len(run.seconds)
    errors = errors_of(run.trace, load_trace(job.reference)) if lived else NOTHING
    # An empty vessel costs nothing for the rest of the time.
    simulated = job.scene.frame_interval * ((lived if run.failure else job.frames) - 1)
    return Row(
        scene=job.scene.name,
        until=job.until,
        method=job.method.name,
        curve=job.method.curve,
        blood_particles=simulation.derived.blood_particles,
        died=run.failure,
        survived=lived / job.frames if run.failure else 1.0,
        steps=simulation.steps,
        step_factor=job.method.step_factor or 1.0,
        milliseconds_per_step=run.milliseconds_per_step,
        wall_per_simulated=sum(run.seconds[1:]) / simulated if simulated > 0.0 else math.nan,
        yardstick=load,
        leaks=run.most_leaks,
        **asdict(errors),
    )


NOTHING = Errors(*[math.nan] * len(fields(Errors)))


def save_trace(path: Path, trace: Trace) -> None:
    """Write a trace as .npz, whole or not at all."""
    with replaced(path) as file:
        arrays: dict[str, Any] = {k: np.asarray(v) for k, v in vars(trace).items()}
        np.savez_compressed(file, **arrays)


def load_trace(path: Path) -> Trace:
    """What `save_trace` wrote.

    Raises:
        InputError: it is something else, or cut.
    """
    try:
        with path.open("rb") as stream, np.load(stream) as file:
            found = {name: file[name] for name in file.files}
        numbers = {name: float(value) for name, value in found.items() if value.ndim == 0}
        return Trace(**numbers, **{k: list(v) for k, v in found.items() if k not in numbers})  # type: ignore[arg-type]
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error):
        raise InputError(f"{path}: no reference of a chart, or a cut one; delete it") from None


def measure_with_step_search(job: Job) -> list[Row]:
    """The row of a method; of its largest step that lives, if it asks for that."""
    if job.method.step_factor is not None:
        return [measure(job)]

    def probe(factor: float) -> Row:
        return in_own_process(measure, replace(job, method=replace(job.method, step_factor=factor)))

    best: Row | None = None
    for number, factor in enumerate(PROBES, 1):
        row = probe(factor)
        report(number / (len(PROBES) + 1))
        if row.died:
            break
        best = row
    if best is None or not row.died:
        return [row]
    between = probe(math.sqrt(best.step_factor * row.step_factor))
    return [best if between.died else between]


def select_methods(weights: Sequence[Path], only: str, peer: bool) -> list[Method]:
    """Methods, other programs and networks of these files, that have `only` in their name.

    Raises:
        InputError: weights cannot be read, `only` fits nothing, or a peer is not installed.
    """
    if peer:
        require_peer()
    methods = [*CHARTED, *(PEERS if peer else ()), *(method_of_weights(path) for path in weights)]
    found = [method for method in methods if only in method.name]
    if not found:
        names = "; ".join(method.name for method in methods)
        raise InputError(f"--only {only}: no method has this in its name; there are {names}")
    return found


def tell(rows: Sequence[Row]) -> str:
    """What came of a method."""
    (row,) = rows
    state = f"died ({row.died})" if row.died else f"drained {100 * row.drained:.1f} %"
    return f"{row.scene}, {row.method}: {row.wall_per_simulated:.3g} s a simulated s, {state}"


def main(
    scenes: Sequence[Scene],
    until: float | None,
    out: Path,
    methods: Sequence[Method],
    arch: str,
    threads: int | None,
    scheduler: str | None = None,
) -> list[Row]:
    """Measure what is not yet in `out`; all rows that it then has.

    Here one method runs at a time, for it is timed.

    Raises:
        InputError: a scene cannot be used, or `out` holds something else.
        RunError: the reference failed, or some could not be measured.
    """
    rows = read_rows(out, Row)
    for scene in scenes:
        require_falling(scene, "chart")
        check_end(scene, until or scene.duration)
    for scene in scenes:
        end = until or scene.duration
        there = {row.key for row in rows}
        jobs = [
            Job(scene, method, end, None, arch, threads)
            for method in (DISCRETISATION_FLOOR, *methods)
        ]
        if all(job.key in there for job in jobs):
            continue
        reference = _reference(jobs[0], out, scheduler)
        rows = run_study(
            rows, [replace(job, reference=reference) for job in jobs], measure_with_step_search,
            lambda found: write_rows(out, found), tell, scene.name, scheduler=scheduler,
        )  # fmt: skip
    return rows


def _reference(like: Job, out: Path, scheduler: str | None) -> Path:
    """File beside `out` of the trace that all methods of a scene are compared with.

    Raises:
        RunError: it failed.
    """
    path = out.with_name(f"{out.stem}.{like.scene.name}-{like.until:g}s.npz")
    if path.exists():
        load_trace(path)
        return path
    before = time.perf_counter()
    job = replace(like, method=REFERENCE)
    (ended,) = run_jobs(reference_trace, [job], scheduler=scheduler, title=str(job))
    save_trace(path, ended.value())
    took = duration(time.perf_counter() - before)
    print(f"{like.scene.name}: the reference took {took}", file=sys.stderr)
    return path
