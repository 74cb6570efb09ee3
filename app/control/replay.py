"""Replay: a session made again from its log, compared bit by bit."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.control.auto_model import AUTO_MODELS, ModelSelection
from app.control.commands import Model
from app.control.log import LogEntry, SessionLog, digest, read_session
from app.control.session import Session
from app.models import model_factory
from app.progress import Progress
from app.run.loop import Observer, drive
from app.scenes.library import with_column
from taichi_sph.errors import InputError
from taichi_sph.runtime import start
from taichi_sph.scene import Scene, parse_scene
from taichi_sph.scene_files import file_hash, found_in
from taichi_sph.simulation import Simulation

if TYPE_CHECKING:
    from taichi_sph.diagnostics import Diagnostics


@dataclass(frozen=True)
class ReplayResult:
    """What a replay has shown."""

    log: SessionLog
    compared: int
    """Frames that were compared."""
    first_difference: int | None
    """The first frame that differs, if any."""


class ReplayChecker:
    """Observer of a replay: whether each frame is the one that the log has, bit by bit."""

    def __init__(self, log: SessionLog):
        """`log` is what was kept of the session."""
        self.log = log
        self.compared = 0
        self.first_difference: int | None = None

    def on_frame(self, simulation: "Simulation", frame: int, diagnostics: "Diagnostics") -> None:
        """Compare a frame."""
        wanted = self.log.digests.get(frame)
        if wanted is not None:
            self.compared += 1
            same = wanted == digest(simulation.particles.rows(), self.log.state)
            if not same and self.first_difference is None:
                self.first_difference = frame
        every = self.log.metadata.get("checkpoint")
        if every and frame % every == 0:
            simulation.save_state()  # after which the lists are built anew, as they were then

    def close(self, ending: str) -> None:
        """End; nothing is left to do."""


def commands_of(log: SessionLog) -> list[LogEntry]:
    """Commands that make the session again; the choices of `auto` are among them."""
    return [
        LogEntry(e.step, e.source, Model(name=AUTO_MODELS[0]) if e.selects_auto else e.command)  # type: ignore[arg-type]
        for e in log.entries
        if not e.command.affects_pacing_only
    ]


def logged_run(path: Path, log: SessionLog) -> tuple[Scene, Path | None, dict[str, Any]]:
    """The scene of a log, the file of its network and the metadata of its run.

    Raises:
        InputError: the head is not whole, or what the run needs is not there as it was.
    """
    try:
        metadata = log.metadata
        scene = parse_scene(
            metadata["scene_text"], f"replay {path}: the scene", Path(metadata["folder"]),
            metadata["scene"],
        )  # fmt: skip
        files = dict(metadata.get("files", {}))
        scene = with_column(scene, metadata["particles"], metadata["height"])
        network = metadata["network"]
        names = ("model", "models", "arch", "precision", "seed")
        run = {name: metadata[name] for name in names}
        weights = Path(network["file"]) if network else None
        expected = network["hash"] if network else None
    except (KeyError, TypeError):
        raise InputError(f"replay {path}: its head is not whole") from None
    if weights is not None and file_hash(weights) != expected:
        raise InputError(f"replay {path}: {weights} is not there as it was: the network's")
    try:
        # As it was, wherever it lies now.
        scene = found_in(scene, files, [Path(scene.folder), path.parent])
    except InputError as error:
        raise InputError(f"replay {path}: {error}") from None
    if min(log.digests) > 0:
        raise InputError(
            f"replay {path}: begins with frame {min(log.digests)}, for its run went on from a "
            "checkpoint without the log of what came before; only a whole session is replayed"
        )
    return scene, weights, run


def replay(
    path: Path, rrd: Path | None, threads: int | None, colour: str = "speed"
) -> ReplayResult:
    """Make the run of a log again, and a recording of it, coloured so, if asked for.

    Raises:
        InputError: it is no log, or what it needs is not there as it was.
        RunError: the run diverges, and did not then.
    """
    log = read_session(path, "replay")
    scene, weights, run = logged_run(path, log)
    start(run["arch"], run["precision"], threads, random_seed=run["seed"])
    simulation = Simulation.from_scene(
        scene, model_factory(run["model"], scene, weights), run["seed"]
    )
    if unknown := set(log.state) - set(simulation.particles.names):
        raise InputError(
            f"replay {path}: is of another version of the program: it keeps {unknown.pop()!r} of "
            "each particle"
        )
    session = Session(simulation, ModelSelection(simulation, run["models"], weights=weights))
    session.recorded = commands_of(log)
    checker = ReplayChecker(log)
    observers: list[Observer] = [session, checker]
    if rrd is not None:
        from app.view.rerun_view import RerunView

        view = RerunView(simulation, rrd, colour=colour)
        session.on_applied.append(view.note)
        observers.append(view)
    until = max(log.digests) * scene.frame_interval
    outcome = drive(
        simulation, observers, until, scene.frame_interval, Progress(until, scene.name),
        before_step=session.before_step,
    )  # fmt: skip
    if outcome.error is not None:
        raise outcome.error
    return ReplayResult(log, checker.compared, checker.first_difference)
