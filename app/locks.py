"""Claims of output files: two runs never write one file.

A claim is a lock of the operating system on a file beside the output, `.NAME.lock`: it ends with
the process, however that ends, and the file goes with it where the process lives to remove it.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from taichi_sph.errors import InputError
from taichi_sph.system import lock


def _is_there_still(file: BinaryIO, path: Path) -> bool:
    """Whether a path is the open file yet, and not another that took its place."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except OSError:
        return False


def _open_claim(path: Path) -> tuple[BinaryIO, Path | None] | None:
    """The file to lock for an output, and its path if it may go afterwards.

    Where nothing can be made beside the output, its own file is locked; None if that neither.
    """
    beside = path.parent / f".{path.name}.lock"
    for claim, disposable in ((beside, beside), (path, None)):
        if disposable is None and not path.is_file():
            break
        with contextlib.suppress(OSError):
            return open(claim, "ab" if disposable else "rb+"), disposable
    return None


@contextlib.contextmanager
def claimed(path: Path | None, option: str) -> Iterator[None]:
    """Keep other runs from writing a file meanwhile.

    Args:
        path: the output, there or not; nothing is done for None, a device or a pipe.
        option: what the message calls it.

    Raises:
        InputError: another run is writing it.
    """
    real = None if path is None else Path(os.path.realpath(path))
    if real is None or (real.exists() and not real.is_file()):
        yield
        return
    while True:
        opened = _open_claim(real)
        if opened is None:
            yield  # a folder of no use: who writes there says so
            return
        file, disposable = opened
        if not lock(file):
            file.close()
            raise InputError(f"{option} {path}: another run is writing it; name another file")
        if disposable is None or _is_there_still(file, disposable):
            break
        file.close()  # it was removed by who held it, between our opening and our lock
    try:
        yield
    finally:
        # Removed while it is locked, so that nobody else can hold a lock on what is gone; Windows
        # removes no open file.
        if disposable is not None and os.name != "nt":
            disposable.unlink(missing_ok=True)
        file.close()
        if disposable is not None and os.name == "nt":
            with contextlib.suppress(OSError):
                disposable.unlink()
