"""Files that a scene names, by their content: to send, keep and compare them wherever they lie."""

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


def _file_kind(field: Any) -> str | None:
    """What a field names a file of, as "surface"; None if it names none."""
    extra = (field.type.extra or {}) if isinstance(field.type, inspect.Metadata) else {}
    return extra.get("file")


def _named(table: msgspec.Struct) -> Iterator[tuple[str, str]]:
    """Kind and name of each file that a table names, its own tables included."""
    for field in inspect.type_info(type(table)).fields:  # type: ignore[attr-defined]
        value: Any = getattr(table, field.name)
        kind = _file_kind(field)
        if kind is not None and value is not None:
            yield kind, value
        for each in value.values() if isinstance(value, dict) else [value]:
            if isinstance(each, msgspec.Struct):
                yield from _named(each)


def named_files(scene: Scene) -> list[tuple[str, str]]:
    """Kind and name of each file that a scene needs, as "surface" and "lumen.ply"."""
    return [
        (kind, name)
        for kind, name in sorted(set(_named(scene)))
        if not (kind == "waveform" and name in BUILT_IN)
    ]


def scene_files(scene: Scene) -> dict[str, str]:
    """SHA-256 of every file that a scene names, by kind and name, as "surface lumen.ply"."""
    return {
        f"{kind} {name}": file_hash(Path(scene.folder) / name) for kind, name in named_files(scene)
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


def sha256(content: bytes) -> str:
    """SHA-256 of a file's content, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def read_files(scene: Scene) -> dict[str, bytes]:
    """Contents of the files that a scene needs, by name.

    Raises:
        InputError: one cannot be read.
    """
    contents = {}
    for name in dict.fromkeys(name for _, name in named_files(scene)):
        path = Path(scene.folder) / name
        try:
            contents[name] = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return contents


def with_files(scene: Scene, contents: dict[str, bytes], folder: Path) -> Scene:
    """Scene whose files are written into a folder, and which names them there.

    Args:
        scene: the scene; its own folder is not looked at.
        contents: contents by name, of every file that the scene needs.
        folder: an empty folder.
    """
    here = {}
    for number, (name, content) in enumerate(contents.items()):
        # Names may hold folders, or be alike but for them; the ending says what a file is.
        here[name] = f"{number}-{name.replace(chr(92), '/').rpartition('/')[2]}"
        (folder / here[name]).write_bytes(content)
    moved = _renamed(scene, here)
    assert isinstance(moved, Scene)
    return msgspec.structs.replace(moved, folder=str(folder))


def _renamed(table: msgspec.Struct, names: dict[str, str]) -> msgspec.Struct:
    """A table that names its files otherwise, its own tables included."""
    changes: dict[str, Any] = {}
    for field in inspect.type_info(type(table)).fields:  # type: ignore[attr-defined]
        value: Any = getattr(table, field.name)
        if _file_kind(field) is not None:
            changes[field.name] = names.get(value, value)
        elif isinstance(value, msgspec.Struct):
            changes[field.name] = _renamed(value, names)
        elif isinstance(value, dict):
            changes[field.name] = {
                key: _renamed(each, names) if isinstance(each, msgspec.Struct) else each
                for key, each in value.items()
            }
    return msgspec.structs.replace(table, **changes)
