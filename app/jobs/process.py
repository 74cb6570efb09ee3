"""A process for one piece of work, which tells how far it is and leaves its answer in a file."""

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taichi_sph.errors import InputError, RunError

POLL = 0.05
"""Wall time between two looks at a process [s]: little beside the start of one."""
PATIENCE = 5.0
"""Wall time that a process is given to end when asked to [s]."""


ATTEMPTS = 3
"""Processes that a job may take with it: a cause outside it is seldom there three times."""


class ProcessError(RunError):
    """A process ended without an answer."""


@dataclass(frozen=True)
class Event:
    """What has happened to jobs that run."""

    done: float
    """Jobs done, counting parts of those under way."""
    ended: int | None = None
    """Number of a job that has ended, if one has, with `result` or `error`."""
    result: Any = None
    error: Exception | None = None
    sentence: str = ""
    """What to say of it, if anything."""


# In the process of a job.

_told: Path | None = None
"""Where this process, if it is a job's, tells how far it is."""


def report(fraction: float) -> None:
    """Tell who waits for this job which part of it is done, from 0 to 1; nothing outside of one."""
    if _told is not None:
        with contextlib.suppress(OSError):  # a look at it is not worth a job
            _told.write_text(f"{fraction:.6f}", encoding="ascii")


def serve(name: str) -> None:
    """Do the job in a folder: the whole life of its process."""
    global _told
    folder = Path(name)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who waits for us decides
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _told = folder / "told"
    answer: tuple[Any, Exception | None]
    try:
        with (folder / "job").open("rb") as file:
            work, arguments = pickle.load(file)
        answer = work(*arguments), None
    except Exception as error:
        if not isinstance(error, InputError | RunError | OSError):
            traceback.print_exc()  # a mistake of ours: where it is would be lost on the way
        answer = None, error
    try:
        content = pickle.dumps(answer)
        pickle.loads(content)  # exceptions may be written that cannot be read
    except Exception:
        content = pickle.dumps((None, RuntimeError(f"{answer[1] or 'a result'!r} cannot be sent")))
    # No result is half of one, and nothing that is printed gets into it.
    (folder / "answer.part").write_bytes(content)
    os.replace(folder / "answer.part", folder / "answer")


def _end_with_parent() -> None:
    """End this process when its standard input does: who waited for it is gone."""
    with contextlib.suppress(OSError):
        while os.read(0, 1):
            pass
    os._exit(1)


# In the process that waits.


def describe_exit(code: int) -> str:
    """How a process ended, for people."""
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"was ended by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"


class Process:
    """Function at work in a process of its own."""

    def __init__(self, content: bytes, threads: int | None = None):
        """Start it.

        Args:
            content: the function and its arguments, pickled.
            threads: CPU threads that it takes where it does not say itself; all by default.
        """
        self._folder = tempfile.TemporaryDirectory(prefix="vesselflow-")
        self.folder = Path(self._folder.name)
        (self.folder / "job").write_bytes(content)
        program = (
            f"import sys; sys.path[:] = {sys.path!r}\n"
            f"from {__name__} import serve; serve({self._folder.name!r})"
        )
        environment = dict(os.environ)
        if threads:  # Taichi and OpenMP read these
            environment |= {"TI_CPU_MAX_NUM_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)}
        self._process = subprocess.Popen(
            [sys.executable, "-c", program], stdin=subprocess.PIPE, env=environment
        )
        self._done = 0.0

    @property
    def has_ended(self) -> bool:
        """Whether the process is gone."""
        return self._process.poll() is not None

    @property
    def done(self) -> float:
        """Part of its work that it has told of."""
        with contextlib.suppress(OSError, ValueError):  # nothing yet, or just being written
            self._done = float((self.folder / "told").read_text(encoding="ascii"))
        return self._done

    def answer(self) -> tuple[Any, Exception | None]:
        """Result and error of a process that has ended, which is then forgotten.

        Raises:
            ProcessError: it left none.
        """
        try:
            return pickle.loads((self.folder / "answer").read_bytes())
        except FileNotFoundError:
            raise ProcessError(f"its process {describe_exit(self._process.returncode)}") from None
        finally:
            self.stop()

    def stop(self) -> None:
        """End the process, if it has not ended, and remove what it left."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        self._process.terminate()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        with contextlib.suppress(OSError):
            self._folder.cleanup()


def in_own_process(work: Callable[..., Any], *arguments: Any) -> Any:
    """Result of a function called in a fresh process, which may start processes itself.

    Raises:
        RunError: the process ended without a result.
        Exception: whatever the function raises.
    """
    process = Process(pickle.dumps((work, arguments)))
    try:
        while not process.has_ended:
            time.sleep(POLL)
        result, error = process.answer()
    except ProcessError as killed:
        raise RunError(f"{work.__name__}: {killed}") from None
    finally:
        process.stop()
    if error is not None:
        raise error
    return result
