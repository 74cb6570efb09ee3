"""Session: a run that is acted upon: commands come in, are applied between steps, and are kept.

The log is JSON, a line each: a head that says what the run is of, every command with the step that
it came before, and a digest of the blood at every frame.  `replay` makes the run again from it.
"""

import hashlib
import json
import queue
import time as clock
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from app.control.commands import (
    AnyCommand,
    Clamp,
    Gravity,
    Inflow,
    Model,
    Pause,
    Reset,
    Speed,
    Step,
    Suction,
    Tool,
    Wound,
    as_dict,
    parse_command,
)
from app.files import write_text
from app.models import MODELS, model_factory
from app.progress import Progress
from app.run.loop import Observer, drive
from app.scenes.library import weights_for, with_column
from taichi_sph.errors import InputError, RunError
from taichi_sph.runtime import start
from taichi_sph.scene import Scene, parse_scene
from taichi_sph.simulation import ModelFactory, Simulation
from taichi_sph.state import State

if TYPE_CHECKING:
    from app.run.checkpoint import Checkpoint
    from taichi_sph.diagnostics import Diagnostics
    from taichi_sph.fluid.wcsph import AccelerationModel

FORMAT = "vesselflow session 1"
MOST_WAITING = 1000
"""Commands that wait for the next step; more are refused."""
STRONGEST_GRAVITY = 30.0
"""Of a tilt [m/s^2]: three times the Earth's."""
LARGEST_FACTOR = 2.0
"""Of an inflow: the sound speed is chosen for the scene's own."""
TOO_DENSE, DENSE_NO_MORE = 0.08, 0.04
"""`auto` leaves PcNet where the 99th percentile of compression is above the first, for what its
training saw is below, and comes back below the second."""
AVERAGED = 20
"""Frames that rates are averaged over."""
KEPT = (
    "drained_volume", "added_volume", "bled_volume", "sucked_volume", "compression_p99",
    "max_speed", "leaks", "wall_corrections", "fallback_share",
)  # fmt: skip
"""Figures of a frame that the log keeps beside its digest."""
PICTURE_PERIOD = 0.05
"""Least time between two pictures [s]: a frame may take many seconds of the wall's."""
WAIT = 0.005
"""Between two looks at the commands, while blood is held [s]."""


@dataclass(frozen=True)
class Picture:
    """What a page shows of a frame."""

    time: float
    """[s]"""
    positions: np.ndarray
    """[m], (n, 3)."""
    velocities: np.ndarray
    """[m/s], (n, 3)."""
    drops: np.ndarray
    """Blood that has left through wounds [m], (m, 3)."""


class Session:
    """Commands to a simulation, and what it says back."""

    def __init__(
        self,
        simulation: "Simulation",
        makers: "dict[str, ModelFactory]",
        log: Path | None = None,
        facts: dict[str, Any] | None = None,
        script: Iterable[tuple[float, AnyCommand]] = (),
        before: Iterable[dict[str, Any]] = (),
    ):
        """Make the models ready.

        Args:
            simulation: at its start, or where it goes on.
            makers: of the models that may be switched to, by name.
            log: file for what is done.
            facts: what the run is of, for the log's head.
            script: simulated times [s] and commands, in any order.
            before: lines that the log holds already, of a session that goes on.

        Raises:
            InputError: a model cannot be made, or the log cannot be written.
        """
        self.simulation = simulation
        self.driven = [driven.opening.name for driven in simulation.inflow.openings]
        self._bounds = [corner.tolist() for corner in simulation.bounds]
        self.models: dict[str, AccelerationModel] = {simulation.model.name: simulation.model}
        for name, maker in makers.items():
            if name not in self.models:
                self.models[name] = simulation.make_model(maker)
        simulation.compile_kernels(list(self.models.values()))
        self._waiting: queue.Queue[tuple[AnyCommand, str, float]] = queue.Queue(MOST_WAITING)
        self._script = sorted(script, key=lambda entry: entry[0])
        self.recorded: list[Entry] = []
        """Commands of a log that are done again, ascending."""
        self.paused = False
        self.speed: float | None = None
        self.auto = False
        self._auto_until = self._auto_time = self._stood_in = 0.0
        self._single = False
        self._pace = (0.0, 0.0)
        self.latency = 0.0
        """Longest time that a command has waited for its step, blood not held [s]."""
        self.notes: list[Callable[[str], None]] = []
        """Called with each command that was applied or refused, as text."""
        self.refusals: list[Callable[[str], None]] = []
        """Called with why a command that had been taken was not applied."""
        self.watched = False
        """Whether somebody waits for the next picture."""
        self._picture: Picture | None = None
        self._pictured = 0.0
        self._figures: dict[str, Any] = {}
        self._past: deque[tuple[float, float, float, float]] = deque(maxlen=AVERAGED)
        self._log = None
        if log is not None:
            head = {"format": FORMAT, "facts": facts or {}}
            try:
                # Whole or not at all: what it held must outlive a kill.
                write_text(log, "".join(json.dumps(row) + "\n" for row in (head, *before)))
                self._log = log.open("ab")
            except OSError as error:
                raise InputError(f"{log}: cannot be written: {error.strerror}") from None

    def load_state(self, state: "State", kept: "Kept") -> None:
        """Go on from a state of this session; commands that came after it are done again."""
        simulation = self.simulation
        simulation.use_model(self.models[state.model])
        simulation.load_state(state)
        for entry in kept.entries:
            by_hand = isinstance(entry.command, Model) and entry.source != "auto"
            if by_hand and entry.step < state.steps:
                self.auto = entry.to_auto
        after = [entry for entry in kept.entries if entry.step >= state.steps]
        self.recorded = [e for e in after if e.source not in ("script", "auto") and not e.timeless]
        if state.steps:
            # Done is what was due when its last step began.
            began = state.time - state.last_step
            self._script = [entry for entry in self._script if not is_due(entry[0], began)]

    def replay(self, kept: "Kept") -> None:
        """Do again all that a log holds; `auto` chooses as it did."""
        self.recorded = [
            Entry(e.step, e.source, Model(name="pcnet") if e.to_auto else e.command)
            for e in kept.entries
            if not e.timeless
        ]

    # What other threads call.

    def offer(self, given: bytes | str | dict[str, Any], source: str) -> None:
        """Check a command and have it applied before the next step.

        Raises:
            InputError: it is none, cannot be done, or too many wait.
        """
        command = parse_command(given)
        self._require(command)
        try:
            self._waiting.put_nowait((command, source, clock.perf_counter()))
        except queue.Full:
            raise InputError(f"more than {MOST_WAITING} commands wait: send fewer") from None

    def figures(self) -> dict[str, Any]:
        """What the last frame said, for JSON."""
        now = {"paused": self.paused, "speed": self.speed}
        # A frame may take long: the clock goes on meanwhile.
        return self._figures | now | ({"time": self.simulation.time} if self._figures else {})

    def picture(self, known: Picture | None) -> Picture | None:
        """What was last seen of the blood, if anything; for who knows it, the next is taken."""
        picture = self._picture
        if picture is known:
            self.watched = True
        return picture

    # What the run's own thread calls.

    def _require(self, command: AnyCommand) -> None:
        """Refuse what can be seen to be impossible at once.

        Raises:
            InputError: what is allowed.
        """
        if isinstance(command, Inflow) and command.opening not in (None, *self.driven):
            allowed = ", ".join(self.driven) or "none"
            raise InputError(f"inflow: nothing drives {command.opening!r}; driven: {allowed}")
        if isinstance(command, Inflow) and not self.driven:
            raise InputError("inflow: nothing drives this scene's blood")
        names = [*self.models] + ["auto"] * ({"pcnet", "implicit"} <= self.models.keys())
        if isinstance(command, Model) and command.name not in names:
            allowed = ", ".join(names)
            raise InputError(f"model: {command.name!r} is not ready; allowed: {allowed}")

    def before_step(self) -> None:
        """Apply what is due; wait while blood is held, or ahead of its pace."""
        self._drain()
        if self.watched and clock.perf_counter() > self._pictured + PICTURE_PERIOD:
            self._take_picture()
        while self.paused and not self._single:
            if self.watched and (
                self._picture is None or self._picture.time != self.simulation.time
            ):
                self._take_picture()
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

    def _take_picture(self) -> None:
        simulation = self.simulation
        _, position, velocity = simulation.particles.live()
        self._picture = Picture(simulation.time, position, velocity, simulation.outlets.droplets())
        self._pictured, self.watched = clock.perf_counter(), False

    def _drain(self, held: bool = False) -> None:
        simulation = self.simulation
        while self.recorded and self.recorded[0].step <= simulation.steps:
            entry = self.recorded.pop(0)
            self._apply(entry.command, entry.source)
        while self._script and is_due(self._script[0][0], simulation.time):
            self._apply(self._script.pop(0)[1], "script")
        for _ in range(MOST_WAITING):
            try:
                command, source, since = self._waiting.get_nowait()
            except queue.Empty:
                return
            self._apply(command, source)
            if not held:
                self.latency = max(self.latency, clock.perf_counter() - since)

    def _apply(self, command: AnyCommand, source: str) -> None:
        """Do it, as far as it is allowed, and write down what was done."""
        try:
            done = self._do(command)
        except InputError as error:
            self._tell(self.refusals, str(error))
            self._tell(self.notes, f"{source}: refused: {error}")
            if source == "script":
                raise RunError(f"the script cannot go on: {error}") from None
            return
        self._note(done, source)

    def _note(self, done: AnyCommand, source: str) -> None:
        simulation, row = self.simulation, as_dict(done)
        self._write(
            {"step": simulation.steps, "time": simulation.time, "source": source, "do": row}
        )
        text = ", ".join(f"{key} {value}" for key, value in row.items() if key != "command")
        self._tell(self.notes, f"{source}: {row['command']} {text}".rstrip())

    @staticmethod
    def _tell(listeners: list[Callable[[str], None]], text: str) -> None:
        for listener in listeners:
            listener(text)

    def _do(self, command: AnyCommand) -> AnyCommand:
        """Do it; returns what was done, within its bounds."""
        simulation = self.simulation
        if isinstance(command, Pause):
            self.paused = command.on
        elif isinstance(command, Step):
            self.paused = self._single = True
        elif isinstance(command, Speed):
            self.speed, self._pace = command.factor, (clock.perf_counter(), simulation.time)
        elif isinstance(command, Gravity):
            strength = float(np.linalg.norm(command.vector))
            bound = min(1.0, STRONGEST_GRAVITY / max(strength, 1e-30))
            x, y, z = (bound * value for value in command.vector)
            command = Gravity(vector=(x, y, z))
            simulation.gravity = command.vector
        elif isinstance(command, Inflow):
            command = Inflow(factor=min(command.factor, LARGEST_FACTOR), opening=command.opening)
            simulation.inflow.set_factor(command.factor, command.opening)
        elif isinstance(command, Model):
            self.auto = command.name == "auto"
            self._auto_until, self._auto_time, self._stood_in = simulation.time, 0.0, 0.0
            simulation.use_model(self.models["pcnet" if self.auto else command.name])
        elif isinstance(command, Tool):
            low, high = self._bounds
            x, y, z = map(max, low, map(min, command.position, high))
            command = Tool(position=(x, y, z), rotation=command.rotation)
            simulation.tool.move_to(np.array(command.position), _unit(command.rotation))
        elif isinstance(command, Suction):
            simulation.suction.set(command.rate, command.radius)
        elif isinstance(command, Wound):
            end = None if command.end is None else np.array(command.end)
            simulation.wounds.open(np.array(command.centre), command.radius, end)
        elif isinstance(command, Clamp):
            simulation.wounds.close(command.wound)
        elif isinstance(command, Reset):
            simulation.reset()
            self._past.clear()
        return command

    def on_frame(self, simulation: "Simulation", frame: int, figures: "Diagnostics") -> None:
        """Write the frame's digest, take its figures and let `auto` choose.

        Raises:
            OSError: the log cannot be written.
        """
        self._write(
            {
                "frame": frame, "step": simulation.steps, "time": simulation.time,
                "digest": digest(simulation), "particles": figures.particles,
                **{name: getattr(figures, name) for name in KEPT},
            }
        )  # fmt: skip
        now = clock.perf_counter()
        drained, bled = figures.drained_volume, figures.bled_volume
        self._past.append((now, figures.time, drained, bled))
        then, since, drained_then, bled_then = self._past[0]
        span = figures.time - since
        self._figures = {
            "time": figures.time,
            "frames": frame,
            "real_time_factor": span / (now - then) if now > then else 0.0,
            "particles": figures.particles,
            "flow_out": (drained - drained_then) / span if span > 0.0 else 0.0,
            "bleeding": (bled - bled_then) / span if span > 0.0 else 0.0,
            "lost": bled,
            "suctioned": figures.sucked_volume,
            "added": figures.added_volume,
            "compression": figures.compression_p99,
            "guard_share": self._guard_share(figures),
            "model": "auto" if self.auto else simulation.model.name,
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
        if self.auto and figures.compression_p99 > TOO_DENSE:
            self._choose("implicit")
        elif self.auto and figures.compression_p99 < DENSE_NO_MORE:
            self._choose("pcnet")

    def _guard_share(self, figures: "Diagnostics") -> float:
        """Part of the time in which something else stood in for the network."""
        if not self.auto:
            return figures.fallback_share
        passed, self._auto_until = figures.time - self._auto_until, figures.time
        self._auto_time += passed
        self._stood_in += passed * (self.simulation.model.name != "pcnet")
        return self._stood_in / self._auto_time if self._auto_time > 0.0 else 0.0

    def _choose(self, name: str) -> None:
        if self.simulation.model.name != name:
            self.simulation.use_model(self.models[name])
            self._note(Model(name=name), "auto")  # type: ignore[arg-type]

    def _write(self, line: dict[str, Any]) -> None:
        if self._log is not None:
            try:
                # Of json's time msgspec takes a third, and a hand moves the tool 50 times a second.
                text = msgspec.json.encode(line, enc_hook=lambda value: value.item())
                self._log.write(text + b"\n")
                self._log.flush()
            except OSError as error:
                raise OSError(
                    f"{self._log.name}: the session cannot be kept: {error.strerror}"
                ) from None

    def close(self, ending: str) -> None:
        """End the log.

        Raises:
            OSError: it cannot be written.
        """
        try:
            # A file's name may be in it, in whatever encoding.
            self._write({"end": ending.encode(errors="replace").decode()})
        finally:
            if self._log is not None:
                self._log.close()
                self._log = None


def _unit(rotation: tuple[float, ...] | None) -> np.ndarray | None:
    """A quaternion of length one; none of one without length."""
    if rotation is None or not np.linalg.norm(rotation) > 1e-6:
        return None
    return np.array(rotation) / np.linalg.norm(rotation)


def digest(simulation: "Simulation") -> str:
    """Hash of where the blood is and how it moves, bit by bit."""
    text = hashlib.sha256()
    for rows in simulation.particles.digested_rows():
        text.update(rows.tobytes())
    return text.hexdigest()[:16]


def is_due(at: float, time: float) -> bool:
    """Whether a script's command for one time [s] is due at another; sums of steps round."""
    return at <= time * (1.0 + 1e-12)


def read_script(path: Path) -> list[tuple[float, AnyCommand]]:
    """Commands at times: JSON lines such as {"at": 0.5, "command": "clamp"}.

    Raises:
        InputError: it cannot be read; which line is wrong and how.
    """
    entries = []
    for number, line in enumerate(_lines(path, "--script"), 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            row = json.loads(line)
            at = float(row.pop("at"))
            if not 0.0 <= at < 1e6:
                raise ValueError
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError):
            raise InputError(
                f"--script {path}: line {number} is {line.strip()[:60]!r}; allowed: "
                '{"at": seconds, "command": ...}'
            ) from None
        try:
            entries.append((at, parse_command(row)))
        except InputError as error:
            raise InputError(f"--script {path}: line {number}: {error}") from None
    return entries


def _lines(path: Path, option: str) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").removesuffix("\n").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise InputError(f"{option} {path}: cannot be read: {reason}") from None


@dataclass(frozen=True)
class Entry:
    """A command in a log."""

    step: int
    """That it came before."""
    source: str
    command: AnyCommand

    @property
    def timeless(self) -> bool:
        """Whether it changes when blood moves, but not how."""
        return isinstance(self.command, Pause | Step | Speed)

    @property
    def to_auto(self) -> bool:
        """Whether it hands the choice of the model over."""
        return isinstance(self.command, Model) and self.command.name == "auto"


@dataclass(frozen=True)
class Kept:
    """What a log holds."""

    facts: dict[str, Any]
    entries: list[Entry]
    digests: dict[int, str]
    """Of the blood, by frame."""
    rows: list[dict[str, Any]]
    """All lines but the head."""

    def until(self, frame: int, step: int) -> list[dict[str, Any]]:
        """Lines of what came before a frame and a step."""
        return [
            row
            for row in self.rows
            if ("do" in row and row["step"] < step) or ("frame" in row and row["frame"] < frame)
        ]


def read_session(path: Path, option: str) -> Kept:
    """Read a log; of one that was cut the whole lines.

    Raises:
        InputError: it is none.
    """
    lines = _lines(path, option)
    try:
        head = json.loads(lines[0])
        if head["format"] != FORMAT:
            raise KeyError("format")
        facts = dict(head["facts"])
    except (IndexError, KeyError, TypeError, ValueError):
        raise InputError(
            f"{option} {path}: not a session; `vesselflow run --session FILE` writes one"
        ) from None
    entries: list[Entry] = []
    digests: dict[int, str] = {}
    rows: list[dict[str, Any]] = []
    for number, line in enumerate(lines[1:], 2):
        try:
            row = json.loads(line)
            if "frame" in row:
                digests[int(row["frame"])] = str(row["digest"])
            elif "do" in row:
                command = parse_command(row["do"])
                entries.append(Entry(int(row["step"]), str(row["source"]), command))
            rows.append(row)
        except (ValueError, KeyError, TypeError, InputError):
            if number == len(lines):
                break  # cut while it was written
            raise InputError(f"{option} {path}: line {number} is no line of a session") from None
    if not digests:
        raise InputError(f"{option} {path}: holds no frame")
    return Kept(facts, entries, digests, rows)


class Comparer:
    """Observer of a replay: whether each frame is the one that the log has, bit by bit."""

    def __init__(self, kept: Kept):
        """`kept` is what the log holds."""
        self.kept = kept
        self.compared = 0
        self.first_difference: int | None = None

    def on_frame(self, simulation: "Simulation", frame: int, figures: "Diagnostics") -> None:
        """Compare a frame."""
        wanted = self.kept.digests.get(frame)
        if wanted is not None:
            self.compared += 1
            if wanted != digest(simulation) and self.first_difference is None:
                self.first_difference = frame
        every = self.kept.facts.get("checkpoint")
        if every and frame % every == 0:
            simulation.save_state()  # after which the lists are built anew, as they were then

    def close(self, ending: str) -> None:
        """Nothing."""


def _models(
    names: Iterable[str], scene: "Scene", weights: Path | None
) -> "tuple[dict[str, ModelFactory], dict[str, Any]]":
    """Makers of models by name, and for the log what the network's weights were."""
    makers = {n: model_factory(n, scene, weights) for n in MODELS if n in names or "auto" in names}
    file = (weights or weights_for(scene)).resolve()
    of = {"file": str(file), "hash": hashlib.sha256(file.read_bytes()).hexdigest()}
    return makers, {"network": of if "pcnet" in makers else None}


def open_session(
    simulation: "Simulation",
    weights: Path | None,
    script: Path | None,
    log: Path | None,
    begun: "Checkpoint | None",
    facts: dict[str, Any],
    all_models: bool,
) -> Session:
    """The session of a run: its models, its script, its log, and where it goes on from.

    Raises:
        InputError: a script, a log or weights that cannot be used.
    """
    scene = simulation.scene
    entries = read_script(script) if script is not None else []
    kept = Kept({}, [], {}, [])
    if begun is not None and log is not None and log.is_file():
        kept = read_session(log, "--session")
    elif log is not None and log.is_file() and log.stat().st_size:
        raise InputError(f"--session {log}: holds another session; name another file")
    commands = [c for _, c in entries] + [e.command for e in kept.entries]
    names = {facts["model"], *(c.name for c in commands if isinstance(c, Model))}
    if begun is not None:
        names.add(begun.state.model)
    makers, network = _models(MODELS if all_models else names, scene, weights)
    head = {"folder": str(scene.folder), "models": list(makers), **network}
    before = kept.until(begun.frame, begun.state.steps) if begun is not None else []
    session = Session(simulation, makers, log, facts | head, entries, before)
    if begun is not None:
        session.load_state(begun.state, kept)
    return session


def run_again(path: Path, rrd: Path | None, threads: int | None) -> tuple[Kept, int, int | None]:
    """Make the run of a log again.

    Returns:
        the log, how many frames were compared, and the first that differs, if any.

    Raises:
        InputError: it is no log, or what it needs is not there as it was.
        RunError: the run diverges, and did not then.
    """
    kept = read_session(path, "replay")
    try:
        facts = kept.facts
        scene = parse_scene(
            facts["scene_text"], f"replay {path}: the scene", Path(facts["folder"]), facts["scene"]
        )
        scene = with_column(scene, facts["particles"], facts["height"])
        network, model, names = facts["network"], facts["model"], facts["models"]
        arch, precision, seed = facts["arch"], facts["precision"], facts["seed"]
        weights = Path(network["file"]) if network else None
    except (KeyError, TypeError):
        raise InputError(f"replay {path}: its head is not whole") from None
    if weights is not None:
        content = weights.read_bytes() if weights.is_file() else b""
        if hashlib.sha256(content).hexdigest() != network["hash"]:
            raise InputError(f"replay {path}: {weights} is not there as it was: the network's")
    start(arch, precision, threads, random_seed=seed)
    makers, _ = _models(names, scene, weights)
    simulation = Simulation.from_scene(scene, makers[model], seed)
    session = Session(simulation, makers)
    session.replay(kept)
    comparer = Comparer(kept)
    observers: list[Observer] = [session, comparer]
    if rrd is not None:
        from app.view.rerun_view import RerunView

        view = RerunView(simulation, rrd)
        session.notes.append(view.note)
        observers.append(view)
    until = max(kept.digests) * scene.frame_interval
    outcome = drive(
        simulation, observers, until, scene.frame_interval, Progress(until, scene.name),
        before_step=session.before_step,
    )  # fmt: skip
    if outcome.error is not None:
        raise outcome.error
    return kept, comparer.compared, comparer.first_difference
