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
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from app.files import console, read_rows, table, write_rows
from app.jobs.process import in_own_process
from app.progress import Progress, duration
from app.studies.methods import FLOOR, METHODS, PEERS, REFERENCE, Method, of_weights
from app.studies.splishsplash import require_peer
from app.studies.timed_run import RULES, Errors, Grid, Rules, TimedRun, Trace, errors_of
from taichi_sph.errors import InputError, RunError
from taichi_sph.scene import Scene

CELL = 4.0
"""Width of the coarse cells over the scene's spacing."""
ALIKE = 1e-3
"""Errors below this tell no method from another."""
PROBES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Step factors tried for the largest that lives, upwards until one dies; then once in between."""
PANELS = {
    "drained": "drained part, largest error [%]",
    "field": "momentum on a coarse grid, mean error [%]",
    "energy": "kinetic energy, largest error [%]",
    "compression": "compression, 99th percentile [%]",
}


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
    def at_rest(self) -> float:
        """Wall seconds for a simulated second on a machine where the loop takes 1 ms."""
        return self.wall_per_simulated / self.yardstick


@dataclass(frozen=True)
class Job:
    """What a process of its own is told."""

    scene: Scene
    method: Method
    until: float
    reference: Path
    arch: str
    threads: int | None

    @property
    def frames(self) -> int:
        """Frames to the end."""
        return round(self.until / self.scene.frame_interval)


def _yardstick() -> Callable[[], float]:
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


def pour(job: Job, rules: Rules | None) -> tuple[TimedRun, float]:
    """Pour; needs a process of its own.  With what the yardstick took meanwhile, median [ms]."""
    from taichi_sph.runtime import start

    start(job.arch, "f32", job.threads)
    if job.threads:
        os.environ["OMP_NUM_THREADS"] = str(job.threads)  # of a peer, which is not loaded yet
    interval = job.scene.frame_interval
    simulation = job.method.simulation(job.scene)
    grid = _grid_of(job.scene, simulation)
    poured = TimedRun(job.method.name, simulation, Trace(interval), grid, rules)
    tick, ticks = _yardstick(), []
    progress = Progress(job.until, f"{job.scene.name}, {job.method.name}")
    for frame in range(1, job.frames + 1):
        poured.frame(frame * interval)
        ticks.append(tick())
        progress.show(frame * interval, simulation.steps, 0)
        if poured.death or poured.empty:
            break
    progress.close()
    return poured, statistics.median(ticks)


def refer(job: Job) -> Trace:
    """The reference's trace; needs a process of its own.

    Raises:
        RunError: it died.
    """
    poured, _ = pour(job, None)
    if poured.death:
        raise RunError(f"{job.scene.name}: the reference itself died: {poured.death}")
    return poured.trace


def measure(job: Job) -> Row:
    """A method's row; needs a process of its own."""
    poured, yardstick = pour(job, RULES)
    simulation, lived = poured.simulation, len(poured.seconds)
    errors = errors_of(poured.trace, load_trace(job.reference)) if lived else NOTHING
    # An empty vessel costs nothing for the rest of the time.
    simulated = job.scene.frame_interval * ((lived if poured.death else job.frames) - 1)
    return Row(
        scene=job.scene.name,
        until=job.until,
        method=job.method.name,
        curve=job.method.curve,
        blood_particles=simulation.derived.blood_particles,
        died=poured.death,
        survived=lived / job.frames if poured.death else 1.0,
        steps=simulation.steps,
        step_factor=job.method.step_factor or 1.0,
        milliseconds_per_step=poured.milliseconds_per_step,
        wall_per_simulated=sum(poured.seconds[1:]) / simulated if simulated > 0.0 else math.nan,
        yardstick=yardstick,
        leaks=poured.most_leaks,
        **asdict(errors),
    )


NOTHING = Errors(*[math.nan] * len(fields(Errors)))


def save_trace(path: Path, trace: Trace) -> None:
    """Write a trace as .npz, whole or not at all."""
    temporary = path.with_name(path.name + ".part")
    with temporary.open("wb") as file:
        arrays: dict[str, Any] = {k: np.asarray(v) for k, v in vars(trace).items()}
        np.savez_compressed(file, **arrays)
    temporary.replace(path)


def load_trace(path: Path) -> Trace:
    """What `save_trace` wrote."""
    with np.load(path) as file:
        found = {name: list(file[name]) for name in file.files if name != "frame_interval"}
        return Trace(float(file["frame_interval"]), **found)


def measured(job: Job) -> Row:
    """The row of a method; of its largest step that lives, if it asks for that."""

    def probe(factor: float) -> Row:
        return in_own_process(measure, replace(job, method=replace(job.method, step_factor=factor)))

    if job.method.step_factor is not None:
        return probe(job.method.step_factor)
    best: Row | None = None
    for factor in PROBES:
        row = probe(factor)
        if row.died:
            break
        best = row
    if best is None or not row.died:
        return row
    between = probe(math.sqrt(best.step_factor * row.step_factor))
    return best if between.died else between


def asked(weights: Sequence[Path], only: str, peer: bool) -> list[Method]:
    """Methods, other programs and networks of these files, that have `only` in their name.

    Raises:
        InputError: weights cannot be read, `only` fits nothing, or a peer is not installed.
    """
    if peer:
        require_peer()
    methods = [*METHODS, *(PEERS if peer else ()), *(of_weights(path) for path in weights)]
    found = [method for method in methods if only in method.name]
    if not found:
        names = "; ".join(method.name for method in methods)
        raise InputError(f"--only {only}: no method has this in its name; there are {names}")
    return found


def main(
    scenes: Sequence[Scene],
    until: float | None,
    out: Path,
    methods: Sequence[Method],
    arch: str,
    threads: int | None,
) -> list[Row]:
    """Measure what is not yet in `out`; all rows that it then has.

    Raises:
        InputError: a scene cannot be used, or `out` holds something else.
        RunError: the reference died.
    """
    rows = read_rows(out, Row)
    for scene in scenes:
        end = until or scene.duration
        check_end(scene, end)
        reference = out.with_name(f"{out.stem}.{scene.name}-{end:g}s.npz")
        there = {row.method for row in rows if (row.scene, row.until) == (scene.name, end)}
        left = [m for m in (FLOOR, *methods) if m.name not in there]
        if left and not reference.exists():
            before = time.perf_counter()
            job = Job(scene, REFERENCE, end, reference, arch, threads)
            save_trace(reference, in_own_process(refer, job))
            took = duration(time.perf_counter() - before)
            print(f"{scene.name}: the reference took {took}", file=sys.stderr)
        for method in left:
            try:
                row = measured(Job(scene, method, end, reference, arch, threads))
            except InputError as error:  # too coarse for the vessel, say
                print(f"{scene.name}, {method.name}: left out: {error}", file=sys.stderr)
                continue
            rows.append(row)
            write_rows(out, rows)
            state = f"died ({row.died})" if row.died else f"drained {100 * row.drained:.1f} %"
            print(
                f"{scene.name}, {method.name}: {row.wall_per_simulated:.3g} s a simulated s, "
                f"{state} ({len(rows)} rows)",
                file=sys.stderr,
            )
    return rows


def front(rows: Sequence[Row], error: str) -> list[Row]:
    """Rows that live and that nothing living beats in both cost and error, cheapest first."""
    best, found = math.inf, []
    for row in sorted((r for r in rows if not r.died), key=lambda r: r.at_rest):
        if getattr(row, error) < best:
            best = getattr(row, error)
            found.append(row)
    return found


def rivals(rows: Sequence[Row], model: str, error: str) -> list[tuple[Row, Row]]:
    """Each living row of a model with the cheapest one of the others that is as good."""
    found = []
    mine = [row for row in rows if row.curve.startswith(model) and not row.died]
    others = [row for row in rows if not row.curve.startswith(model) and not row.died]
    for row in mine:
        as_good = [other for other in others if getattr(other, error) <= getattr(row, error)]
        if as_good:
            found.append((row, min(as_good, key=lambda other: other.at_rest)))
    return found


def print_tables(rows: Sequence[Row]) -> None:
    """All rows, and each scene's front, for people."""
    unit = statistics.median(row.yardstick for row in rows) if rows else 1.0
    for scene in dict.fromkeys(row.scene for row in rows):
        mine = [row for row in rows if row.scene == scene]
        found = table(
            f"{scene}, {mine[0].until:g} s: errors against half the spacing [%]",
            "method", "blood", "steps", "wall s / s", *PANELS, "leaks", "died", left=("died",),
        )  # fmt: skip
        for row in sorted(mine, key=lambda r: r.at_rest if r.at_rest == r.at_rest else math.inf):
            name = row.method
            if row.step_factor != 1.0:
                name += f" ({row.step_factor:.3g} x)"
            found.add_row(
                name,
                str(row.blood_particles),
                str(row.steps),
                f"{unit * row.at_rest:.3g}",
                *(f"{100 * getattr(row, error):.2f}" for error in PANELS),
                str(row.leaks),
                f"{row.died} at {100 * row.survived:.0f} %" if row.died else "",
            )
        console().print(found)
        usable = [row for row in mine if row.method != FLOOR.name]
        for error, label in PANELS.items():
            names = ", ".join(row.method for row in front(usable, error))
            console().print(f"front, {label.partition(',')[0]}: {names}")
            for model in ("pcnet", "implicit"):
                for row, rival in rivals(usable, model, error):
                    ratio = rival.at_rest / row.at_rest
                    console().print(f"  {row.method}: {ratio:.2f} times faster than {rival.method}")


COLOURS = {
    "physics, spacing": "tab:blue",
    "physics, sound speed": "tab:cyan",
    "physics, longest step": "navy",
    "physics, Newtonian": "tab:purple",
    "soft physics, spacing": "magenta",
    "implicit, spacing": "tab:green",
    "implicit, 0 rounds": "teal",
    "implicit, rounds": "olive",
    "ballistic": "black",
    "pcnet, spacing": "tab:red",
    "splishsplash-wcsph, spacing": "gold",
    "splishsplash-wcsph, longest step": "darkgoldenrod",
    "splishsplash-dfsph, spacing": "tab:orange",
    "splishsplash-dfsph, longest step": "tab:brown",
}


def verdict(rows: Sequence[Row], error: str) -> str:
    """How the network stands where it stands best, against the cheapest that is as good."""
    if max((getattr(row, error) for row in rows if not row.died), default=0.0) < ALIKE:
        return f"all agree to {100 * ALIKE:g} %"
    pairs = rivals(rows, "pcnet", error)
    best = front(rows, error)
    alone = [row for row in best if row.curve.startswith("pcnet")]
    if not alone:
        return "PcNet is not on the front"
    ratios = [rival.at_rest / row.at_rest for row, rival in pairs if row in alone]
    if not ratios:
        return "PcNet on the front"
    return f"PcNet on the front: up to {max(ratios):.2g} x the next as good"


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw error over cost, a row of panels a scene."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    unit = statistics.median(row.yardstick for row in rows)
    scenes = list(dict.fromkeys(row.scene for row in rows))
    figure = Figure(figsize=(4.4 * len(PANELS), 4.2 * len(scenes) + 1.0), layout="constrained")
    grid = figure.subplots(len(scenes), len(PANELS), squeeze=False)
    curves = list(dict.fromkeys(row.curve for row in rows if row.curve))
    spare = iter(("tab:pink", "tab:gray", "lime"))
    colours = {curve: COLOURS.get(curve) or next(spare, "tab:gray") for curve in curves}
    for line, scene in zip(grid, scenes, strict=True):
        mine = [row for row in rows if row.scene == scene]
        floor = next((row for row in mine if row.method == FLOOR.name), None)
        usable = [row for row in mine if row is not floor]
        for axes, (error, label) in zip(line, PANELS.items(), strict=True):
            for curve in curves:
                points = [row for row in usable if row.curve == curve]
                if curve in ("physics, sound speed", "implicit, rounds"):
                    # The plain model is a point of these curves too.
                    plain = curve.partition(",")[0]
                    points = [row for row in usable if row.method == plain] + points
                alive = [row for row in points if not row.died]
                x = [unit * row.at_rest for row in alive]
                y = [100.0 * getattr(row, error) for row in alive]
                style = "o:" if curve == "ballistic" else "o-"
                axes.plot(x, y, style, color=colours[curve], ms=5, label=curve)
                for row in points:
                    if row.died and math.isfinite(row.at_rest):
                        # What it got wrong until it died says nothing.
                        axes.plot(
                            unit * row.at_rest, 0.97, "o", mfc="none", color=colours[curve], ms=7,
                            transform=axes.get_xaxis_transform(),
                        )  # fmt: skip
            axes.axvline(1.0, color="grey", lw=1, ls=":")
            if floor is not None and error != "compression":
                axes.axhline(100.0 * getattr(floor, error), color="grey", lw=1, ls="--")
            axes.set(xscale="log", yscale="log", ylabel=label)
            axes.margins(y=0.15)
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                axis.set_major_formatter(StrMethodFormatter("{x:g}"))
                axis.set_minor_formatter(NullFormatter())
            name = f"{scene}: " if error == "drained" else ""
            axes.set_title(f"{name}{verdict(usable, error)}", fontsize=9)
            axes.set_xlabel("wall seconds for a simulated second")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    figure.suptitle(
        "left and low is better; hollow at the top: died; dotted: real time; dashed: what the "
        "reference is worth"
    )
    figure.savefig(path, dpi=110)
