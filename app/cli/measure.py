"""`validate` and `bench`."""

from pathlib import Path

import click

from app.cli import options
from app.cli.options import output_path


@click.command()
@click.argument("cases", metavar="[CASE]...", nargs=-1)
@click.option("--plot", type=output_path, metavar="FOLDER", help="Draw the profiles there.")
@click.option("--quick", is_flag=True, help="Coarser and fewer cases.")
@options.machine
def validate(
    cases: tuple[str, ...], plot: Path | None, quick: bool, arch: str, threads: int | None
) -> int:
    """Compare the physics with theory and print a table (minutes)."""
    from app.validation import validate as validation

    return validation.main(list(cases) or None, plot, quick, arch, threads)


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
@click.option(
    "--json", "json_file", type=output_path, metavar="FILE", help="Write figures as JSON."
)
def bench(
    scenes: tuple[str, ...],
    until: float,
    arch: str,
    threads: int | None,
    peer: bool,
    scale: bool,
    start_up: bool,
    split: bool,
    real_time: bool,
    control: bool,
    plot: Path | None,
    json_file: Path | None,
) -> int:
    """Measure the speed on scenes; without any, the paper's Table 1: A and B, 16 000 and 32 000."""
    from app.bench import table1 as benchmark
    from app.files import check_output
    from app.locks import claimed
    from app.scenes.library import scene_path

    if json_file is not None:
        check_output(json_file, "--json", b"{")
    wanted: list[tuple[Path, int | None]] = [(scene_path(name), None) for name in scenes]
    if not wanted:
        wanted = [(scene_path(name), count) for name in "AB" for count in (16000, 32000)]
    with claimed(json_file, "--json"):
        return benchmark.main(
            wanted, until, arch, threads, peer, scale, start_up, split, real_time, control, plot,
            json_file,
        )  # fmt: skip
