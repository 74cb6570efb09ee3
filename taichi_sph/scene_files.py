"""Files that a scene names, by their content: to send, keep and compare them wherever they lie."""

import hashlib
from pathlib import Path
from typing import Any

import msgspec

from taichi_sph.errors import InputError
from taichi_sph.scene import Scene
from taichi_sph.waveform import BUILT_IN


def file_names(scene: Scene) -> list[str]:
    """Names of the files that a scene needs, as written there: surfaces and waveforms."""
    waveforms = [opening.waveform for opening in scene.openings.values()]
    names = [scene.vessel.surface]
    if scene.tool is not None:
        names.append(scene.tool.surface)
    if scene.wall is not None:
        waveforms.append(scene.wall.waveform)
    names += [name for name in waveforms if name is not None and name not in BUILT_IN]
    return list(dict.fromkeys(names))


def read_files(scene: Scene) -> dict[str, bytes]:
    """Contents of the files that a scene needs, by name.

    Raises:
        InputError: one cannot be read.
    """
    contents = {}
    for name in file_names(scene):
        path = Path(scene.folder) / name
        try:
            contents[name] = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return contents


def sha256(content: bytes) -> str:
    """SHA-256 of a file's content, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


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
    change = msgspec.structs.replace

    def moved(table: Any, field: str) -> Any:
        name = getattr(table, field)
        return change(table, **{field: here.get(name, name)})

    return change(
        scene,
        folder=str(folder),
        vessel=moved(scene.vessel, "surface"),
        openings={name: moved(table, "waveform") for name, table in scene.openings.items()},
        tool=scene.tool and moved(scene.tool, "surface"),
        wall=scene.wall and moved(scene.wall, "waveform"),
    )
