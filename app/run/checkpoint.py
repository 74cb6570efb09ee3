"""Checkpoints: the whole state of a run in one file, so that a run killed at any moment can go on.

The file is numpy's zip of arrays, written whole or not at all; zip keeps a checksum of each.
"""

import io
import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from app.files import write_bytes
from taichi_sph.errors import InputError
from taichi_sph.scene_files import changed_file
from taichi_sph.simulation import State

if TYPE_CHECKING:
    from taichi_sph.diagnostics import Diagnostics
    from taichi_sph.simulation import Simulation

FORMAT = "vesselflow checkpoint 3"
WITHOUT_FILES = "vesselflow checkpoint 2"
"""The format before: its facts know of no file but the weights by content."""


@dataclass(frozen=True)
class Checkpoint:
    """Where a run stands."""

    facts: dict[str, Any]
    """What the run is of; another run cannot go on from here."""
    frame: int
    state: State

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all.

        Raises:
            OSError: the disk is full, or the folder is gone.
        """
        state = vars(self.state)
        arrays: dict[str, Any] = {k: v for k, v in state.items() if isinstance(v, np.ndarray)}
        numbers = {name: value for name, value in state.items() if name not in arrays}
        head = {"format": FORMAT, "facts": self.facts, "frame": self.frame, "numbers": numbers}
        content = io.BytesIO()
        np.savez(content, head=np.array(json.dumps(head)), **arrays)
        write_bytes(path, content.getvalue())

    @classmethod
    def read(cls, path: Path) -> "Checkpoint":
        """Read a file.

        Raises:
            InputError: it cannot be read, is cut or damaged, or is no checkpoint.
        """
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
                head = json.loads(str(file["head"]))
                if head["format"] not in (FORMAT, WITHOUT_FILES):
                    raise KeyError("format")
                arrays = {name: file[name] for name in file.files if name != "head"}
            facts = head["facts"]
            if head["format"] == WITHOUT_FILES:
                facts["files"] = {"weights": facts.pop("weights")} if "weights" in facts else {}
            return cls(facts, head["frame"], State(**head["numbers"], **arrays))
        except FileNotFoundError:
            raise InputError(f"--resume {path}: there is no such file") from None
        except (
            OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error,
        ):  # fmt: skip
            raise InputError(
                f"--resume {path}: not a whole checkpoint; `vesselflow run --checkpoint` writes one"
            ) from None

    def require(self, facts: dict[str, Any], path: Path) -> None:
        """Refuse to go on with another run.

        Raises:
            InputError: which fact differs.
        """
        different = difference(self.facts, facts)
        if different is not None:
            raise InputError(
                f"--resume {path}: is of another run, its {different}; give the command that "
                "wrote it, and the files that it read"
            )


def difference(then: dict[str, Any], now: dict[str, Any]) -> str | None:
    """What differs between the facts of two runs, as a clause; None if it is the same run.

    The files that the scene names are compared by content where both sides know it.
    """
    for name, wanted in now.items():
        found = then.get(name)
        if name == "files":
            changed = changed_file(found or {}, wanted)
            if changed is not None:
                return f"{changed} differs" if wanted[changed] else f"{changed} is not there"
        elif found != wanted:
            plain = name not in ("scene_text", "script")
            values = f": {found} there, {wanted} here" if plain else ""
            return f"{name.replace('_', ' ')} differs{values}"
    return None


class Checkpointer:
    """Writes a checkpoint every so many frames."""

    def __init__(self, path: Path, every: int, facts: dict[str, Any]):
        """`facts` say what the run is of."""
        self.path, self.every, self.facts = path, every, facts

    def on_frame(self, simulation: "Simulation", frame: int, figures: "Diagnostics") -> None:
        """Write one if it is time.

        Raises:
            OSError: it cannot be written; the one before is still there.
        """
        if frame % self.every == 0:
            try:
                Checkpoint(self.facts, frame, simulation.save_state()).write(self.path)
            except OSError as error:
                raise OSError(
                    f"{self.path}: the checkpoint cannot be written: {error.strerror}"
                ) from None

    def close(self, ending: str) -> None:
        """Nothing: the last checkpoint stays."""
