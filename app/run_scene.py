"""One run from its options to its outputs: `vesselflow run` without a command line."""

import contextlib
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app import version
from app.run.options import DEFAULT_ERROR, RunOptions
from app.scenes.driving import driving
from app.scenes.library import find_scene, weights_for, with_column
from taichi_sph.scene import Scene
from taichi_sph.scene_files import file_hash, scene_files

if TYPE_CHECKING:
    from app.control.ports import Ports
    from app.control.session import Session
    from app.run.checkpoint import Checkpoint
    from app.run.loop import Outcome
    from taichi_sph.simulation import ModelFactory, Simulation

TOKEN = "VESSELFLOW_TOKEN"
"""Environment variable with what the channel's clients have to know."""


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
    options = replace(options, session=_session_file(options, scene))
    with contextlib.ExitStack() as ports, claimed_outputs(options, scene):
        controls = bind_controls(options, ports)
        outcome = _drive(options, _Start.of(options, scene), controls)
        report(outcome, options)
    return outcome


def _session_file(options: RunOptions, scene: Scene) -> Path | None:
    """File of the log: what a run that goes on has begun, or as the options say."""
    if options.resume is not None and options.control is not None and options.session is None:
        from app.control.log import log_of
        from app.run.checkpoint import Checkpoint

        begun = log_of(Checkpoint.read(options.resume), scene.name)
        if begun is not None:
            return begun
    return options.session_file(scene)


def bind_controls(options: RunOptions, ports: contextlib.ExitStack) -> "Ports | None":
    """Bind the ports of page and channel, and see that of the live view free.

    Raises:
        InputError: a port is taken, or the host asks for a token.
    """
    from app.control.ports import PAGE_HOST, bind_ports, listen

    if options.live is not None:
        listen(PAGE_HOST, options.live, "--live").close()
    if options.control is None:
        return None
    bound = bind_ports(options.control, options.host, os.environ.get(TOKEN))
    ports.callback(bound.close)
    return bound


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
        facts["script"] = (
            script.read_text(encoding="utf-8", errors="replace") if script.is_file() else ""
        )
    weights = options.weights or weights_for(scene)
    if options.model == "pcnet" or (options.is_acted_on and weights.is_file()):
        facts["files"]["weights"] = file_hash(weights)
    return facts


def _drive(options: RunOptions, run: _Start, ports: "Ports | None") -> "Outcome":
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
    end = options.end(run.scene)
    with contextlib.ExitStack() as servers:
        addresses: list[str] = []
        if session is not None and ports is not None:
            from app.control.serve import serve_controls

            serving = serve_controls(session, ports, os.environ.get(TOKEN))
            addresses = servers.enter_context(serving)
        # Last, for it replaces a recording.
        observers = observers_of(simulation, options, run.facts)
        if session is not None and "view" in observers:
            session.on_applied.append(observers["view"].note)  # type: ignore[attr-defined]
        for line in addresses:
            print(line, file=sys.stderr)
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
    from app.control.session import start_session

    return start_session(
        simulation, run.facts | {"checkpoint": options.checkpoint}, log=options.session,
        script=options.script, weights=options.weights, checkpoint=run.begun,
        all_models=options.control is not None,
    )  # fmt: skip
