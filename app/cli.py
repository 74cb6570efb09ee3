"""The command line: it parses and wires, and turns errors into one sentence and an exit code."""

import contextlib
import math
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click

from app import version
from app.models import MODELS
from taichi_sph.errors import InputError, RunError

if TYPE_CHECKING:
    from app.control.session import Session
    from app.run.loop import Summary

EPILOG = "All quantities are in SI units. Exit codes: 0 done, 1 the run diverged, 2 wrong input."
LIVE_PORT = 9876
CONTROL_PORT = 8080

arch_option = click.option(
    "--arch",
    type=click.Choice(["cpu", "gpu"]),
    default="cpu",
    show_default=True,
    help="Where to compute; gpu is CUDA or Metal (untested).",
)
threads_option = click.option(
    "--threads", type=click.IntRange(min=1), help="CPU threads.  [default: all]"
)
precision_option = click.option(
    "--precision",
    type=click.Choice(["f32", "f64"]),
    default="f32",
    show_default=True,
    help="Numbers of the simulation.",
)
output_path = click.Path(path_type=Path)
positive = click.FloatRange(min=0, min_open=True)
until_option = click.option(
    "--until",
    type=positive,
    metavar="SECONDS",
    help="Simulated time to stop at [s].  [default: the scene's duration]",
)
particles_option = click.option(
    "--particles",
    type=click.IntRange(min=1),
    help="Blood particles, instead of the scene's column.",
)
height_option = click.option(
    "--height",
    type=positive,
    metavar="METRES",
    help="Height of the column [m], instead of the scene's.",
)
spacing_option = click.option(
    "--spacing",
    type=positive,
    metavar="METRES",
    help="Distance between blood particles [m], instead of the scene's.",
)
error_option = click.option(
    "--error",
    type=click.FloatRange(min=0, max=1, min_open=True),
    default=0.1,
    show_default=True,
    help="Largest error that is borne, against a pour at half the spacing.",
)
seed_option = click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
processes_option = click.option(
    "--processes", type=click.IntRange(min=1), default=1, show_default=True
)


def print_version(context: click.Context, _: click.Parameter, asked: bool) -> None:
    """Answer --version."""
    if asked:
        click.echo(f"vesselflow {version()}")
        context.exit()


@click.group(epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=print_version,
    help="Print the version and leave.",
)
def cli() -> None:
    """Blood in vessels by smoothed particle hydrodynamics.

    SCENE is the name of a shipped scene (see `vesselflow scenes`), a scene's .toml file, or the
    folder of one.
    """


@cli.command()
@click.argument("scene_name", metavar="SCENE")
@click.option("--frames", type=click.IntRange(min=1), help="Number of frames to simulate.")
@until_option
@arch_option
@threads_option
@precision_option
@click.option("--rrd", type=output_path, metavar="FILE", help="Record to a Rerun file.")
@click.option(
    "--live",
    is_flag=False,
    flag_value=str(LIVE_PORT),
    type=click.IntRange(1, 65535),
    metavar="[PORT]",
    help=f"Serve a live view on loopback.  [default port: {LIVE_PORT}]",
)
@click.option(
    "--every",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Show the particles of every N-th frame; plots have all frames.",
)
@click.option("--summary", type=output_path, metavar="FILE", help="Write the summary as JSON.")
@particles_option
@height_option
@click.option(
    "--model",
    type=click.Choice([*MODELS, "auto"]),
    default="physics",
    show_default=True,
    help="What computes accelerations; implicit takes long steps, so does pcnet, a network; "
    "auto asks `advise`, which pours the scene first, and takes its spacing too.",
)
@error_option
@click.option(
    "--weights",
    type=output_path,
    metavar="FILE",
    help="Weights of the network.  [default: pcnet.npz beside the scene, or the aorta's]",
)
@seed_option
@click.option(
    "--checkpoint",
    type=click.IntRange(min=1),
    metavar="N",
    help="Keep the state of every N-th frame in SCENE.checkpoint.npz, or in the file resumed.",
)
@click.option(
    "--resume", type=output_path, metavar="FILE", help="Go on from a checkpoint of the same run."
)
@click.option(
    "--script",
    type=output_path,
    metavar="FILE",
    help='Commands at simulated times, JSON lines: {"at": 0.5, "command": "wound", ...}.',
)
@click.option(
    "--session",
    type=output_path,
    metavar="FILE",
    help="Keep what is done to the run, for `replay`.  [default with --control: "
    "SCENE.session.jsonl]",
)
@click.option(
    "--control",
    is_flag=False,
    flag_value=str(CONTROL_PORT),
    type=click.IntRange(1, 65534),
    metavar="[PORT]",
    help="Serve a page to act on the run at a port, and the same as JSON lines at the next one; "
    f"runs until stopped or --until.  [default port: {CONTROL_PORT}]",
)
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Where the JSON lines of --control are served; other than loopback asks for a token in "
    "VESSELFLOW_TOKEN; the page stays on loopback.",
)
def run(
    scene_name: str,
    frames: int | None,
    until: float | None,
    arch: str,
    threads: int | None,
    precision: str,
    rrd: Path | None,
    live: int | None,
    every: int,
    summary: Path | None,
    particles: int | None,
    height: float | None,
    model: str,
    error: float,
    weights: Path | None,
    seed: int,
    checkpoint: int | None,
    resume: Path | None,
    script: Path | None,
    session: Path | None,
    control: int | None,
    host: str,
) -> int:
    """Simulate a scene."""
    from app.files import check_output, write_json
    from app.scenes.library import find_scene, weights_for, with_column

    if frames is not None and until is not None:
        raise InputError("--frames and --until: give one of the two")
    scene = with_column(find_scene(scene_name), particles, height)
    end = until or (frames * scene.frame_interval if frames else scene.duration)
    if rrd is not None:
        check_output(rrd, "--rrd", b"RRF2")
    if summary is not None:
        check_output(summary, "--summary", b"{")
    if rrd is None and live is None and every > 1:
        raise InputError("--every: nothing is shown without --rrd or --live")
    acted_on = script is not None or session is not None or control is not None
    if weights is not None and model != "pcnet" and not acted_on:
        raise InputError("--weights: only --model pcnet has weights")
    if (resume is not None or checkpoint is not None) and model == "auto":
        raise InputError("--checkpoint and --resume: name the model, for auto may choose another")
    if resume is not None and rrd is not None and rrd.exists() and rrd.stat().st_size:
        raise InputError(f"--rrd {rrd}: holds the run so far; name another file for the rest")
    kept = resume or Path(f"{scene.name}.checkpoint.npz")
    if checkpoint is not None:
        check_output(kept, "--checkpoint", b"PK")
    if acted_on and model == "auto":
        raise InputError("--model auto: pours a scene first; in a session, switch to auto instead")
    if control is not None:
        session = session or Path(f"{scene.name}.session.jsonl")
        end = until or (frames * scene.frame_interval if frames else math.inf)
    if session is not None:
        check_output(session, "--session", b'{"format": "vesselflow session')
    asked = click.get_current_context().get_parameter_source("error")
    if asked is not click.core.ParameterSource.DEFAULT and model != "auto":
        raise InputError("--error: only --model auto has a budget")

    import hashlib

    from app.models import model_factory
    from app.progress import Progress
    from app.run.checkpoint import Checkpoint, Checkpointer
    from app.run.loop import Observer, drive
    from taichi_sph.runtime import start
    from taichi_sph.simulation import Simulation

    if model == "auto":
        from app.studies.advise import DEFAULT, advise

        advice = advise(scene, error, DEFAULT, None, end, arch, threads)
        click.echo(advice.text, err=True)
        scene = advice.method.scene(scene)
        maker = advice.method.maker(scene)
    else:
        maker = model_factory(model, scene, weights)
    facts = {
        "scene": scene.name, "scene_text": scene.text, "particles": particles, "height": height,
        "model": model, "arch": arch, "precision": precision, "seed": seed, "version": version(),
    }  # fmt: skip
    if script is not None:
        facts["script"] = script.read_text(errors="replace") if script.is_file() else ""
    if model == "pcnet":
        content = (weights or weights_for(scene)).read_bytes()
        facts["weights"] = hashlib.sha256(content).hexdigest()
    begun = Checkpoint.read(resume) if resume else None
    if begun is not None and resume is not None:
        begun.require(facts, resume)
    start(arch, precision, threads, random_seed=seed)
    simulation = Simulation.from_scene(scene, maker, seed)
    observers: list[Observer] = []
    acting = None
    if acted_on:
        from app.control.session import open_session

        acting = open_session(
            simulation, weights, script, session, begun, facts | {"checkpoint": checkpoint},
            control is not None,
        )  # fmt: skip
        observers.append(acting)
    elif begun is not None:
        simulation.load_state(begun.state)
    if rrd is not None or live is not None:
        from app.view.rerun_view import RerunView

        shown = {key: facts[key] for key in ("arch", "precision", "seed", "version")}
        view = RerunView(simulation, rrd, live, every, shown, checkpoint)
        observers.append(view)
        if view.live:
            click.echo(f"live view: rerun --connect {view.live.url}", err=True)
        if acting:
            acting.notes.append(view.note)
    if checkpoint is not None:  # last: what came before it is safe by then
        observers.append(Checkpointer(kept, checkpoint, facts))
    with contextlib.ExitStack() as doors:
        if acting is not None and control is not None:
            open_doors(acting, control, host, doors)
        outcome = drive(
            simulation, observers, end, scene.frame_interval, Progress(end, scene.name),
            begun.frame if begun else 0, acting.before_step if acting else None,
        )  # fmt: skip
    click.echo(summary_text(outcome.summary))
    if rrd is not None and not isinstance(outcome.error, OSError):
        click.echo(
            f"recording: {rrd} ({rrd.stat().st_size / 1e6:.1f} MB); see it with: rerun {rrd}"
        )
    if summary is not None:
        write_json(summary, outcome.as_json)
    if outcome.error:
        raise outcome.error
    return 128 + outcome.signal if outcome.signal else 0


def open_doors(session: "Session", port: int, host: str, doors: contextlib.ExitStack) -> None:
    """Serve the page at a port and the channel at the next, until `doors` are closed.

    Raises:
        InputError: a port is taken, or the host asks for a token.
    """
    import importlib.util

    from app.control.channel import Channel
    from app.control.page import ControlPage

    channel = Channel(session, host, port + 1, os.environ.get("VESSELFLOW_TOKEN"))
    doors.callback(channel.close)
    click.echo(f"commands as JSON lines: {host}:{port + 1}", err=True)
    try:
        page = ControlPage(session, port=port)
    except InputError as problem:
        if importlib.util.find_spec("viser") is not None:
            raise
        click.echo(str(problem), err=True)
        return
    doors.callback(page.close)
    session.refusals.append(page.tell)
    click.echo(f"page: {page.url}", err=True)


@cli.command()
@click.argument("session", type=output_path)
@click.option("--rrd", type=output_path, metavar="FILE", help="Record to a Rerun file.")
@threads_option
def replay(session: Path, rrd: Path | None, threads: int | None) -> int:
    """Run a session again from its log, and compare the blood bit by bit, frame by frame."""
    from app.control.session import run_again
    from app.files import check_output

    if rrd is not None:
        check_output(rrd, "--rrd", b"RRF2")
    kept, compared, difference = run_again(session, rrd, threads)
    if difference is not None:
        raise RunError(f"replay {session}: differs from frame {difference} on")
    click.echo(f"{session}: {compared} frames, {len(kept.entries)} commands, the same bit by bit")
    return 0


def summary_text(summary: "Summary") -> str:
    """The summary of a run for people."""
    s = summary
    return (
        f"{s.scene}: {s.ending}\n"
        f"  {s.simulated_time:.6g} s simulated in {s.frames} frames and {s.steps} steps\n"
        f"  {s.wall_time:.1f} s of wall time, {s.real_time_factor:.3g} x real time, "
        f"{s.median_step_ms:.3g} ms a step (median)\n"
        f"  {s.particles} of {s.blood_particles} blood particles left, "
        f"{1e6 * s.drained_volume:.3g} ml drained; {s.proxy_particles} proxies\n"
        f"  leaks {s.leaks} (most {s.most_leaks}), wall corrections {s.wall_corrections}\n"
        f"  compression {1e2 * s.compression_p99:.2f} % (99th percentile; "
        f"most {1e2 * s.most_compression_p99:.2f} %), kinetic energy {s.kinetic_energy:.3g} J"
        + (
            f"\n  the physics took over for {1e2 * s.fallback_share:.2g} % of the time"
            if s.fallback_share
            else ""
        )
    )


@cli.command()
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
@click.option("--iterations", type=click.IntRange(min=1), default=600, show_default=True)
@click.option(
    "--plot", type=output_path, metavar="FILE", help="Draw loss and rollouts into a picture (PNG)."
)
@arch_option
@threads_option
@seed_option
def train(
    data: Path,
    out: Path,
    head: str,
    correction: str,
    hold_out: tuple[int, ...],
    rounds: int,
    iterations: int,
    plot: Path | None,
    arch: str,
    threads: int | None,
    seed: int,
) -> int:
    """Train PcNet on recorded runs; the best rollout on the held-out run is kept.

    A training that was cut short goes on where it was.
    """
    from app.training import train as learn

    command = f"vesselflow train {data.name} --head {head} --correction {correction}"
    command += "".join(f" --hold-out {run}" for run in hold_out)
    command += f" --rounds {rounds} --iterations {iterations} --seed {seed}"
    learn.require_torch("train")
    from nn.training.train import Settings

    settings = Settings(
        head=head, correction=correction, rounds=rounds, iterations=iterations, seed=seed
    )
    click.echo(learn.train(data, out, settings, hold_out, command, plot, arch, threads))
    return 0


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


@cli.command()
@click.argument("scene_name", metavar="SCENE")
@click.option(
    "--heights", type=Heights(), required=True, help="Column heights [m], comma-separated."
)
@click.option("--frames", type=click.IntRange(min=1), default=800, show_default=True)
@click.option("--out", type=output_path, required=True, metavar="FILE", help="HDF5 dataset.")
@click.option(
    "--substeps",
    type=click.IntRange(min=1),
    default=8,
    show_default=True,
    help="Steps of the physics in a frame.",
)
@click.option("--features", is_flag=True, help="Store the features and targets too.")
@processes_option
@click.option("--scheduler", metavar="dask:ADDRESS", help="Record on a Dask cluster.")
@arch_option
@threads_option
@seed_option
def record(
    scene_name: str,
    heights: list[float],
    frames: int,
    out: Path,
    substeps: int,
    features: bool,
    processes: int,
    scheduler: str | None,
    arch: str,
    threads: int | None,
    seed: int,
) -> int:
    """Record the physics for training: a run for each column height, resumed if cut short."""
    from app.scenes.library import scene_path
    from app.training.record import record as record_runs

    recording = record_runs(
        scene_path(scene_name), heights, frames, out, substeps, features, processes,
        arch, threads, seed, scheduler,
    )  # fmt: skip
    click.echo(str(recording))
    return 0


@cli.command()
def scenes() -> None:
    """List the shipped scenes."""
    from app.files import console
    from app.scenes.library import scenes_table

    console().print(scenes_table())


@cli.command()
@click.argument("scene_name", metavar="SCENE")
def info(scene_name: str) -> None:
    """Check a scene's vessel and print the numbers that follow from the scene."""
    from app.files import console
    from app.scenes.library import find_scene, info_tables

    out = console()
    for table in info_tables(find_scene(scene_name)):
        out.print(table)


@cli.command()
@click.argument("surface", type=click.Path(path_type=Path))
@click.option(
    "--out", type=output_path, metavar="FOLDER", help="Folder to make.  [default: the file's name]"
)
@click.option(
    "--scale",
    type=float,
    metavar="METRES",
    help="Metres per unit of the file.  [default: guessed from the size]",
)
@click.option(
    "--spacing",
    type=float,
    metavar="METRES",
    help="Distance between blood particles [m].  [default: fits the narrowest place]",
)
def new(surface: Path, out: Path | None, scale: float | None, spacing: float | None) -> None:
    """Make a scene folder of a vessel's surface (STL, PLY, OBJ, VTP, VTK), capped or open."""
    from app.scenes.new_scene import create_scene

    click.echo(create_scene(surface, out, scale, spacing))


@cli.command()
@click.argument("cases", metavar="[CASE]...", nargs=-1)
@click.option("--plot", type=output_path, metavar="FOLDER", help="Draw the profiles there.")
@click.option("--quick", is_flag=True, help="Coarser and fewer cases.")
@arch_option
@threads_option
def validate(
    cases: tuple[str, ...], plot: Path | None, quick: bool, arch: str, threads: int | None
) -> int:
    """Compare the physics with theory and print a table (minutes)."""
    from app.validation import validate as validation

    return validation.main(list(cases) or None, plot, quick, arch, threads)


@cli.command()
@click.argument("scene_names", metavar="[SCENE]...", nargs=-1)
@click.option(
    "--until",
    type=positive,
    metavar="SECONDS",
    default=0.1,
    show_default=True,
    help="Simulated time of each scene [s].",
)
@arch_option
@threads_option
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
    scene_names: tuple[str, ...],
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
    from app.scenes.library import scene_path

    if json_file is not None:
        check_output(json_file, "--json", b"{")
    scenes: list[tuple[Path, int | None]] = [(scene_path(name), None) for name in scene_names]
    if not scenes:
        scenes = [(scene_path(name), count) for name in "AB" for count in (16000, 32000)]
    return benchmark.main(
        scenes, until, arch, threads, peer, scale, start_up, split, real_time, control, plot,
        json_file,
    )  # fmt: skip


@cli.command()
@click.argument("data", type=output_path, nargs=-1, required=True)
@click.option("--out", type=output_path, required=True, metavar="FILE", help="Figures (JSON).")
@click.option("--seeds", type=click.IntRange(min=1), default=3, show_default=True)
@click.option("--iterations", type=click.IntRange(min=1), default=300, show_default=True)
@click.option(
    "--ablate", is_flag=True, help="Leave out groups of features in turn, instead of the rungs."
)
@processes_option
@click.option("--plot", type=output_path, metavar="FILE", help="Draw the ladder (PNG).")
@arch_option
def ladder(
    data: tuple[Path, ...],
    out: Path,
    seeds: int,
    iterations: int,
    ablate: bool,
    processes: int,
    plot: Path | None,
    arch: str,
) -> int:
    """Train every kind of network on recorded runs and roll each out on a run it never saw.

    Run 0 of each dataset chooses the weights, the last one measures them.
    """
    from app.files import check_output
    from app.training import train as learn

    learn.require_torch("ladder")
    check_output(out, "--out", b"{")
    learn.check_plot(plot)
    from app.training import compare_networks as study

    study.main(list(data), out, seeds, iterations, ablate, processes, plot, arch)
    return 0


@cli.command()
@click.argument("scene_name", metavar="SCENE")
@click.option(
    "--weights",
    "weights",
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
@particles_option
@height_option
@until_option
@click.option("--json", "json_file", type=output_path, metavar="FILE", help="Write figures.")
@click.option("--plot", type=output_path, metavar="FILE", help="Draw the curves (PNG).")
@arch_option
@threads_option
@seed_option
def compare(
    scene_name: str,
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
) -> int:
    """Pour a scene by physics and by networks side by side, and measure the difference."""
    from app.files import check_output
    from app.scenes.library import find_scene, weights_for, with_column
    from app.studies import compare as comparison
    from app.training.train import check_plot
    from taichi_sph.runtime import start

    scene = with_column(find_scene(scene_name), particles, height)
    if json_file is not None:
        check_output(json_file, "--json", b"{")
    check_plot(plot)
    start(arch, "f32", threads, random_seed=seed)
    files = list(weights) or [weights_for(scene)]
    results = comparison.compare(
        scene, files, list(soft), until or scene.duration, seed, json_file, plot
    )
    comparison.print_results(scene, results)
    return 0


@cli.command()
@click.argument("scene_names", metavar="SCENE...", nargs=-1, required=True)
@click.option("--out", type=output_path, required=True, metavar="FILE", help="Figures (CSV).")
@click.option("--plot", type=output_path, metavar="FILE", help="Draw the chart (PNG).")
@height_option
@spacing_option
@until_option
@click.option(
    "--weights",
    type=output_path,
    multiple=True,
    metavar="FILE",
    help="Chart this network too; may be given again.",
)
@click.option("--only", default="", metavar="TEXT", help="Only methods with this in their name.")
@click.option("--peer", is_flag=True, help="Chart SPlisHSPlasH's WCSPH and DFSPH too.")
@arch_option
@threads_option
def chart(
    scene_names: tuple[str, ...],
    out: Path,
    plot: Path | None,
    height: float | None,
    spacing: float | None,
    until: float | None,
    weights: tuple[Path, ...],
    only: str,
    peer: bool,
    arch: str,
    threads: int | None,
) -> int:
    """Chart what each method costs against how far it is from a finer pour.

    What is in FILE already is not measured again: scenes can be added one by one.
    """
    from app.files import check_output
    from app.scenes.library import find_scene, varied
    from app.studies import chart as charting
    from app.training.train import check_plot

    check_output(out, "--out", b"scene,")
    check_plot(plot)
    scenes = [varied(find_scene(name), height, spacing) for name in scene_names]
    methods = charting.asked(weights, only, peer)
    rows = charting.main(scenes, until, out, methods, arch, threads)
    charting.print_tables(rows)
    if plot is not None:
        charting.draw(rows, plot)
    return 0


@cli.command()
@click.option("--out", type=output_path, required=True, metavar="FILE", help="Figures (CSV).")
@click.option("--plot", type=output_path, metavar="FILE", help="Draw the matrix (PNG).")
@click.option("--starts", type=click.IntRange(min=1), default=3, show_default=True)
@click.option(
    "--quick",
    is_flag=True,
    help="One start, no case longer than 0.2 s, and only the models of `run`.",
)
@click.option("--only", default="", metavar="TEXT", help='Only what has this in "METHOD, CASE".')
@click.option(
    "--weights",
    type=output_path,
    multiple=True,
    metavar="FILE",
    help="Test this network too; may be given again.",
)
@processes_option
@arch_option
def stability(
    out: Path,
    plot: Path | None,
    starts: int,
    quick: bool,
    only: str,
    weights: tuple[Path, ...],
    processes: int,
    arch: str,
) -> int:
    """Run every method where methods fail, and say which live.

    What is in FILE already is not measured again.
    """
    from app.files import check_output
    from app.studies import stability as study
    from app.training.train import check_plot

    check_output(out, "--out", b"method,")
    check_plot(plot)
    study.main(out, starts, quick, only, weights, processes, plot, arch)
    return 0


@cli.command()
@click.argument("scene_name", metavar="SCENE")
@error_option
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
@height_option
@spacing_option
@until_option
@click.option(
    "--check",
    type=output_path,
    metavar="FILE",
    help="Measure all that is listed against a pour at half the spacing, as `chart` does (CSV).",
)
@arch_option
@threads_option
def advise(
    scene_name: str,
    error: float,
    measures: tuple[str, ...],
    realtime: float | None,
    height: float | None,
    spacing: float | None,
    until: float | None,
    check: Path | None,
    arch: str,
    threads: int | None,
) -> int:
    """Name the cheapest method and spacing within an error, and say why.

    The scene is poured by the implicit model at several spacings; the rest is from the chart and
    the stability cases that come with the program.
    """
    from app.files import check_output, console
    from app.scenes.library import find_scene, varied
    from app.studies import advise as study

    scene = varied(find_scene(scene_name), height, spacing)
    end = until or scene.duration
    if check is not None:
        check_output(check, "--check", b"scene,")
    advice = study.advise(scene, error, measures, realtime, end, arch, threads)
    console().print(study.candidates_table(scene, advice))
    click.echo(advice.text)
    if check is not None:
        click.echo(study.checked(scene, advice, error, measures, end, check, arch, threads))
    return 0


def one_sentence(error: OSError) -> str:
    """An operating-system error as its file and reason."""
    if error.strerror is None:
        return str(error)
    return f"{error.filename}: {error.strerror}" if error.filename else error.strerror


def invoke(arguments: Sequence[str] | None) -> tuple[str, int]:
    """Run the command; the message to end with, if any, and the exit code."""
    try:
        code = cli.main(arguments, prog_name="vesselflow", standalone_mode=False)
        sys.stdout.flush()
        return "", code if isinstance(code, int) else 0
    except InputError as error:
        return str(error), 2
    except RunError as error:
        return str(error), 1
    except BrokenPipeError:
        # Who read the output has had enough, as in `vesselflow scenes | head -1`.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return "", 1
    except OSError as error:
        return one_sentence(error), 2
    except click.ClickException as error:
        return error.format_message(), error.exit_code
    except click.Abort:
        return "stopped by SIGINT", 130


def leave(message: str, code: int, at_once: bool = False) -> NoReturn:
    """End the process; at once, if libraries would wait for somebody else at Python's exit."""
    if message:
        click.echo(message, err=True)
    if at_once:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """The command `vesselflow`."""
    # Before Taichi's import: no banner, and no question to its server for a newer version.
    os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
    os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    message, code = invoke(arguments)
    view = sys.modules.get("app.view.rerun_view")
    leave(message, code, at_once=view is not None and view.viewer_stalled())
