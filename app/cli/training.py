"""`record`, `train` and `ladder`."""

from pathlib import Path
from typing import Any

import click

from app.cli import options
from app.cli.options import output_path


class Heights(click.ParamType):
    """Column heights: numbers between commas."""

    name = "heights"

    def convert(
        self, value: str, param: click.Parameter | None, context: click.Context | None
    ) -> list[float]:
        """Parse the text."""
        try:
            heights = [float(part) for part in value.split(",")]
        except ValueError:
            self.fail(f"{value!r}: give numbers between commas, as 0.01,0.02", param, context)
        if not all(0.0 < h < float("inf") for h in heights):
            self.fail(f"{value!r}: heights are positive numbers [m]", param, context)
        return heights


@click.command()
@options.scene
@click.option(
    "--heights", type=Heights(), required=True, help="Column heights [m], comma-separated."
)
@click.option(
    "--frames",
    type=options.at_least_one,
    default=800,
    show_default=True,
    help="Frames of a run.",
)
@click.option("--out", type=output_path, required=True, metavar="FILE", help="HDF5 dataset.")
@click.option(
    "--substeps",
    type=options.at_least_one,
    default=8,
    show_default=True,
    help="Steps of the physics in a frame.",
)
@click.option("--features", is_flag=True, help="Store the features and targets too.")
@options.processes
@options.scheduler
@options.machine
@options.seed
def record(scene: str, out: Path, **given: Any) -> None:
    """Record the physics for training: a run for each column height, resumed if cut short."""
    from app.locks import claimed
    from app.scenes.library import scene_path
    from app.training.record import record as record_runs

    with claimed(out, "--out"):
        click.echo(str(record_runs(scene_path(scene), out=out, **given)))


@click.command()
@click.argument("data", type=output_path)
@click.option("--out", type=output_path, required=True, metavar="FILE", help="Weights (.npz).")
@click.option(
    "--head",
    type=click.Choice(["pressure", "direct"]),
    default="pressure",
    show_default=True,
    help="What the network gives: a pressure and a viscosity, or the acceleration (the paper's).",
)
@click.option(
    "--correction",
    type=click.Choice(["bp", "periodic", "relabel"]),
    default="relabel",
    show_default=True,
    help="How errors are corrected in training; periodic is the paper's.",
)
@click.option(
    "--hold-out",
    type=click.IntRange(min=0),
    multiple=True,
    default=(0,),
    show_default=True,
    help="Run of the data that is not trained on; the first one given chooses the weights.",
)
@click.option(
    "--rounds",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Rounds of better pressures after the network's guess, a step.",
)
@click.option(
    "--iterations",
    type=options.at_least_one,
    default=600,
    show_default=True,
    help="Gradient steps.",
)
@options.plot("loss and rollouts")
@options.machine
@options.seed
def train(
    data: Path,
    out: Path,
    hold_out: tuple[int, ...],
    plot: Path | None,
    arch: str,
    threads: int | None,
    **given: Any,
) -> None:
    """Train PcNet on recorded runs; the best rollout on the held-out run is kept.

    A training that was cut short goes on where it was.
    """
    from app.locks import claimed
    from app.training import train as learn

    learn.require_torch("train")
    from nn.training.runs import Settings

    settings = Settings(**given)
    command = (
        f"vesselflow train {data.name} --head {settings.head} --correction {settings.correction}"
        + "".join(f" --hold-out {run}" for run in hold_out)
        + f" --rounds {settings.rounds} --iterations {settings.iterations} --seed {settings.seed}"
    )
    with claimed(out, "--out"), claimed(plot, "--plot"):
        click.echo(learn.train(data, out, settings, hold_out, command, plot, arch, threads))


@click.command()
@click.argument("data", type=output_path, nargs=-1, required=True)
@click.option("--out", type=output_path, required=True, metavar="FILE", help="Figures (JSON).")
@click.option(
    "--seeds",
    type=options.at_least_one,
    default=3,
    show_default=True,
    help="Trainings of each kind.",
)
@click.option(
    "--iterations",
    type=options.at_least_one,
    default=300,
    show_default=True,
    help="Gradient steps of each.",
)
@click.option(
    "--ablate", is_flag=True, help="Leave out groups of features in turn, instead of the rungs."
)
@options.processes
@options.scheduler
@options.plot("the ladder")
@options.arch
def ladder(data: tuple[Path, ...], out: Path, plot: Path | None, **given: Any) -> None:
    """Train every kind of network on recorded runs and roll each out on a run it never saw.

    Run 0 of each dataset chooses the weights, the last one measures them.
    """
    from app.files import check_output
    from app.locks import claimed
    from app.training import train as learn

    learn.require_torch("ladder")
    check_output(out, "--out", b"{")
    learn.check_plot(plot)
    from app.training import compare_networks

    with claimed(out, "--out"), claimed(plot, "--plot"):
        compare_networks.main(list(data), out, plot=plot, **given)
