"""Work for jobs, in a module that their processes and workers can import."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from app.jobs.process import report
from taichi_sph.errors import InputError
from taichi_sph.scene import Scene


@dataclass(frozen=True)
class Errand:
    """A job of the tests."""

    number: int
    kind: str = "square"
    notes: Path | None = None
    """Where a job leaves a line, on one machine."""

    def __str__(self) -> str:
        return f"errand {self.number}"


def note(errand: Errand) -> list[str]:
    """Leave a line; all lines so far."""
    assert errand.notes is not None
    with errand.notes.open("a") as file:
        file.write(f"{errand.number} {os.getpid()}\n")
    return errand.notes.read_text().splitlines()


def run_errand(errand: Errand) -> int:
    """Square of the number, or what the kind says."""
    print("something that a library prints")
    os.write(1, b"[and something that C prints\n")
    report(0.5)
    match errand.kind:
        case "refuse":
            raise InputError(f"errand {errand.number}: refused")
        case "die":
            note(errand)
            os.kill(os.getpid(), signal.SIGKILL)
        case "die once":
            if len([line for line in note(errand) if line.startswith(f"{errand.number} ")]) == 1:
                os.kill(os.getpid(), signal.SIGKILL)
        case "exit":
            os._exit(3)
        case "wait":
            note(errand)
            time.sleep(600.0)
        case "slow":
            time.sleep(0.5)
    return errand.number**2


def read_inputs(job: tuple[Scene, Path]) -> tuple[str, str, list[str], str]:
    """What a job sees of its scene and of its file: contents, and where they are."""
    scene, path = job
    here = {path.name for path in Path(scene.folder).iterdir()}
    names = [o.waveform for o in scene.openings.values() if o.waveform in here]
    contents = (Path(scene.folder) / scene.vessel.surface).read_text()
    waves = [(Path(scene.folder) / name).read_text() for name in names if name is not None]
    return contents, path.read_text(), waves, scene.folder
