"""Options that several commands share, as decorators."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

Decorator = Callable[[Any], Any]

output_path = click.Path(path_type=Path)
positive = click.FloatRange(min=0, min_open=True)
at_least_one = click.IntRange(min=1)

scene = click.argument("scene", metavar="SCENE")
scenes = click.argument("scenes", metavar="SCENE...", nargs=-1, required=True)
arch = click.option(
    "--arch",
    type=click.Choice(["cpu", "gpu"]),
    default="cpu",
    show_default=True,
    help="Where to compute; gpu is CUDA or Metal (untested).",
)
threads = click.option("--threads", type=at_least_one, help="CPU threads.  [default: all]")
seed = click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Seed of what is drawn at random.",
)
until = click.option(
    "--until",
    type=positive,
    metavar="SECONDS",
    help="Simulated time to stop at [s].  [default: the scene's duration]",
)
particles = click.option(
    "--particles",
    type=at_least_one,
    help="Blood particles, instead of the scene's column.  [default: the scene's]",
)
height = click.option(
    "--height",
    type=positive,
    metavar="METRES",
    help="Height of the column [m].  [default: the scene's]",
)
spacing = click.option(
    "--spacing",
    type=positive,
    metavar="METRES",
    help="Distance between blood particles [m].  [default: the scene's]",
)
processes = click.option(
    "--processes",
    type=at_least_one,
    default=1,
    show_default=True,
    help="How many runs at once.",
)
scheduler = click.option(
    "--scheduler",
    metavar="dask:ADDRESS",
    help="Scheduler of a Dask cluster that does the work.  [default: this machine does]",
)
json_file = click.option(
    "--json", "json_file", type=output_path, metavar="FILE", help="Write figures as JSON."
)
colour = click.option(
    "--colour",
    type=click.Choice(["speed", "age"]),
    default="speed",
    show_default=True,
    help="What the recording and the live view colour blood by; dye is seen in both.",
)
weights = click.option(
    "--weights",
    type=output_path,
    multiple=True,
    metavar="FILE",
    help="This network too; may be given again.",
)


def error(default: float | None, default_text: str | None = None) -> Decorator:
    """The option of an error that is borne."""
    return click.option(
        "--error",
        type=click.FloatRange(min=0, max=1, min_open=True),
        default=default,
        show_default=default_text or True,
        help="Largest error that is borne, against a pour at half the spacing.",
    )


def plot(what: str) -> Decorator:
    """The option of a picture."""
    return click.option("--plot", type=output_path, metavar="FILE", help=f"Draw {what} (PNG).")


def together(*options: Decorator) -> Decorator:
    """Several options as one decorator, listed by `--help` in this order."""

    def decorate(command: Any) -> Any:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


machine = together(arch, threads)
