"""`compare`, `chart`, `stability` and `advise`."""

from pathlib import Path
from typing import Any

import click

from app.cli import options
from app.cli.options import output_path, positive


@click.command()
@options.scene
@click.option(
    "--weights",
    type=output_path,
    multiple=True,
    metavar="FILE",
    help="Weights to pour with; may be given again.  [default: as run]",
)
@click.option(
    "--soft",
    type=click.FloatRange(min=1, min_open=True),
    multiple=True,
    metavar="RATIO",
    help="Physics with this sound speed over the scene's speed beside; may be given again.",
)
@options.particles
@options.height
@options.until
@options.json_file
@options.plot("the curves")
@options.machine
@options.seed
def compare(
    scene: str,
    weights: tuple[Path, ...],
    soft: tuple[float, ...],
    particles: int | None,
    height: float | None,
    until: float | None,
    json_file: Path | None,
    plot: Path | None,
    arch: str,
    threads: int | None,
    seed: int,
) -> None:
    """Pour a scene by physics and by networks side by side, and measure the difference."""
    from app.files import check_json
    from app.locks import claimed
    from app.scenes.library import find_scene, weights_for, with_column
    from app.studies import compare as comparison
    from app.training.train import check_plot
    from taichi_sph.runtime import start

    found = with_column(find_scene(scene), particles, height)
    if json_file is not None:
        check_json(json_file, "--json", ("scene", "results"))
    check_plot(plot)
    with claimed(json_file, "--json"), claimed(plot, "--plot"):
        start(arch, "f32", threads, random_seed=seed)
        results = comparison.compare(
            found, list(weights) or [weights_for(found)], list(soft), until or found.duration,
            seed, json_file, plot,
        )  # fmt: skip
    comparison.print_results(found, results)


@click.command()
@options.scenes
@click.option("--out", type=output_path, required=True, metavar="FILE", help="Figures (CSV).")
@options.plot("the chart")
@options.height
@options.spacing
@options.until
@options.weights
@click.option("--only", default="", metavar="TEXT", help="Only methods with this in their name.")
@click.option("--peer", is_flag=True, help="Chart SPlisHSPlasH's WCSPH and DFSPH too.")
@options.scheduler
@options.machine
def chart(
    scenes: tuple[str, ...],
    out: Path,
    plot: Path | None,
    height: float | None,
    spacing: float | None,
    until: float | None,
    weights: tuple[Path, ...],
    only: str,
    peer: bool,
    scheduler: str | None,
    arch: str,
    threads: int | None,
) -> None:
    """Chart what each method costs against how far it is from a finer pour.

    What is in FILE already is not measured again: scenes can be added one by one.
    """
    from app.files import check_output
    from app.locks import claimed
    from app.scenes.library import find_scene, varied
    from app.studies import chart as study
    from app.studies.chart_report import draw, print_tables
    from app.training.train import check_plot

    check_output(out, "--out", b"scene,")
    check_plot(plot)
    found = [varied(find_scene(name), height, spacing) for name in scenes]
    methods = study.select_methods(weights, only, peer)
    with claimed(out, "--out"), claimed(plot, "--plot"):
        rows = study.main(found, until, out, methods, arch, threads, scheduler)
        print_tables(rows)
        if plot is not None:
            draw(rows, plot)


@click.command()
@click.option("--out", type=output_path, required=True, metavar="FILE", help="Figures (CSV).")
@options.plot("the matrix")
@click.option(
    "--starts",
    type=options.at_least_one,
    default=3,
    show_default=True,
    help="Starts of each case.",
)
@click.option(
    "--quick",
    is_flag=True,
    help="One start, no case longer than 0.2 s, and only the models of `run`.",
)
@click.option("--only", default="", metavar="TEXT", help='Only what has this in "METHOD, CASE".')
@options.weights
@options.processes
@options.scheduler
@options.arch
def stability(out: Path, plot: Path | None, **given: Any) -> None:
    """Run every method where methods fail, and say which live.

    What is in FILE already is not measured again.
    """
    from app.files import check_output
    from app.locks import claimed
    from app.studies import stability as study
    from app.training.train import check_plot

    check_output(out, "--out", b"method,")
    check_plot(plot)
    with claimed(out, "--out"), claimed(plot, "--plot"):
        study.main(out, plot=plot, **given)


@click.command()
@options.scene
@options.error(0.1)
@click.option(
    "--of",
    "measures",
    type=click.Choice(["drained", "energy", "field"]),
    multiple=True,
    default=("drained", "energy"),
    show_default=True,
    help="What the error is of: the drained part, the kinetic energy, the momentum on a coarse "
    "grid; may be given again.",
)
@click.option(
    "--realtime",
    type=positive,
    metavar="FACTOR",
    help="Simulated seconds that a second of wall time must give.",
)
@options.height
@options.spacing
@options.until
@click.option(
    "--check",
    type=output_path,
    metavar="FILE",
    help="Measure all that is listed against a pour at half the spacing, as `chart` does (CSV).",
)
@options.machine
def advise(
    scene: str,
    error: float,
    measures: tuple[str, ...],
    realtime: float | None,
    height: float | None,
    spacing: float | None,
    until: float | None,
    check: Path | None,
    arch: str,
    threads: int | None,
) -> None:
    """Name the cheapest method and spacing within an error, and say why.

    The scene is poured by the implicit model at several spacings; the rest is from the chart and
    the stability cases that come with the program.
    """
    from app.files import check_output, console
    from app.locks import claimed
    from app.scenes.library import find_scene, varied
    from app.studies import advise as study

    found = varied(find_scene(scene), height, spacing)
    end = until or found.duration
    if check is not None:
        check_output(check, "--check", b"scene,")
    with claimed(check, "--check"):
        advice = study.advise(found, error, measures, realtime, end, arch, threads)
        console().print(study.candidates_table(found, advice))
        click.echo(advice.text)
        if check is not None:
            click.echo(
                study.check_advice(found, advice, error, measures, end, check, arch, threads)
            )
