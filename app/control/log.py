"""SessionLog: what was done to a run and what came of it, in a file of JSON lines.

A head that says what the run is of, every command with the step that it came before, and a digest
of the blood at every frame.  A script is likewise JSON lines: commands and their times.
"""

import contextlib
import glob
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import msgspec
import numpy as np

from app.control.commands import Command, Model, parse_command
from app.files import write_text
from taichi_sph.errors import InputError

if TYPE_CHECKING:
    from app.run.checkpoint import Checkpoint
    from taichi_sph.diagnostics import Diagnostics
    from taichi_sph.simulation import Simulation
    from taichi_sph.state import State

FORMAT = "vesselflow session 2"
FORMAT_1 = "vesselflow session 1"
"""Its digests cover STATE_1; since then the head names what they cover."""
STATE_1 = ("identity", "position", "velocity")
LOGGED = {
    "drained_volume": "drained_volume",
    "added_volume": "added_volume",
    "bled_volume": "bled_volume",
    "sucked_volume": "sucked_volume",
    "compression_p99": "compression_p99",
    "max_speed": "max_speed",
    "leaks": "leaks",
    "wall_corrections": "wall_corrections",
    "fallback_share": "fallback_share",
}
"""Diagnostics of a frame that the log has beside its digest: key of the log, name in the code."""


def digest(rows: Mapping[str, np.ndarray], names: Iterable[str]) -> str:
    """Hash of some quantities of all particles, by name, bit by bit."""
    text = hashlib.sha256()
    for name in names:
        text.update(np.ascontiguousarray(rows[name]).tobytes())
    return text.hexdigest()[:16]


@dataclass(frozen=True)
class LogEntry:
    """A command in a log."""

    step: int
    """Number of the step that the command came before."""
    source: str
    command: Command

    @property
    def selects_auto(self) -> bool:
        """Whether it leaves the choice of the model to the program."""
        return isinstance(self.command, Model) and self.command.name == "auto"


@dataclass(frozen=True)
class SessionLog:
    """What a log holds."""

    metadata: dict[str, Any]
    """What the run is of."""
    entries: list[LogEntry]
    digests: dict[int, str]
    """Digest of the blood by frame."""
    rows: list[dict[str, Any]]
    """All lines but the head."""
    state: tuple[str, ...]
    """Names of the quantities of a particle that the digests cover."""

    def until(self, frame: int, step: int) -> list[dict[str, Any]]:
        """Lines of what came before a frame and a step."""
        return [
            row
            for row in self.rows
            if ("do" in row and row["step"] < step) or ("frame" in row and row["frame"] < frame)
        ]

    def is_of(self, frame: int, state: "State") -> bool | None:
        """Whether a saved state is what the log has at a frame; None if it has not that frame."""
        if frame not in self.digests:
            return None
        known = state.particles.keys() >= set(self.state)
        return known and self.digests[frame] == digest(state.particles, self.state)


class LogWriter:
    """A log on its way to its file, which is made by the first line and not before.

    A run that is refused before its first frame leaves nothing behind.
    """

    def __init__(
        self, path: Path, metadata: dict[str, Any], state: Sequence[str],
        resumed: SessionLog | None = None, before: Iterable[dict[str, Any]] = (),
    ):  # fmt: skip
        """Say what goes into the file.

        Args:
            path: a file that is not there, or empty, or that the run goes on with.
            metadata: what the run is of, for the head.
            state: names of the quantities of a particle, for the digests.
            resumed: the log that the run goes on with; its file is replaced.
            before: lines of that log that stay.
        """
        self.path = path
        self.state = resumed.state if resumed else tuple(state)
        named = {} if self.state == STATE_1 else {"state": list(self.state)}
        head = {"format": FORMAT if named else FORMAT_1, "facts": metadata, **named}
        self._first = "".join(json.dumps(row) + "\n" for row in (head, *before))
        self._replaces = resumed is not None
        self._file: IO[bytes] | None = None

    def write_frame(self, simulation: "Simulation", frame: int, diagnostics: "Diagnostics") -> None:
        """Write a frame's digest and diagnostics.

        Raises:
            OSError: the log cannot be written.
        """
        self.write(
            {
                "frame": frame, "step": simulation.steps, "time": simulation.time,
                "digest": digest(simulation.particles.rows(), self.state),
                "particles": diagnostics.particles,
                **{key: getattr(diagnostics, name) for key, name in LOGGED.items()},
            }
        )  # fmt: skip

    def write(self, row: dict[str, Any]) -> None:
        """Write a line.

        Raises:
            OSError: the log cannot be written.
        """
        # Of json's time msgspec takes a third, and a hand moves the tool 50 times a second.
        text = msgspec.json.encode(row, enc_hook=lambda value: value.item())
        try:
            if self._file is None:
                self._file = self._open()
            self._file.write(text + b"\n")
            self._file.flush()
        except FileExistsError:
            raise OSError(f"{self.path}: another session has begun in it") from None
        except OSError as error:
            raise OSError(f"{self.path}: the session cannot be kept: {error.strerror}") from None

    def _open(self) -> IO[bytes]:
        if not self._replaces:
            if self.path.is_file() and self.path.stat().st_size:
                raise FileExistsError
            if not self.path.exists():
                self.path.open("xb").close()  # of two that begin at once one is refused
        # Whole or not at all: what it held must outlive a kill.
        write_text(self.path, self._first)
        return self.path.open("ab")

    def close(self, ending: str) -> None:
        """Write how the run ended, and end the file; nothing where none was begun.

        Raises:
            OSError: it cannot be written.
        """
        if self._file is None:
            return
        try:
            # A file's name may be in it, in whatever encoding.
            self.write({"end": ending.encode(errors="replace").decode()})
        finally:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None


def read_session(path: Path, option: str) -> SessionLog:
    """Read a log; of one that was cut the whole lines.

    Raises:
        InputError: it is none.
    """
    lines = _lines(path, option)
    try:
        head = json.loads(lines[0])
        if head["format"] not in (FORMAT, FORMAT_1):
            raise KeyError("format")
        metadata = dict(head["facts"])
        state = STATE_1 if head["format"] == FORMAT_1 else tuple(map(str, head["state"]))
    except (IndexError, KeyError, TypeError, ValueError):
        raise InputError(
            f"{option} {path}: not a session; `vesselflow run --session FILE` writes one"
        ) from None
    entries: list[LogEntry] = []
    digests: dict[int, str] = {}
    rows: list[dict[str, Any]] = []
    for number, line in enumerate(lines[1:], 2):
        try:
            row = json.loads(line)
            if "frame" in row:
                digests[int(row["frame"])] = str(row["digest"])
            elif "do" in row:
                command = parse_command(row["do"])
                entries.append(LogEntry(int(row["step"]), str(row["source"]), command))
            rows.append(row)
        except (ValueError, KeyError, TypeError, InputError):
            if number == len(lines):
                break  # cut while it was written
            raise InputError(f"{option} {path}: line {number} is no line of a session") from None
    if not digests:
        raise InputError(f"{option} {path}: holds no frame")
    return SessionLog(metadata, entries, digests, rows, state)


def log_of(checkpoint: "Checkpoint", name: str) -> Path | None:
    """The default log of the session that a checkpoint is of; None where there are none at all.

    Raises:
        InputError: there are some, and none is of it.
    """
    pattern = glob.escape(name)
    logs = [*Path().glob(f"{pattern}.session.jsonl"), *Path().glob(f"{pattern}.*.session.jsonl")]
    for path in logs:
        with contextlib.suppress(InputError):  # none, or begun and not gone on with
            if read_session(path, "--session").is_of(checkpoint.frame, checkpoint.state):
                return path
    if logs:
        raise InputError(
            f"--resume: none of {', '.join(map(str, logs))} is the session of the checkpoint; name "
            "its log, or a new file, with --session"
        )
    return None


def require_free(path: Path) -> None:
    """Refuse a file that holds another session.

    Raises:
        InputError: what may be done with it.
    """
    if path.is_file() and path.stat().st_size:
        raise InputError(
            f"--session {path}: holds another session; see it again with `vesselflow replay "
            f"{path}`, go on with it by --resume CHECKPOINT, or name another file with --session"
        )


def is_due(at: float, time: float) -> bool:
    """Whether a script's command for one time [s] is due at another; sums of steps round."""
    return at <= time * (1.0 + 1e-12)


def read_script(path: Path) -> list[tuple[float, Command]]:
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
