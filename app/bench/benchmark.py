"""`vesselflow bench`: what a step costs, beside a peer in the same run, over size, and at start.

Every row is measured in a process of its own, since Taichi frees no field.  Times are medians over
frames or blocks of steps, neighbour search included; nothing is logged or drawn meanwhile.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.bench.columns import COLUMNS, Row, measure_column, measure_peer, measure_start
from app.bench.machine import describe_machine
from app.bench.table1 import Pair, measure_scene, step_costs, table_1
from app.files import check_plots, console, table, write_json
from app.jobs.process import in_own_process
from app.progress import duration
from app.scenes.library import weights_for, with_column
from app.studies.splishsplash import require_peer
from taichi_sph.scene import Scene, read_scene

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class BenchOptions:
    """What is to be measured."""

    scenes: tuple[tuple[Path, int | None], ...]
    """Files of scenes, with their blood particles where these are not the scene's own."""
    until: float = 0.1
    """Simulated time of each scene [s]."""
    arch: str = "cpu"
    threads: int | None = None
    peer: bool = False
    """SPlisHSPlasH beside, on a like column."""
    scale: bool = False
    """From 16 000 to 1 000 000 particles."""
    start_up: bool = False
    """The time to the first frame."""
    split: bool = False
    """Each pass of a step beside its limits."""
    real_time: bool = False
    """How much blood holds real time, over flow speed."""
    control: bool = False
    """What live control and view cost a run."""
    plot: Path | None = None
    """Folder for pictures."""
    json_file: Path | None = None

    @property
    def own_scenes(self) -> list[tuple[Path, Scene]]:
        """Each scene once, with its own blood."""
        return [(path, read_scene(path)) for path in dict.fromkeys(path for path, _ in self.scenes)]


Tell = Callable[[str], None]
"""Told, before it is measured, what is."""


def _costs(options: BenchOptions, tell: Tell) -> dict[str, Any]:
    """Table 1, the peer and the columns, whose rows stand in one table."""
    pairs = _pairs(options, tell)
    rows = [row for pair in pairs for row in (pair.physics, pair.pcnet)]
    notes: list[str] = []
    if options.peer:
        tell("a column beside SPlisHSPlasH's")
        rows, notes = _beside_peer(rows, *in_own_process(measure_peer, options.threads))
    if options.scale:
        sizes: list[Row] = []
        for across, fill in COLUMNS:
            tell(f"a column of {across * across * fill} particles")
            sizes.append(
                in_own_process(measure_column, across, fill, options.arch, options.threads)
            )
        rows += sizes
        costs = [row.microseconds_per_particle_step for row in sizes]
        notes.append(
            f"cost a particle-step from {sizes[0].blood_particles} to {sizes[-1].blood_particles} "
            f"blood particles: {min(costs):.3f} to {max(costs):.3f} us, "
            f"{max(costs) / min(costs) - 1:.0%} apart"
        )
    terminal = console()
    if pairs:
        terminal.print(table_1(pairs))
    terminal.print(_costs_table(rows))
    for note in notes:
        terminal.print(note)
    return {"table": [asdict(pair) for pair in pairs], "rows": [asdict(row) for row in rows]}


def _pairs(options: BenchOptions, tell: Tell) -> list[Pair]:
    pairs = []
    for path, particles in options.scenes:
        scene = with_column(read_scene(path), particles, None)
        tell(f"{scene.name}{f', {particles} particles' if particles else ''}, physics and PcNet")
        pairs.append(
            in_own_process(
                measure_scene, scene, weights_for(scene), options.arch, options.threads,
                options.until,
            )
        )  # fmt: skip
    return pairs


def _beside_peer(rows: list[Row], ours: Row, theirs: Row) -> tuple[list[Row], list[str]]:
    """All rows, and what a particle-step costs of the peer's."""
    base = theirs.microseconds_per_particle_step
    notes = [
        "a particle-step of the column costs "
        f"{ours.microseconds_per_particle_step / base:.2f} of the peer's"
    ]
    notes += [
        f"a particle-step of {row.case} costs "
        f"{row.microseconds_per_particle_step / base:.2f} of the peer's"
        for row in rows
    ]
    return [*rows, ours, theirs], notes


def _costs_table(rows: list[Row]) -> "Table":
    found = table(
        "cost of a step, neighbour search included",
        "case", "blood", "proxies", "step ms", "quartiles", "us/particle", "real time", "MiB",
    )  # fmt: skip
    for row in rows:
        found.add_row(
            row.case,
            str(row.blood_particles),
            str(row.proxy_particles),
            f"{row.step_ms:.2f}",
            f"{row.step_ms_low:.2f}-{row.step_ms_high:.2f}",
            f"{row.microseconds_per_particle_step:.3f}",
            f"{row.real_time_factor:.5f}",
            f"{row.memory_mib:.0f}",
        )
    return found


def _starts(options: BenchOptions, tell: Tell) -> dict[str, Any]:
    starts = {}
    for path, scene in options.own_scenes:
        tell(f"{scene.name}, to the first step, twice")
        cold, warm = starts[str(path)] = measure_start(str(path), options.arch)
        console().print(f"{scene.name} to the first step: {cold:.1f} s cold, {warm:.1f} s warm")
    return {"starts": starts}


def _passes(options: BenchOptions, tell: Tell) -> dict[str, Any]:
    from app.bench import profile

    passes: list[Any] = []
    limits: Any = None
    for _, scene in options.own_scenes:
        tell(f"{scene.name}, pass by pass")
        some, reached = in_own_process(
            profile.measure_passes, scene, weights_for(scene), options.arch, options.threads
        )
        passes += some
        limits = reached if limits is None else limits.best(reached)
    console().print(profile.passes_table(passes, limits))
    if options.plot is not None:
        profile.draw(passes, limits, options.plot / "passes.png")
    return {"passes": [asdict(each) for each in passes], "limits": asdict(limits)}


def _real_time(options: BenchOptions, tell: Tell) -> dict[str, Any]:
    from app.bench import realtime

    curves: list[Any] = []
    for _, scene in options.own_scenes:
        weights = weights_for(scene)
        cost = partial(step_costs, weights, options.arch, options.threads, options.until)

        def measured(
            part: Scene, cost: Callable[[Scene], tuple[float, float]] = cost
        ) -> tuple[float, float]:
            tell(f"{part.name}, {part.column.particles} particles")
            return cost(part)

        curves += realtime.curves(scene, weights, measured)
    console().print(realtime.curves_table(curves))
    if options.plot is not None:
        realtime.draw(curves, options.plot / "real_time.png")
    return {"real_time": [asdict(curve) for curve in curves]}


def _control(options: BenchOptions, tell: Tell) -> dict[str, Any]:
    from app.bench.control_cost import measure_overhead, overhead_table

    overheads: list[Any] = []
    for _, scene in options.own_scenes:
        tell(f"{scene.name}, with and without control")
        with tempfile.TemporaryDirectory() as folder:
            overheads.append(
                in_own_process(
                    measure_overhead, scene, weights_for(scene), options.arch, options.threads,
                    Path(folder),
                )
            )  # fmt: skip
    console().print(overhead_table(overheads))
    return {"control": [asdict(row) for row in overheads]}


SECTIONS: tuple[tuple[str, Callable[[BenchOptions, Tell], dict[str, Any]]], ...] = (
    ("scenes", _costs),
    ("start_up", _starts),
    ("split", _passes),
    ("real_time", _real_time),
    ("control", _control),
)
"""What asks for a section, and what measures it, prints it and gives its part of the JSON file."""


def run_bench(options: BenchOptions) -> None:
    """Measure and print, section by section.

    Raises:
        InputError: the peer is asked for and not installed, or the time is too short.
    """
    if options.peer:
        require_peer()
    if options.plot is not None:
        check_plots(options.plot)
    machine = describe_machine(options.arch, options.threads)
    console().print(", ".join(f"{key} {value}" for key, value in machine.items()))
    began = time.perf_counter()

    def tell(what: str) -> None:
        print(f"{duration(time.perf_counter() - began)}: measuring {what}", file=sys.stderr)

    empty: dict[str, Any] = {
        "starts": {}, "passes": [], "limits": {}, "real_time": [], "control": [],
    }  # fmt: skip
    result: dict[str, Any] = {"machine": machine} | empty
    for option, measure in SECTIONS:
        # The first has its table even of nothing: columns alone, or the head of the JSON file.
        if option == "scenes" or getattr(options, option):
            result |= measure(options, tell)
    if options.json_file is not None:
        write_json(options.json_file, result)
