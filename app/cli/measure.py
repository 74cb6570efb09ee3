"""`validate` and `bench`."""

from pathlib import Path
from typing import Any

import click

from app.cli import options
from app.cli.options import output_path


@click.command()
@click.argument("cases", metavar="[CASE]...", nargs=-1)
@click.option("--plot", type=output_path, metavar="FOLDER", help="Draw the profiles there.")
@click.option("--quick", is_flag=True, help="Coarser and fewer cases.")
@options.json_file
@options.machine
def validate(
    cases: tuple[str, ...], plot: Path | None, quick: bool, json_file: Path | None, arch: str,
    threads: int | None,
) -> int:  # fmt: skip
    """Compare the physics with theory and print a table (minutes).

    Cases that take longer run when they are named.
    """
    from app.locks import claimed
    from app.validation import validate as validation

    with claimed(json_file, "--json"):
        return validation.main(list(cases) or None, plot, quick, arch, threads, json_file)


@click.command()
@click.argument("scenes", metavar="[SCENE]...", nargs=-1)
@click.option(
    "--until",
    type=options.positive,
    metavar="SECONDS",
    default=0.1,
    show_default=True,
    help="Simulated time of each scene [s].",
)
@options.machine
@click.option("--peer", is_flag=True, help="Measure SPlisHSPlasH beside, on a like column.")
@click.option("--scale", is_flag=True, help="Measure from 16 000 to 1 000 000 particles.")
@click.option("--start-up", is_flag=True, help="Measure the time to the first frame.")
@click.option("--split", is_flag=True, help="Measure each pass of a step beside its limits.")
@click.option("--real-time", is_flag=True, help="How much blood holds real time, over flow speed.")
@click.option("--control", is_flag=True, help="Measure what live control and view cost a run.")
@click.option(
    "--plot", type=output_path, metavar="FOLDER", help="Draw --split and --real-time there."
)
@options.json_file
def bench(scenes: tuple[str, ...], json_file: Path | None, **given: Any) -> None:
    """Measure the speed on scenes; without any, the paper's Table 1: A and B, 16 000 and 32 000.

    Table 1 takes some ten minutes on two cores; what is being measured is told on the way.
    """
    from app.bench.benchmark import BenchOptions, run_bench
    from app.files import check_json
    from app.locks import claimed
    from app.scenes.library import scene_path

    if json_file is not None:
        check_json(json_file, "--json", ("machine", "rows"))
    wanted: list[tuple[Path, int | None]] = [(scene_path(name), None) for name in scenes]
    if not wanted:
        wanted = [(scene_path(name), count) for name in "AB" for count in (16000, 32000)]
    with claimed(json_file, "--json"):
        run_bench(BenchOptions(scenes=tuple(wanted), json_file=json_file, **given))
