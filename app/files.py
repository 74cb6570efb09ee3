"""Files that a run leaves: checked before the slow part, written whole or not at all."""

import csv
import importlib.util
import io
import json
import math
import sys
import tempfile
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TextIO, TypeVar

import msgspec
from rich.console import Console
from rich.table import Table

from taichi_sph.errors import InputError
from taichi_sph.system import replaced


def require_matplotlib(option: str) -> None:
    """Refuse an option that draws where nothing can."""
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError(f"{option}: matplotlib is not installed; pip install 'vesselflow[plot]'")


def check_plots(folder: Path) -> None:
    """Make a folder for pictures.

    Raises:
        InputError: it cannot be made, or nothing can be drawn.
    """
    require_matplotlib(f"--plot {folder}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--plot {folder}: cannot be made: {error.strerror}") from None


def check_output(path: Path, option: str, begins: bytes) -> None:
    """Refuse an output path that cannot be written, or that holds something else.

    Args:
        path: where the file is to be.
        option: what the message calls it.
        begins: first bytes of a file of this kind; only such a one, or an empty one, is replaced.

    Raises:
        InputError: the path is of no use.
    """
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; give a file")
    if not path.parent.is_dir():
        raise InputError(f"{option} {path}: the folder {path.parent} does not exist")
    try:
        if path.is_file():
            with path.open("rb+") as file:
                first = file.read(len(begins))
            if first and first != begins:
                raise InputError(
                    f"{option} {path}: the file exists and is something else; name another"
                )
        elif not path.exists():
            with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}."):
                pass
    except OSError as error:
        raise InputError(f"{option} {path}: cannot be written: {error.strerror}") from None


def check_json(path: Path, option: str, keys: Iterable[str]) -> None:
    """Refuse an output path that cannot be written, or holds other JSON than the keys are of.

    Args:
        path: where the file is to be.
        option: what the message calls it.
        keys: that every such file has had.

    Raises:
        InputError: the path is of no use.
    """
    check_output(path, option, b"{")
    if not path.is_file() or not path.stat().st_size:
        return
    try:
        found = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        found = {}
    if not set(keys) <= found.keys():
        raise InputError(f"{option} {path}: the file exists and is something else; name another")


def _plain(value: Any) -> Any:
    """A value with null for every number that JSON does not know."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write a JSON file so that it is either the old one or the whole new one.

    Raises:
        OSError: the disk is full, or the folder is gone.
    """
    write_text(path, json.dumps(_plain(value), indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file, as `write_bytes`."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that it is either the old one or the whole new one.

    Raises:
        OSError: the disk is full, or the folder is gone.
    """
    with replaced(path) as file:
        file.write(content)


RowType = TypeVar("RowType")


def read_rows(path: Path, row: type[RowType]) -> list[RowType]:
    """Rows of a CSV file as a dataclass of strings and numbers; none of a file that is not there.

    Raises:
        InputError: it holds something else.
    """
    if not path.exists() or not path.stat().st_size:
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [msgspec.convert(line, row, strict=False) for line in csv.DictReader(file)]
    except (msgspec.ValidationError, UnicodeDecodeError, csv.Error):
        raise InputError(f"{path}: holds something else, or is cut; name another") from None


def write_rows(path: Path, rows: Sequence[Any]) -> None:
    """Write dataclasses of one kind as CSV, whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [c.name for c in fields(rows[0])], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    write_text(path, text.getvalue())


def table(title: str, *headings: str, left: Collection[str] = ()) -> Table:
    """A table whose first column, and those in `left`, are aligned left, the others right."""
    found = Table(title=title)
    for k, heading in enumerate(headings):
        found.add_column(heading, justify="left" if k == 0 or heading in left else "right")
    return found


def percent(value: float, digits: int = 1) -> str:
    """A fraction for people, in per cent; a dash where there is none."""
    return f"{100.0 * value:.{digits}f} %" if math.isfinite(value) else "-"


def console(file: TextIO | None = None) -> Console:
    """A terminal, stdout by default; wide where it is none, so that nothing is cut.

    What it prints is never markup: a title or a path may have brackets and colons.
    """
    width = None if (file or sys.stdout).isatty() else 160
    return Console(file=file, width=width, markup=False, emoji=False)
