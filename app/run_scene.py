"""One run from its options to its outputs: `vesselflow run` without a command line."""

import contextlib
import importlib.util
import os
import sys
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from app import version
from app.run.options import DEFAULT_ERROR, RunOptions
from app.scenes.driving import driving
from app.scenes.library import find_scene, weights_for, with_column
from taichi_sph.errors import InputError
from taichi_sph.scene import Scene
from taichi_sph.scene_files import file_hash, scene_files

if TYPE_CHECKING:
    from app.control.session import Session
    from app.run.checkpoint import Checkpoint
    from app.run.loop import Outcome
    from taichi_sph.simulation import ModelFactory, Simulation


def run_scene(options: RunOptions) -> "Outcome":
    """Run a scene, print how it went and write its outputs.

    Returns:
        how it ended; with the error of a run that had to stop.

    Raises:
        InputError: something given is of no use; found before any file is touched.
        OSError: the summary cannot be written.
    """
    from app.run.outputs import claimed_outputs, report

    scene = with_column(find_scene(options.scene), options.particles, options.height)
    # Once: what is free now is not when the log has been begun.
    options = replace(options, session=options.session_file(scene))
    with claimed_outputs(options, scene):
        require_ports(options)
        outcome = _drive(options, _Start.of(options, scene))
        report(outcome, options)
    return outcome


@dataclass(frozen=True)
class _Start:
    """What a run begins with."""

    scene: Scene
    factory: "ModelFactory"
    facts: dict[str, Any]
    """What the run is of; another run does not go on from its checkpoints."""
    begun: "Checkpoint | None"

    @classmethod
    def of(cls, options: RunOptions, scene: Scene) -> "_Start":
        """Choose the model, and read the checkpoint that is to be resumed.

        Raises:
            InputError: weights or a checkpoint that do not fit.
        """
        from app.models import model_factory
        from app.run.checkpoint import Checkpoint

        end = options.end(scene)
        if options.model == "auto":
            from app.studies.advise import DEFAULT, advise

            error = DEFAULT_ERROR if options.error is None else options.error
            advice = advise(scene, error, DEFAULT, None, end, options.arch, options.threads)
            print(advice.text, file=sys.stderr)
            scene = advice.method.scene(scene)
            factory = advice.method.maker(scene)
        else:
            factory = model_factory(options.model, scene, options.weights)
        facts = facts_of(options, scene)
        begun = None
        if options.resume is not None:
            begun = Checkpoint.read(options.resume)
            begun.require(facts, options.resume)
        return cls(scene, factory, facts, begun)


def facts_of(options: RunOptions, scene: Scene) -> dict[str, Any]:
    """What a run is of: all that its particles' places depend on."""
    facts: dict[str, Any] = {
        "scene": scene.name, "scene_text": scene.text,
        "particles": options.particles, "height": options.height, "model": options.model,
        "arch": options.arch, "precision": options.precision, "seed": options.seed,
        "version": version(), "files": scene_files(scene),
    }  # fmt: skip
    script = options.script
    if script is not None:
        facts["script"] = script.read_text(errors="replace") if script.is_file() else ""
    weights = options.weights or weights_for(scene)
    if options.model == "pcnet" or (options.is_acted_on and weights.is_file()):
        facts["files"]["weights"] = file_hash(weights)
    return facts


def _drive(options: RunOptions, run: _Start) -> "Outcome":
    """Simulate, with all that looks on and acts."""
    from app.progress import Progress
    from app.run.loop import drive
    from app.run.outputs import observers_of
    from taichi_sph.runtime import start
    from taichi_sph.simulation import Simulation

    start(options.arch, options.precision, options.threads, random_seed=options.seed)
    simulation = Simulation.from_scene(run.scene, run.factory, options.seed)
    for driven in driving(run.scene, simulation.vessel):
        print("\n".join(driven.lines()), file=sys.stderr)
    session = _open_session(simulation, options, run) if options.is_acted_on else None
    if session is None and run.begun is not None:
        simulation.load_state(run.begun.state)
    observers = observers_of(simulation, options, run.facts)
    if session is not None and "view" in observers:
        session.notes.append(observers["view"].note)  # type: ignore[attr-defined]
    end = options.end(run.scene)
    with contextlib.ExitStack() as doors:
        if session is not None and options.control is not None:
            open_doors(session, options.control, options.host, doors)
        return drive(
            simulation,
            [*([session] if session else []), *observers.values()],
            end,
            run.scene.frame_interval,
            Progress(end, run.scene.name),
            run.begun.frame if run.begun else 0,
            session.before_step if session else None,
        )


def _open_session(simulation: "Simulation", options: RunOptions, run: _Start) -> "Session":
    from app.control.session import open_session

    return open_session(
        simulation, options.weights, options.script, options.session, run.begun,
        run.facts | {"checkpoint": options.checkpoint}, options.control is not None,
    )  # fmt: skip


def require_ports(options: RunOptions) -> None:
    """Refuse ports that are taken before a file is touched.

    Raises:
        InputError: a port is taken, or the host asks for a token.
    """
    from app.control.channel import is_loopback, listen

    wanted = [("--live", "127.0.0.1", options.live)] if options.live is not None else []
    if options.control is not None:
        wanted.append(("page", "127.0.0.1", options.control))
        wanted.append(("channel", options.host, options.control + 1))
    for what, host, port in wanted:
        with contextlib.closing(listen(host, port, what)) as listener:
            if not is_loopback(listener) and not os.environ.get("VESSELFLOW_TOKEN"):
                raise InputError(
                    f"--host {host}: other machines reach this address; put a token that clients "
                    "have to know into VESSELFLOW_TOKEN, or serve at 127.0.0.1"
                )


def open_doors(session: "Session", port: int, host: str, doors: contextlib.ExitStack) -> None:
    """Serve the page at a port and the channel at the next, until `doors` are closed.

    Raises:
        InputError: a port is taken, or the host asks for a token.
    """
    from app.control.channel import Channel
    from app.control.page import ControlPage

    channel = Channel(session, host, port + 1, os.environ.get("VESSELFLOW_TOKEN"))
    doors.callback(channel.close)
    print(f"commands as JSON lines: {host}:{port + 1}", file=sys.stderr)
    try:
        page = ControlPage(session, port=port)
    except InputError as problem:
        if importlib.util.find_spec("viser") is not None:
            raise
        print(problem, file=sys.stderr)
        return
    doors.callback(page.close)
    session.refusals.append(page.tell)
    print(f"page: {page.url}", file=sys.stderr)
