"""`vesselflow validate`: the physics against theory, one table, each row with its tolerance."""

import math
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from app import version
from app.files import check_json, check_plots, console, write_json
from app.validation import (
    beginnings,
    boundaries,
    cavity,
    delivered,
    fda_nozzle,
    pipes,
    statics,
    step,
    torus,
    viscosity,
    wall_stress,
)  # fmt: skip
from app.validation.report import Report, Row
from taichi_sph.errors import InputError, RunError
from taichi_sph.runtime import start


@dataclass(frozen=True)
class Case:
    """A group of rows that one setting of Taichi serves."""

    name: str
    title: str
    precision: str
    run: Callable[[Report, bool], None]
    """Takes the report and whether to be quick."""
    minutes: int = 0
    """How long it takes on two cores, if it is run only when it is named."""


CASES = (
    Case("kernel", "kernel integrals", "f64", statics.kernel_integrals),
    Case("momentum", "momentum in a closed box", "f64", statics.momentum),
    Case("shear_wave", "shear wave", "f32", viscosity.shear_wave),
    Case("viscosity", "viscosity delivered in scenes", "f32", delivered.delivered_viscosity, 27),
    Case("taylor_green", "Taylor-Green vortices", "f32", viscosity.taylor_green),
    Case(
        "taylor_green_3d",
        "Taylor-Green vortices in three dimensions",
        "f32",
        viscosity.taylor_green_3d,
        30,
    ),
    Case("cavity", "lid-driven cavity", "f32", cavity.lid_driven_cavity, 32),
    Case("hydrostatic", "hydrostatic column", "f32", statics.hydrostatic),
    Case("poiseuille", "Poiseuille flow in a tube", "f32", pipes.poiseuille),
    Case("pipe", "steady flow in a tube", "f32", pipes.steady_pipe, 6),
    Case("womersley", "Womersley flow in a tube", "f32", pipes.womersley),
    Case("casson", "Casson blood in a tube", "f32", pipes.casson),
    Case("wall_stress", "wall shear stress", "f32", wall_stress.wall_shear_stress, 10),
    Case("torus", "flow in a bend", "f32", torus.bends, 50),
    Case("step", "backward-facing step", "f32", step.backward_step, 23),
    Case("fda_nozzle", "the FDA's nozzle", "f32", fda_nozzle.nozzle, 60),
    Case("dam_break", "dam break", "f32", statics.dam_break),
    Case("account", "pump and reservoir", "f32", boundaries.account),
    Case("pulse", "a wall that pulses", "f32", boundaries.pulse),
    Case("wound", "bleeding from a wound", "f32", boundaries.wound),
    Case("tool", "sphere in a tank", "f32", boundaries.tool),
    Case("start", "how runs begin", "f32", beginnings.start_of_runs, 5),
)


def run_case(
    case: Case,
    quick: bool = False,
    arch: str = "cpu",
    threads: int | None = None,
    advance: Callable[[float], None] = lambda fraction: None,
) -> Report:
    """Run one case; Taichi starts anew, so that the fields of the case before are freed.

    A diverged run is a row that misses, not the end of the others.
    """
    start(arch, case.precision, threads)
    report = Report(advance)
    try:
        case.run(report, quick)
    except RunError as error:
        report.add(f"{case.title}: {error}", "diverged", "", math.nan, 0.0)
    return report


def table_of(rows: list[Row]) -> Table:
    """The table as it is printed."""
    table = Table(title="computed against theory")
    for heading in ("quantity", "computed", "theory"):
        table.add_column(heading, overflow="fold")
    for heading in ("error", "tolerance", "", "wall s"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        verdict = Text(
            row.verdict, {"pass": "green", "MISS": "bold red"}.get(row.verdict, "yellow")
        )
        table.add_row(
            row.quantity, row.computed, row.theory,
            f"{row.error:.2%}" if row.error >= 1e-4 else f"{row.error:.1e}",
            f"{row.tolerance:.0%}" if row.tolerance >= 1e-2 else f"{row.tolerance:.0e}",
            verdict, f"{row.seconds:.1f}",
        )  # fmt: skip
    return table


def draw_pictures(report: Report, folder: Path) -> list[Path]:
    """Draw a case's profiles, one file each."""
    from matplotlib.figure import Figure

    files = []
    for name, (x_label, y_label, curves) in report.pictures.items():
        figure = Figure(figsize=(6.4, 4.4), layout="constrained")
        axes = figure.add_subplot()
        for k, curve in enumerate(curves):
            axes.plot(curve.x, curve.computed, ".", ms=2, color=f"C{k}", label=curve.label)
            axes.plot(
                curve.theory_x, curve.theory, "-", lw=1, color="black",
                label=None if k else curve.source,
            )  # fmt: skip
        axes.set(xlabel=x_label, ylabel=y_label, title=name)
        axes.legend(markerscale=4)
        files.append(folder / f"{name}.png")
        figure.savefig(files[-1], dpi=130)
    return files


def main(
    only: list[str] | None = None,
    plot: Path | None = None,
    quick: bool = False,
    arch: str = "cpu",
    threads: int | None = None,
    json_file: Path | None = None,
) -> int:
    """Run the cases, print the table and, if asked, draw the profiles.

    Args:
        only: names of cases; all that take no long time by default.
        plot: folder for pictures, made if it is not there.
        quick: coarser and fewer, under a minute on two cores.
        arch: "cpu" or "gpu".
        threads: CPU threads.
        json_file: gets the rows.

    Returns:
        0 if every row is within its tolerance or known to miss, else 1.

    Raises:
        InputError: an unknown case, or pictures that cannot be drawn.
    """
    names = [case.name for case in CASES]
    unknown = [name for name in only or () if name not in names]
    if unknown:
        raise InputError(f"validate {unknown[0]}: no such case; allowed are {', '.join(names)}")
    if plot is not None:
        check_plots(plot)
    if json_file is not None:
        check_json(json_file, "--json", ("version", "rows"))
    chosen = [c for c in CASES if (c.name in only if only else not c.minutes)]
    rows: list[Row] = []
    files: list[Path] = []
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(),
        console=console(sys.stderr), transient=True,
    )  # fmt: skip
    begin = time.perf_counter()
    with progress:
        for case in chosen:
            task = progress.add_task(case.title, total=1.0)

            def advance(fraction: float, task: TaskID = task) -> None:
                progress.update(task, completed=fraction)

            report = run_case(case, quick, arch, threads, advance)
            progress.remove_task(task)
            rows += report.rows
            if plot is not None:
                files += draw_pictures(report, plot)
    terminal = console()
    terminal.print(table_of(rows))
    verdicts = Counter(row.verdict for row in rows)
    terminal.print(
        f"{verdicts['pass']} of {len(rows)} rows within tolerance; "
        f"{time.perf_counter() - begin:.0f} s",
        soft_wrap=True,
    )
    known: dict[str, list[str]] = {}
    for row in rows:
        if row.verdict == "known miss":
            known.setdefault(row.known, []).append(row.quantity)
    for reason, quantities in known.items():
        terminal.print(f"known to miss: {'; '.join(quantities)}: {reason}", soft_wrap=True)
    for case in CASES:
        if not only and case not in chosen:
            terminal.print(
                f"left out, for it takes some {case.minutes} min: vesselflow validate {case.name}",
                soft_wrap=True,
            )
    if json_file is not None:
        write_json(json_file, {"version": version(), "rows": [row.as_json for row in rows]})
    for file in files:
        terminal.print(f"picture {file}", soft_wrap=True)
    return 1 if verdicts["MISS"] else 0
