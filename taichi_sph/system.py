"""The operating system: whole files, locks, threads; each call that not every one has stands here.

Beside each stands what is done where it is missing, so that nothing else needs Linux or POSIX.
"""

import contextlib
import os
import select
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

if sys.platform == "win32":
    import msvcrt
else:
    msvcrt = None
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]


@contextlib.contextmanager
def replaced(path: Path, growing: Path | None = None) -> Iterator[BinaryIO]:
    """File to write that takes the place of `path`, whole and on the disk, when the block ends.

    If the block fails, `path` is as it was.  A device or a pipe is written straight.

    Args:
        path: the file to write or to replace.
        growing: where it is while it grows, in the folder of `path`; a name of its own by default.
            A kill leaves it behind: a name that is known is written over the next time.

    Raises:
        OSError: the disk is full, or the folder is gone.
    """
    if path.exists() and not path.is_file():
        with path.open("wb") as file:
            yield file
        return
    if growing is None:
        unique = f"{os.getpid()}-{os.urandom(4).hex()}"
        growing = path.with_name(f".{path.name}.{unique}.part")
    try:
        # Not `tempfile`, whose files only their owner may read.
        with growing.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(growing, path)
    except BaseException:
        with contextlib.suppress(OSError):
            growing.unlink()
        raise


LOCKED_BYTE = 1 << 40
"""Byte that a lock is on where locks are of bytes (Windows): nobody else may read that one."""


def lock(file: BinaryIO) -> bool:
    """Take an open file for this process, until it is closed; whether nobody else has it.

    A system or a file system without locks locks nothing: True.
    """
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        elif sys.platform == "win32":
            place = file.tell()
            file.seek(LOCKED_BYTE)
            try:
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            finally:
                file.seek(place)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return True
    return True


def processors() -> list[int]:
    """Processors that this process may run on, by number; those of the machine where unknown."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def threads() -> set[int]:
    """Threads of this process by number, which grows; none where Linux' /proc is not."""
    try:
        return {int(name) for name in os.listdir("/proc/self/task")}
    except OSError:
        return set()


def pin(thread: int, processor: int) -> None:
    """Keep a thread of this process on a processor; nothing where that cannot be asked for."""
    if hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(thread, {processor})


def named_pipe() -> tuple[int, int, str] | None:
    """Reading end, writing end and path of a pipe; None where a pipe has no path (Windows)."""
    if not hasattr(select, "poll") or not os.path.isdir("/dev/fd"):
        return None
    source, sink = os.pipe()
    return source, sink, f"/dev/fd/{sink}"


def has_bytes(source: int, patience: int | None) -> bool:
    """Whether bytes are in a `named_pipe`, or come before so long [ms], or it is closed."""
    asked = select.poll()
    asked.register(source, select.POLLIN)
    return bool(asked.poll(patience))


def after_fork(work: Callable[[], None]) -> None:
    """Have a function called in every fork of this process; nothing where there are none."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=work)


def largest_memory() -> float:
    """Largest resident memory of this process so far [bytes]; NaN where nobody keeps it."""
    if resource is None:
        return float("nan")
    unit = 1 if sys.platform == "darwin" else 1024
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * unit
