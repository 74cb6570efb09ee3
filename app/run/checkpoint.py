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
from taichi_sph.state import State

if TYPE_CHECKING:
    from taichi_sph.diagnostics import Diagnostics
    from taichi_sph.simulation import Simulation

FORMAT = "vesselflow checkpoint 4"
WITH_CONTROLS = "vesselflow checkpoint 3"
"""The format before: what boundaries keep is a few lists, see `_state_with_controls`."""
WITHOUT_FILES = "vesselflow checkpoint 2"
"""The format before that: its facts know of no file but the weights by content."""
ARRAY = "array"
"""Stands in a boundary's state for an array that the file has under the same name."""


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
        numbers = dict(vars(self.state))
        arrays: dict[str, Any] = dict(numbers.pop("particles"))
        head = {
            "format": FORMAT, "facts": self.facts, "frame": self.frame, "quantities": list(arrays),
            "numbers": numbers,
        }  # fmt: skip
        numbers["boundaries"] = _without_arrays(self.state.boundaries, arrays)
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
                if head["format"] not in (FORMAT, WITH_CONTROLS, WITHOUT_FILES):
                    raise KeyError("format")
                arrays = {name: file[name] for name in file.files if name != "head"}
            facts = head["facts"]
            if head["format"] == WITHOUT_FILES:
                facts["files"] = {"weights": facts.pop("weights")} if "weights" in facts else {}
            if head["format"] == FORMAT:
                state = _state(head["numbers"], head["quantities"], arrays)
            else:
                state = _state_with_controls(head["numbers"], arrays)
            return cls(facts, head["frame"], state)
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


def _without_arrays(
    boundaries: dict[str, dict[str, Any]], arrays: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """What JSON can hold of the boundaries' states; the rest goes to `arrays`, under its name."""
    kept = {}
    for boundary, saved in boundaries.items():
        own = {name: value for name, value in saved.items() if isinstance(value, np.ndarray)}
        assert not own.keys() & arrays.keys(), f"{boundary}: an array's name is taken"
        arrays.update(own)
        kept[boundary] = {**saved, **dict.fromkeys(own, ARRAY)}
    return kept


def _state(numbers: dict[str, Any], quantities: list[str], arrays: dict[str, Any]) -> State:
    boundaries = {
        boundary: {name: arrays[name] if v == ARRAY else v for name, v in saved.items()}
        for boundary, saved in numbers.pop("boundaries").items()
    }
    x, y, z = numbers.pop("gravity")
    particles = {name: arrays[name] for name in quantities}
    return State(**numbers, gravity=(x, y, z), boundaries=boundaries, particles=particles)


def _state_with_controls(numbers: dict[str, Any], arrays: dict[str, Any]) -> State:
    """A state as it was kept while boundaries had no names of their own."""
    controls = numbers.pop("controls")
    opening = ("target_factor", "factor", "speed", "displacement", "volume_in", "emitted")
    tool = (
        "position", "rotation", "target_position", "target_rotation", "velocity", "spin",
    )  # fmt: skip
    suction = ("rate", "radius", "backlog", "taken_until")
    boundaries = {
        "outlets": {"removed": arrays.pop("removed")},
        "tool": dict(zip(tool, controls["tool"], strict=True)),
        "suction": dict(zip(suction, controls["suction"], strict=True)),
        "inflow": {
            "added": controls["added"],
            "next_identity": controls["next_identity"],
            "openings": [dict(zip(opening, row, strict=True)) for row in controls["pistons"]],
        },
        "wounds": {"wounds": controls["wounds"]},
    }
    factor, rate = controls["wall"]
    if factor or rate:  # else it stands as at the start, if it moves at all
        boundaries["wall_motion"] = {"displacement_factor": factor, "rate": rate}
    x, y, z = controls["gravity"]
    return State(
        **numbers, model=controls["model"], gravity=(x, y, z), boundaries=boundaries,
        particles=arrays,
    )  # fmt: skip


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
