"""Session: a run that is acted upon: commands wait for the next step, and blood for its pace."""

import queue
import time as clock
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from app.control.auto_model import ModelSelection, network_metadata
from app.control.commands import Command, Model, as_dict, parse_command
from app.control.log import (
    LogEntry,
    LogWriter,
    SessionLog,
    is_due,
    read_script,
    read_session,
    require_free,
)
from app.files import check_output
from app.models import MODELS
from taichi_sph.boundary.tracer import Tracer
from taichi_sph.errors import InputError, RunError

if TYPE_CHECKING:
    from app.run.checkpoint import Checkpoint
    from taichi_sph.diagnostics import Diagnostics
    from taichi_sph.simulation import Simulation
    from taichi_sph.state import State

MOST_WAITING = 1000
"""Commands that wait for the next step; more are refused."""
AVERAGED = 20
"""Frames that rates are averaged over."""
VIEW_PERIOD = 0.05
"""Least wall time between two frames for a page [s]; one of the run may take many seconds."""
WAIT = 0.005
"""Time between two looks at the commands, while blood is held [s]."""

Listener = Callable[[str], None]
ResultListener = Callable[[dict[str, Any]], None]
"""Gets what became of one command, on the run's thread: {"applied": ...} or {"refused": ...}."""


@dataclass(frozen=True)
class ViewFrame:
    """What a page shows of the blood at one moment."""

    time: float
    """[s]"""
    positions: np.ndarray
    """[m], (n, 3)."""
    velocities: np.ndarray
    """[m/s], (n, 3)."""
    droplets: np.ndarray
    """Blood that has left through wounds [m], (m, 3)."""
    dye: np.ndarray
    """Concentration of the dye [-], (n,)."""
    age: np.ndarray
    """Time in the vessel [s], (n,)."""


class _Waiting(NamedTuple):
    """A command on its way to the next step."""

    command: Command
    source: str
    since: float
    """Wall time at which it came [s]."""
    on_result: ResultListener | None


class Session:
    """Commands to a simulation, and what it says back."""

    def __init__(
        self,
        simulation: "Simulation",
        models: ModelSelection,
        log: LogWriter | None = None,
        script: Iterable[tuple[float, Command]] = (),
    ):
        """Make a session that has not begun.

        Args:
            simulation: at its start, or where it goes on.
            models: what may be switched to.
            log: where what is done is kept.
            script: simulated times [s] and commands, in any order.
        """
        self.simulation = simulation
        self.models = models
        self.driven = [driven.opening.name for driven in simulation.inflow.openings]
        self._waiting: queue.Queue[_Waiting] = queue.Queue(MOST_WAITING)
        self._ended = False
        self._script = sorted(script, key=lambda entry: entry[0])
        self.recorded: list[LogEntry] = []
        """Commands of a log that are done again, ascending."""
        self.paused = False
        self.speed: float | None = None
        """Limit of simulated over wall time."""
        self._single = False
        self._pace = (0.0, 0.0)
        self.latency = 0.0
        """Longest time that a command has waited for its step, blood not held [s]."""
        self.on_applied: list[Listener] = []
        """Called with each command that was applied or refused, as text."""
        self.on_rejected: list[Listener] = []
        """Called with why a command that had been taken was not applied."""
        self.frame_requested = False
        """Whether somebody waits for the next frame to show."""
        self._latest_frame: ViewFrame | None = None
        self._viewed = 0.0
        self._status: dict[str, Any] = {}
        self._past: deque[tuple[float, float, float, float]] = deque(maxlen=AVERAGED)
        self._log = log

    def load_state(self, state: "State", log: SessionLog) -> None:
        """Go on from a state of this session; commands that came after it are done again."""
        self.simulation.use_model(self.models.ready[state.model])
        self.simulation.load_state(state)
        for entry in log.entries:
            by_hand = isinstance(entry.command, Model) and entry.source != "auto"
            if by_hand and entry.step < state.steps:
                self.models.auto = entry.selects_auto
        after = [entry for entry in log.entries if entry.step >= state.steps]
        self.recorded = [
            entry
            for entry in after
            if entry.source not in ("script", "auto") and not entry.command.affects_pacing_only
        ]
        if state.steps:
            # Done is what was due when its last step began.
            began = state.time - state.last_step
            self._script = [entry for entry in self._script if not is_due(entry[0], began)]

    # What other threads call.

    def submit(
        self,
        value: bytes | str | dict[str, Any],
        source: str,
        on_result: ResultListener | None = None,
    ) -> None:
        """Check a command and have it applied before the next step.

        Args:
            value: the command as JSON, or what JSON has become.
            source: who sent it, for the log.
            on_result: called once with what became of it.

        Raises:
            InputError: it is none, cannot be done, too many wait, or the run has ended.
        """
        command = parse_command(value)
        command.check(self)
        if self._ended:
            raise InputError("the run has ended")
        try:
            waiting = _Waiting(command, source, clock.perf_counter(), on_result)
            self._waiting.put_nowait(waiting)
        except queue.Full:
            raise InputError(f"more than {MOST_WAITING} commands wait: send fewer") from None

    def status(self) -> dict[str, Any]:
        """What the last frame said, for JSON."""
        now = {"paused": self.paused, "speed": self.speed}
        # A frame may take long: the clock goes on meanwhile.
        return self._status | now | ({"time": self.simulation.time} if self._status else {})

    def latest_frame(self, known: ViewFrame | None) -> ViewFrame | None:
        """What was last seen of the blood, if anything; for who knows it, the next is taken."""
        frame = self._latest_frame
        if frame is known:
            self.frame_requested = True
        return frame

    # What commands call, on the run's own thread.

    def hold(self, on: bool) -> None:
        """Hold the blood, or let it go on."""
        self.paused = on

    def step_once(self) -> None:
        """Let one step pass, then hold the blood."""
        self.paused = self._single = True

    def limit_speed(self, factor: float | None) -> None:
        """Go no faster than a factor times real time; as fast as can be with None."""
        self.speed, self._pace = factor, (clock.perf_counter(), self.simulation.time)

    def reset_rates(self) -> None:
        """Begin the means over the last frames anew."""
        self._past.clear()

    # What the run's own thread calls.

    def before_step(self) -> None:
        """Apply what is due; wait while blood is held, or ahead of its pace."""
        self._drain()
        if self.frame_requested and clock.perf_counter() > self._viewed + VIEW_PERIOD:
            self._take_frame()
        while self.paused and not self._single:
            frame = self._latest_frame
            if self.frame_requested and (frame is None or frame.time != self.simulation.time):
                self._take_frame()
            clock.sleep(WAIT)
            self._drain(held=True)
        if self._single:
            self._single = False  # this one; the next is held
            return
        began, at = self._pace
        while self.speed is not None and not self.paused:
            ahead = (self.simulation.time - at) / self.speed - (clock.perf_counter() - began)
            if ahead <= 0.0:
                return
            clock.sleep(min(WAIT, ahead))
            self._drain()

    def _take_frame(self) -> None:
        simulation = self.simulation
        _, position, velocity = simulation.particles.live()
        tracer, n = simulation.boundary(Tracer), len(position)
        self._latest_frame = ViewFrame(
            simulation.time, position, velocity, simulation.outlets.droplets(),
            tracer.dye.to_numpy()[:n], tracer.age.to_numpy()[:n],
        )  # fmt: skip
        self._viewed, self.frame_requested = clock.perf_counter(), False

    def _drain(self, held: bool = False) -> None:
        simulation = self.simulation
        while self.recorded and self.recorded[0].step <= simulation.steps:
            entry = self.recorded.pop(0)
            self._apply(entry.command, entry.source)
        while self._script and is_due(self._script[0][0], simulation.time):
            self._apply(self._script.pop(0)[1], "script")
        for _ in range(MOST_WAITING):
            try:
                waiting = self._waiting.get_nowait()
            except queue.Empty:
                return
            self._apply(waiting.command, waiting.source, waiting.on_result)
            if not held:
                self.latency = max(self.latency, clock.perf_counter() - waiting.since)

    def _now(self) -> dict[str, Any]:
        return {"step": self.simulation.steps, "time": self.simulation.time}

    def _apply(
        self, command: Command, source: str, on_result: ResultListener | None = None
    ) -> None:
        """Do it, as far as it is allowed, and say and write down what was done."""
        at = self._now()
        try:
            done = command.apply(self)
        except InputError as error:
            if on_result is not None:
                on_result({"refused": str(error), **at})
            self.notify(self.on_rejected, str(error))
            self.notify(self.on_applied, f"{source}: refused: {error}")
            if source == "script":
                raise RunError(f"the script cannot go on: {error}") from None
            return
        if on_result is not None:
            on_result({"applied": as_dict(done), **at})
        self._log_applied(done, source, at)

    def _log_applied(self, done: Command, source: str, at: dict[str, Any]) -> None:
        """Write down and say what was done; `at` is the step that it came before, and its time."""
        row = as_dict(done)
        if self._log is not None:
            self._log.write({**at, "source": source, "do": row})
        text = ", ".join(f"{key} {value}" for key, value in row.items() if key != "command")
        self.notify(self.on_applied, f"{source}: {row['command']} {text}".rstrip())

    @staticmethod
    def notify(listeners: list[Listener], text: str) -> None:
        """Tell listeners a sentence."""
        for listener in listeners:
            listener(text)

    def on_frame(self, simulation: "Simulation", frame: int, diagnostics: "Diagnostics") -> None:
        """Write the frame's digest, take its status and let `auto` choose.

        Raises:
            OSError: the log cannot be written.
        """
        if self._log is not None:
            self._log.write_frame(simulation, frame, diagnostics)
        self._status = self._status_of(simulation, frame, diagnostics)
        if name := self.models.choose(diagnostics.compression_p99):
            self._log_applied(Model(name=name), "auto", self._now())  # type: ignore[arg-type]

    def _status_of(
        self, simulation: "Simulation", frame: int, diagnostics: "Diagnostics"
    ) -> dict[str, Any]:
        now = clock.perf_counter()
        drained, bled = diagnostics.drained_volume, diagnostics.bled_volume
        self._past.append((now, diagnostics.time, drained, bled))
        then, since, drained_then, bled_then = self._past[0]
        span = diagnostics.time - since
        return {
            "time": diagnostics.time,
            "frames": frame,
            "real_time_factor": span / (now - then) if now > then else 0.0,
            "particles": diagnostics.particles,
            "flow_out": (drained - drained_then) / span if span > 0.0 else 0.0,
            "bleeding": (bled - bled_then) / span if span > 0.0 else 0.0,
            "lost": bled,
            "suctioned": diagnostics.sucked_volume,
            "added": diagnostics.added_volume,
            "mean_age": diagnostics.mean_age,
            "compression": diagnostics.compression_p99,
            "guard_share": self.models.fallback_fraction(diagnostics),
            "model": self.models.selected,
            "gravity": list(simulation.gravity),
            "suction": simulation.suction.rate,
            "wounds": [
                {
                    "centre": w.begin.tolist(), "end": w.end.tolist(), "radius": w.radius,
                    "open": w.is_open,
                }
                for w in simulation.wounds
            ],
            "tool_position": simulation.tool.position.tolist(),
            "tool_force": simulation.tool.take_force().tolist(),
        }  # fmt: skip

    def close(self, ending: str) -> None:
        """End the log; refuse what still waits.

        Raises:
            OSError: the log cannot be written.
        """
        self._ended = True
        while not self._waiting.empty():
            waiting = self._waiting.get_nowait()
            if waiting.on_result is not None:
                waiting.on_result({"refused": "the run has ended"})
        if self._log is not None:
            self._log.close(ending)

    @property
    def log_file(self) -> Path | None:
        """Where what is done is kept."""
        return self._log.path if self._log else None


def start_session(
    simulation: "Simulation",
    metadata: dict[str, Any],
    *,
    log: Path | None = None,
    script: Path | None = None,
    weights: Path | None = None,
    checkpoint: "Checkpoint | None" = None,
    all_models: bool = False,
) -> Session:
    """The session of a run: its models, its script, its log, and where it goes on from.

    No file is written before the first frame.

    Args:
        simulation: at its start.
        metadata: what the run is of, with the name of its `model`.
        log: file for what is done.
        script: file of commands at times.
        weights: file of the network's weights; the scene's, or the aorta's, by default.
        checkpoint: where it goes on from; what `log` holds is then what was done before.
        all_models: whether every model is offered that fits the scene.

    Raises:
        InputError: a script, a log or weights that cannot be used.
    """
    entries = read_script(script) if script is not None else []
    earlier = None
    if log is not None:
        check_output(log, "--session", b'{"format": "vesselflow session')
    if log is not None and checkpoint is None:
        require_free(log)
    elif log is not None and checkpoint is not None and log.is_file():
        earlier = read_session(log, "--session")
        if earlier.is_of(checkpoint.frame, checkpoint.state) is False:
            raise InputError(
                f"--session {log}: at frame {checkpoint.frame} it holds other blood than the "
                "checkpoint to go on from: it is of another run; name that one's log, or a new file"
            )
    known = earlier or SessionLog({}, [], {}, [], ())
    commands = [command for _, command in entries] + [entry.command for entry in known.entries]
    needed = {metadata["model"], *(c.name for c in commands if isinstance(c, Model))}
    if checkpoint is not None:
        needed.add(checkpoint.state.model)
    if all_models and weights is not None:
        needed.add("pcnet")  # asked for by its file
    models = ModelSelection(simulation, needed, MODELS if all_models else (), weights)
    writer = None
    if log is not None:
        network = network_metadata(simulation, weights) if "pcnet" in models.ready else None
        head = {"folder": str(simulation.scene.folder), "models": list(models.ready)}
        before = known.until(checkpoint.frame, checkpoint.state.steps) if checkpoint else []
        writer = LogWriter(
            log, metadata | head | {"network": network}, simulation.particles.names, earlier, before
        )
    session = Session(simulation, models, writer, entries)
    if checkpoint is not None:
        session.load_state(checkpoint.state, known)
    return session
