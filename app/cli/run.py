"""`run` and `replay`."""

from pathlib import Path
from typing import Any

import click

from app.cli import options
from app.cli.ending import leave
from app.cli.options import output_path
from app.models import MODELS
from taichi_sph.errors import RunError

LIVE_PORT = 9876
CONTROL_PORT = 8080

length = options.together(
    click.option(
        "--frames",
        type=options.at_least_one,
        help="Number of frames to simulate, instead of --until.",
    ),
    options.until,
)
machine = options.together(
    options.arch,
    options.threads,
    click.option(
        "--precision",
        type=click.Choice(["f32", "f64"]),
        default="f32",
        show_default=True,
        help="Numbers of the simulation.",
    ),
    options.seed,
)
outputs = options.together(
    click.option(
        "--rrd",
        type=output_path,
        metavar="FILE",
        help="Record to a Rerun file; a recording that is there is replaced.",
    ),
    click.option(
        "--live",
        is_flag=False,
        flag_value=str(LIVE_PORT),
        type=click.IntRange(1, 65535),
        metavar="[PORT]",
        help=f"Serve a live view on loopback.  [default port: {LIVE_PORT}]",
    ),
    click.option(
        "--every",
        type=options.at_least_one,
        default=1,
        show_default=True,
        help="Show the particles of every N-th frame; plots have all frames.",
    ),
    options.colour,
    click.option("--summary", type=output_path, metavar="FILE", help="Write the summary as JSON."),
    click.option(
        "--wall-stress",
        type=output_path,
        metavar="FILE",
        help="Write the wall shear stress at the vertices of the wall, its mean, TAWSS and OSI, as "
        "VTK PolyData (.vtp).",
    ),
)
model = options.together(
    click.option(
        "--model",
        type=click.Choice([*MODELS, "auto"]),
        default="physics",
        show_default=True,
        help="What computes accelerations; implicit takes long steps, so does pcnet, a network; "
        "auto asks `advise`, which pours the scene first, and takes its spacing too.",
    ),
    options.error(None, "0.1"),
    click.option(
        "--weights",
        type=output_path,
        metavar="FILE",
        help="Weights of the network.  [default: pcnet.npz beside the scene, or the aorta's]",
    ),
)
going_on = options.together(
    click.option(
        "--checkpoint",
        type=options.at_least_one,
        metavar="N",
        help="Keep the state of every N-th frame in SCENE.checkpoint.npz, or in the file resumed.",
    ),
    click.option(
        "--resume",
        type=output_path,
        metavar="FILE",
        help="Go on from a checkpoint of the same run.",
    ),
)
acting = options.together(
    click.option(
        "--script",
        type=output_path,
        metavar="FILE",
        help='Commands at simulated times, JSON lines: {"at": 0.5, "command": "wound", ...}.',
    ),
    click.option(
        "--session",
        type=output_path,
        metavar="FILE",
        help="Keep what is done to the run, for `replay`.  [default with --control: "
        "SCENE.session.jsonl, or with the next number that is free]",
    ),
    click.option(
        "--control",
        is_flag=False,
        flag_value=str(CONTROL_PORT),
        type=click.IntRange(1, 65534),
        metavar="[PORT]",
        help="Serve a page to act on the run at a port, and the same as JSON lines at the next "
        f"one; runs until stopped or --until.  [default port: {CONTROL_PORT}]",
    ),
    click.option(
        "--host",
        default="127.0.0.1",
        show_default=True,
        help="Where the JSON lines of --control are served; other than loopback asks for a token "
        "in VESSELFLOW_TOKEN; the page stays on loopback.",
    ),
)


@click.command()
@options.scene
@length
@machine
@outputs
@options.particles
@options.height
@model
@going_on
@acting
def run(**given: Any) -> int:
    """Simulate a scene."""
    from app.run.options import RunOptions
    from app.run_scene import run_scene

    outcome = run_scene(RunOptions(**given))
    if outcome.stalled:
        leave(str(outcome.error or ""), outcome.exit_code, at_once=True)
    if outcome.error is not None:
        raise outcome.error
    return outcome.exit_code


@click.command()
@click.argument("session", type=output_path)
@click.option(
    "--rrd",
    type=output_path,
    metavar="FILE",
    help="Record to a Rerun file; a recording that is there is replaced.",
)
@options.colour
@options.threads
def replay(session: Path, rrd: Path | None, colour: str, threads: int | None) -> int:
    """Run a session again from its log, and compare the blood bit by bit, frame by frame."""
    from app.control.replay import replay as replay_session
    from app.files import check_output
    from app.locks import claimed

    if rrd is not None:
        check_output(rrd, "--rrd", b"RRF2")
    with claimed(rrd, "--rrd"):
        result = replay_session(session, rrd, threads, colour)
    if result.first_difference is not None:
        raise RunError(f"replay {session}: differs from frame {result.first_difference} on")
    commands = len(result.log.entries)
    click.echo(f"{session}: {result.compared} frames, {commands} commands, the same bit by bit")
    return 0
