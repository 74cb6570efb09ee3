"""Files that a scene names, known by their content: whether a run is of the same vessel."""

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
from msgspec import inspect

from taichi_sph.errors import InputError
from taichi_sph.scene import Scene
from taichi_sph.waveform import BUILT_IN

_PIECE = 1 << 20
"""Bytes read at a time."""


def file_hash(path: Path) -> str:
    """SHA-256 of a file; empty of one that cannot be read, which its reader says."""
    found = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while piece := file.read(_PIECE):
                found.update(piece)
    except OSError:
        return ""
    return found.hexdigest()


def _named(table: msgspec.Struct) -> Iterator[tuple[str, str]]:
    """Kind and name of each file that a table names, its own tables included."""
    for field in inspect.type_info(type(table)).fields:  # type: ignore[attr-defined]
        value: Any = getattr(table, field.name)
        extra = (field.type.extra or {}) if isinstance(field.type, inspect.Metadata) else {}
        if "file" in extra and value is not None:
            yield extra["file"], value
        for each in value.values() if isinstance(value, dict) else [value]:
            if isinstance(each, msgspec.Struct):
                yield from _named(each)


def scene_files(scene: Scene) -> dict[str, str]:
    """SHA-256 of every file that a scene names, by kind and name, as "surface lumen.ply"."""
    return {
        f"{kind} {name}": file_hash(Path(scene.folder) / name)
        for kind, name in sorted(set(_named(scene)))
        if not (kind == "waveform" and name in BUILT_IN)
    }


def changed_file(then: dict[str, str], now: dict[str, str]) -> str | None:
    """Kind and name of the first file whose content is another than it was; None of none.

    A file that only one side knows says nothing: hashes were not always kept.
    """
    return next((file for file in then if file in now and then[file] != now[file]), None)


def found_in(scene: Scene, files: dict[str, str], folders: Sequence[Path]) -> Scene:
    """The scene in the folder that has its files with the content that they had.

    Args:
        scene: as it was recorded.
        files: its `scene_files` then.
        folders: where they may be now, the likeliest first.

    Raises:
        InputError: they are nowhere; which one differs, or is not there.
    """
    wrong = ""
    for folder in dict.fromkeys(folders):
        moved = msgspec.structs.replace(scene, folder=str(folder))
        now = scene_files(moved)
        changed = changed_file(files, now)
        if changed is None:
            return moved
        if now[changed]:
            wrong = f"its {changed} differs from what it was ({folder})"
        else:
            wrong = wrong or f"its {changed} is not there ({folder})"
    raise InputError(f"{scene.name}: {wrong}")
