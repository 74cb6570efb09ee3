"""`vesselflow stability`: which methods live where methods fail.

Every method of TESTED meets every case of CASES from several starts, and app.studies.timed_run says
when it has failed.  Physics and networks are judged alike.
"""

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.files import console, percent, read_rows, table, write_rows
from app.jobs.process import report
from app.jobs.study import run_study
from app.models import MODELS
from app.studies.cases import CASES, StartedRun, column_start
from app.studies.methods import TESTED, Method, method_of_weights
from app.studies.timed_run import RULES, TimedRun, Trace
from taichi_sph.errors import InputError
from taichi_sph.simulation import Simulation

FRAMES = 40
"""Looks at the state in a case."""
JITTER = 0.02
"""Every start but the first has its particles moved by as much of a spacing."""
QUICK = 0.2
"""Longest case of --quick [s]; it has only what `run --model` takes."""


@dataclass(frozen=True)
class Row:
    """A method from one start of a case."""

    method: str
    case: str
    start: int
    survived: float
    """Part of the case's time; 1 if it lived."""
    died: str
    """Empty, or why."""
    leaks: int
    """Most at a frame."""
    compression: float
    """Largest 99th percentile."""
    drained: float
    """Part that left, at the end."""
    wall_corrections: int
    fallback_share: float

    @property
    def key(self) -> tuple[str, str]:
        """Method and case."""
        return self.method, self.case


@dataclass(frozen=True)
class Job:
    """A method in a case."""

    method: Method
    case: int
    """Number of the case in CASES."""
    starts: int
    arch: str

    @property
    def key(self) -> tuple[str, str]:
        """Method and case."""
        return self.method.name, CASES[self.case].name

    def __str__(self) -> str:
        return f"{CASES[self.case].name}, {self.method.name}"


def measure(job: Job) -> list[Row]:
    """A method in a case, from all starts; needs a process of its own."""
    from taichi_sph.runtime import start

    start(job.arch, "f32", 1)
    case = CASES[job.case]
    with tempfile.TemporaryDirectory() as folder:
        base = case.scene(Path(folder))
        stretched = (job.method.step_factor or 1.0) * case.step
        method = replace(
            job.method, spacing=job.method.spacing * case.spacing, step_factor=stretched
        )
        scene = method.scene(base)
        simulation = Simulation.from_scene(scene, method.maker(scene))
    filled = simulation.positions().astype(float)
    return [_from_start(simulation, filled, job, k) for k in range(job.starts)]


def _from_start(simulation: Simulation, filled: np.ndarray, job: Job, k: int) -> Row:
    """A row: the run from one start."""
    case, generator = CASES[job.case], np.random.default_rng(k)
    simulation.restart_with(filled, np.zeros_like(filled))
    x, v = (case.begin or column_start)(simulation, generator)
    if k:
        d = simulation.scene.discretization.spacing
        x = x + JITTER * d * generator.uniform(-1.0, 1.0, x.shape)
    simulation.restart_with(x, np.nan_to_num(v))
    if np.isnan(v).any():  # what a user may not give, and a model must not survive
        simulation.particles.replace({"identity": np.arange(len(x)), "position": x, "velocity": v})
    interval = case.until / FRAMES
    run = TimedRun(job.method.name, simulation, Trace(interval), rules=RULES)
    for frame in range(1, FRAMES + 1):
        run.frame(frame * interval)
        report((k + frame / FRAMES) / job.starts)
        if run.failure or run.empty:
            break
    failure = run.failure
    if not failure and case.check is not None:
        failure = case.check(StartedRun(run, (x, v), case))
    if case.must_fail_with:
        expected = case.must_fail_with
        failure = "" if expected in failure else failure or f"did not stop: {expected}"
    trace = run.trace
    return Row(
        method=job.method.name,
        case=case.name,
        start=k,
        survived=len(trace.drained) / FRAMES if run.failure and failure else 1.0,
        died=failure,
        leaks=run.most_leaks,
        compression=max(trace.compression, default=0.0),
        drained=trace.drained[-1] if trace.drained else 0.0,
        wall_corrections=simulation.wall_corrections,
        fallback_share=simulation.fallback_share,
    )


def wilson(alive: int, starts: int) -> tuple[float, float]:
    """95 % interval of a fraction (Wilson 1927)."""
    from scipy.stats import binomtest

    interval = binomtest(alive, starts).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def select_jobs(
    starts: int, quick: bool, only: str, weights: Sequence[Path], arch: str
) -> list[Job]:
    """Methods in cases, those that have `only` in "METHOD, CASE".

    Raises:
        InputError: weights cannot be used, or `only` fits nothing.
    """
    methods = [*TESTED]
    for path in weights:
        method = method_of_weights(path)
        methods.append(method)
        if "direct" in method.name:
            methods.append(replace(method, name=f"{method.name}, no guard", guarded=False))
    jobs = [
        Job(method, k, 1 if quick else starts, arch)
        for k, case in enumerate(CASES)
        for method in methods
        if only in f"{method.name}, {case.name}"
        and not (quick and (case.until > QUICK or method.name not in MODELS))
    ]
    if not jobs:
        raise InputError(
            f'--only {only}: no "METHOD, CASE" has this; methods are '
            f"{'; '.join(m.name for m in methods)}; cases are {'; '.join(c.name for c in CASES)}"
        )
    return jobs


def tell(rows: Sequence[Row]) -> str:
    """What came of a method in a case."""
    alive = sum(not row.died for row in rows)
    return f"{rows[0].case}, {rows[0].method}: {alive} of {len(rows)} live"


def main(
    out: Path,
    starts: int,
    quick: bool,
    only: str,
    weights: Sequence[Path],
    processes: int,
    plot: Path | None,
    arch: str,
    scheduler: str | None = None,
) -> None:
    """Measure what is not yet in `out`, print who failed where and why, and draw it.

    Raises:
        InputError: weights cannot be used, `out` holds something else, or `only` fits nothing.
        RunError: some could not be measured.
    """
    rows = read_rows(out, Row)
    jobs = select_jobs(starts, quick, only, weights, arch)
    rows = run_study(
        rows, jobs, measure, lambda found: write_rows(out, found), tell, "stability",
        processes, scheduler,
    )  # fmt: skip
    print_table(rows)
    if plot is not None:
        draw(rows, plot)


def cell(rows: Sequence[Row], method: str, case: str) -> list[Row]:
    """All starts of a method in a case."""
    return [row for row in rows if (row.method, row.case) == (method, case)]


def methods_of(rows: Sequence[Row]) -> list[str]:
    """Methods in the order of TESTED, then the others."""
    found = list(dict.fromkeys(row.method for row in rows))
    known = [method.name for method in TESTED if method.name in found]
    return known + sorted(name for name in found if name not in known)


def cases_of(rows: Sequence[Row]) -> list[str]:
    """Cases in the order of CASES."""
    found = {row.case for row in rows}
    return [case.name for case in CASES if case.name in found]


def print_table(rows: Sequence[Row]) -> None:
    """How many live, with the interval, and each death with its reason."""
    found = table("who lives", "method", "alive", "95 %", "leaks", "worst compression")
    for name in methods_of(rows):
        mine = [row for row in rows if row.method == name]
        alive = sum(not row.died for row in mine)
        low, high = wilson(alive, len(mine))
        living = [row for row in mine if not row.died]
        found.add_row(
            name,
            f"{alive}/{len(mine)}",
            f"{100 * low:.0f}-{100 * high:.0f} %",
            str(sum(row.leaks for row in living)),
            percent(max((row.compression for row in living), default=math.nan)),
        )
    console().print(found)
    for name in methods_of(rows):
        for case in cases_of(rows):
            mine = cell(rows, name, case)
            failed = [row for row in mine if row.died]
            if failed:
                console().print(
                    f"{name}, {case}: {len(mine) - len(failed)}/{len(mine)} live; "
                    f"{failed[0].died} at {100 * failed[0].survived:.0f} %",
                    soft_wrap=True,
                )


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the matrix, and how many live over time."""
    import matplotlib
    from matplotlib.figure import Figure

    methods, cases = methods_of(rows), cases_of(rows)
    figure = Figure(
        figsize=(0.62 * len(cases) + 4.0, 0.4 * len(methods) + 6.2), layout="constrained"
    )
    matrix, curves = figure.subplots(2, 1, height_ratios=[0.4 * len(methods) + 1.5, 4.0])
    grid = np.full((len(methods), len(cases)), np.nan)
    for i, method in enumerate(methods):
        for j, case in enumerate(cases):
            mine = cell(rows, method, case)
            if not mine:
                continue
            grid[i, j] = np.mean([not row.died for row in mine])
            worst = 100.0 * max(row.compression for row in mine)
            leaks = max(row.leaks for row in mine)
            text = f"{worst:.0f}" + (f"\n{leaks}!" if leaks else "")
            matrix.text(j, i, text, ha="center", va="center", fontsize=7)
    matrix.imshow(grid, cmap="RdYlGn", vmin=0.0, vmax=1.0, aspect="auto", alpha=0.75)
    matrix.set_yticks(range(len(methods)), methods)
    matrix.set_xticks(range(len(cases)), cases, rotation=50, ha="right", fontsize=8)
    matrix.set_title("green: all starts live; number: compression [%], and leaks with a mark")
    curves.set_prop_cycle(color=matplotlib.colormaps["tab20"].colors)  # type: ignore[attr-defined]
    for method in methods:
        starts = sum(row.method == method for row in rows)
        ended = [row.survived for row in rows if row.method == method and row.died]
        time = [0.0, *sorted(t for t in ended if t < 1.0), 1.0]
        alive = [1.0 - sum(t <= now for t in ended) / starts for now in time[:-1]]
        alive.append(1.0 - len(ended) / starts)
        curves.step(time, [100.0 * a for a in alive], where="post", label=method)
    curves.set(
        xlabel="part of the case's time", ylabel="alive [%]", ylim=(0.0, 102.0), xlim=(0.0, 1.0)
    )
    curves.legend(frameon=False, fontsize=8, loc="lower left", ncols=2)
    figure.savefig(path, dpi=110)
