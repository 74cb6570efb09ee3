"""Start Taichi: the only call of `ti.init` in the repository."""

import atexit
import contextlib
import ctypes
import os
import shutil
import tempfile
import threading
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import taichi as ti

from taichi_sph.errors import InputError, RunError
from taichi_sph.system import after_fork, pin, processors
from taichi_sph.system import threads as known_threads

ARCHITECTURES = ("cpu", "gpu")
PRECISIONS = {"f32": ti.f32, "f64": ti.f64}
LONGEST_LOCK = 15.0
"""Taichi holds the lock of its compiled kernels for a moment; older [s], nobody holds it."""


@dataclass(frozen=True)
class _Started:
    """The last `start`: fields live from one to the next, in its process."""

    number: int
    process: int
    thread: int


_started: _Started | None = None


def runtime_number() -> int:
    """Number of the last `start`, for whoever makes fields; they must be made in its thread.

    Raises:
        RunError: Taichi was not started, or in another process or thread.
    """
    if _started is None:
        raise RunError("call taichi_sph.start() first: nothing can be computed before it")
    require_runtime(_started.number)
    if threading.get_ident() != _started.thread:
        raise RunError(
            "start() was called in another thread: make simulations and models in the thread that "
            "called start(); they may be run in any"
        )
    return _started.number


def require_runtime(number: int) -> None:
    """Refuse fields that were made after another `start`, or before this process was forked.

    Taichi would read freed memory, or wait for ever for threads that a fork does not copy.

    Raises:
        RunError: why they are of no use here.
    """
    if _started is None or number != _started.number:
        raise RunError(
            "this simulation was made before the last start(), which freed its fields; make it "
            "again after start()"
        )
    if os.getpid() != _started.process:
        raise RunError(
            "this process was forked after start(), and Taichi's threads were not copied; fork "
            "before start(), or use multiprocessing's method 'spawn'"
        )


def finish_fields() -> None:
    """Give all fields that were made their memory, which only the thread of `start` can do."""
    ti.sync()


def _abandon_fork() -> None:
    """Leave Taichi in memory in a fork: its end would wait for threads that are not there."""
    if _started is not None:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(ti.lang.impl.get_runtime().prog))


after_fork(_abandon_fork)


def float_dtype() -> type[np.floating]:
    """The numpy type of a kernel's `float`."""
    return np.float32 if ti.cfg.default_fp == ti.f32 else np.float64


def _pin(workers: list[int]) -> None:
    """Give each of Taichi's threads, the last that it makes, a processor of its own.

    Left alone, Linux often wakes one behind another on the same processor and moves it only after a
    millisecond, longer than a pass over 16 000 particles: two cores are then no faster than one.
    Only where every processor gets a thread: programs with fewer would all sit on the first.
    """
    available = processors()
    if not workers or len(workers) != len(available):
        return
    for worker, processor in zip(workers, available, strict=True):
        pin(worker, processor)


def _can_write(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made if it is not there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _remove_stale_lock(lock: Path) -> None:
    """Remove the lock that a process has left which was killed while it wrote kernels.

    With it there Taichi neither reads nor writes the folder any more: every start compiles all
    anew, some seconds, without a word.
    """
    with contextlib.suppress(OSError):
        if time.time() - lock.stat().st_mtime > LONGEST_LOCK:
            lock.unlink()


def _kernel_cache() -> str | None:
    """Folder for compiled kernels where Taichi's own cannot be written; None where it can.

    Without a folder that it can write Taichi dies of a segmentation fault at the process' end.

    Raises:
        InputError: as `_temporary_cache`.
    """
    asked = os.environ.get("TI_OFFLINE_CACHE_FILE_PATH")
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(asked) if asked else Path(base, "taichi", "ticache")
    if _can_write(folder):
        _remove_stale_lock(folder / "ticache.lock")
        return None
    # Taichi would warn of an argument that is not what the variable says.
    os.environ.pop("TI_OFFLINE_CACHE_FILE_PATH", None)
    return _temporary_cache()


@cache
def _temporary_cache() -> str:
    """A folder for compiled kernels that goes with the process.

    Raises:
        InputError: nothing can be written anywhere.
    """
    try:
        folder = tempfile.mkdtemp(prefix="vesselflow-kernels-")
    except OSError as error:
        raise InputError(
            "no folder can be written for compiled kernels; let TI_OFFLINE_CACHE_FILE_PATH name "
            f"one ({error.strerror})"
        ) from None
    atexit.register(_leave, folder, os.getpid())
    return folder


def _leave(folder: str, process: int) -> None:
    """End Taichi, which writes its kernels then, and remove them; a fork leaves them alone."""
    if os.getpid() == process:
        ti.reset()
        shutil.rmtree(folder, ignore_errors=True)


def start(
    arch: str = "cpu",
    precision: str = "f32",
    threads: int | None = None,
    debug: bool = False,
    random_seed: int = 0,
) -> None:
    """Start Taichi once per process; fields made before are lost.

    Args:
        arch: "cpu", or "gpu" for CUDA or Metal (Vulkan without a driver crashes).
        precision: "f32" or "f64", the type of every `float` in a kernel.
        threads: CPU threads; all by default.
        debug: check bounds of every field access (slow).
        random_seed: seed of Taichi's own generator.

    Raises:
        InputError: an unknown architecture or precision, no GPU, or no folder for kernels.
        RunError: this process was forked after Taichi was started.
    """
    global _started
    if arch not in ARCHITECTURES:
        raise InputError(f"--arch {arch}: allowed are {', '.join(ARCHITECTURES)}")
    if precision not in PRECISIONS:
        raise InputError(f"--precision {precision}: allowed are {', '.join(PRECISIONS)}")
    if _started is not None:
        require_runtime(_started.number)
    number = _started.number + 1 if _started is not None else 1
    options: dict[str, Any] = {"cpu_max_num_threads": threads} if threads else {}
    folder = _kernel_cache()
    if folder is not None:
        options["offline_cache_file_path"] = folder
    others = known_threads()
    with contextlib.redirect_stdout(None):  # it prints a line whatever its log level
        ti.init(
            arch=[ti.cuda, ti.metal] if arch == "gpu" else ti.cpu,
            default_fp=PRECISIONS[precision],
            default_ip=ti.i32,
            # Halves the cost of the sums (square roots, quotients).  It lets the compiler assume
            # that nothing is NaN, so `integrator.is_finite` looks at the bits.
            fast_math=True,
            debug=debug,
            short_circuit_operators=True,
            random_seed=random_seed,
            log_level=ti.ERROR,
            offline_cache=True,
            **options,
        )
    _started = _Started(number, os.getpid(), threading.get_ident())
    if arch == "cpu":
        _pin(sorted(known_threads() - others)[-ti.cfg.cpu_max_num_threads :])
    if arch == "gpu" and ti.cfg.arch in (ti.x64, ti.arm64):
        raise InputError("--arch gpu: no CUDA or Metal device was found; use --arch cpu")


def has_wide_atomics() -> bool:
    """Whether the device sums 64-bit integers: Taichi's Metal does not."""
    return bool(ti.cfg.arch != ti.metal)
