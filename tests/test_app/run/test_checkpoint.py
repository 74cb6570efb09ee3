import json
import random
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from app.cli import invoke
from app.run.checkpoint import Checkpoint, Checkpointer, difference
from app.run.options import RunOptions
from app.run_scene import facts_of
from app.scenes.library import find_scene, shipped
from commands import HERE, vesselflow
from taichi_sph.errors import InputError
from taichi_sph.state import State


def same(a: Path, b: Path) -> bool:
    """Whether two checkpoints hold bitwise the same state at the same frame."""
    one, other = Checkpoint.read(a), Checkpoint.read(b)
    return (
        one.frame == other.frame
        and one.state.time == other.state.time
        and one.state.steps == other.state.steps
        and one.state.particles.keys() == other.state.particles.keys()
        and all(
            rows.tobytes() == other.state.particles[name].tobytes()
            for name, rows in one.state.particles.items()
        )
        and (removed(one) == removed(other)).all()
    )


def removed(checkpoint: Checkpoint) -> np.ndarray:
    return np.asarray(checkpoint.state.boundaries["outlets"]["removed"])


def arguments(box: Path, model: str, frames: int) -> list[str]:
    return [
        "run", str(box), "--model", model, "--frames", str(frames), "--checkpoint", "1",
        "--height", "0.016",
    ]  # fmt: skip


@pytest.fixture(scope="module")
def whole(box: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The last checkpoint of an uninterrupted run by a model."""

    @cache
    def end(model: str) -> Path:
        folder = tmp_path_factory.mktemp(model)
        vesselflow(folder, *arguments(box, model, 12))
        return folder / f"{box.name}.checkpoint.npz"

    return end


def run_here(folder: Path, monkeypatch: pytest.MonkeyPatch, *command: str) -> Path:
    """The checkpoint of a run in this process, in a folder."""
    folder.mkdir(exist_ok=True)
    with monkeypatch.context() as there:
        there.chdir(folder)
        assert invoke(command) == ("", 0)
    return next(folder.glob("*.checkpoint.npz"))


@pytest.mark.validation
@pytest.mark.parametrize("model", ["physics", "pcnet", "implicit"])
def test_a_resumed_run_ends_bitwise_like_one_that_was_not_interrupted(
    box: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    whole = run_here(tmp_path / "whole", monkeypatch, *arguments(box, model, 4))
    half = run_here(tmp_path / "half", monkeypatch, *arguments(box, model, 2))
    assert Checkpoint.read(half).frame == 2
    assert not same(half, whole)
    run_here(half.parent, monkeypatch, *arguments(box, model, 4), "--resume", str(half))
    assert same(half, whole)


@pytest.mark.validation
def test_a_run_killed_at_any_moment_goes_on(
    box: Path, whole: Callable[[str], Path], tmp_path: Path
) -> None:
    kept = tmp_path / f"{box.name}.checkpoint.npz"
    generator = random.Random(1)
    command = [sys.executable, "-m", "app", *arguments(box, "physics", 12)]
    kills = 0
    for _ in range(3):
        more = ["--resume", str(kept)] if kept.exists() else []
        run = subprocess.Popen(
            command + more, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env=HERE,
        )  # fmt: skip
        begun = kept.stat().st_mtime_ns if kept.exists() else 0
        until = time.monotonic() + 60.0
        while run.poll() is None and time.monotonic() < until:
            if kept.exists() and kept.stat().st_mtime_ns > begun:
                break  # it has written since: now any moment will do
            time.sleep(0.002)
        time.sleep(0.02 * generator.random())
        if run.poll() is None:
            run.kill()
            kills += 1
        run.wait()
        Checkpoint.read(kept)
    assert kills >= 1
    vesselflow(tmp_path, *arguments(box, "physics", 12), "--resume", kept)
    assert same(kept, whole("physics"))
    assert [file.name for file in tmp_path.iterdir() if file.suffix == ".lock"] == []


SEEN = "--height", "0.016", "--frames", "13"


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """A checkpoint of the shipped box, with particles at random."""
    given: Any = dict.fromkeys(("last_step", "fallback_time", "steps", "wall_corrections"), 0)
    rows = np.random.default_rng(1).normal(size=(500, 3))
    state = State(
        time=0.1, **given, model="physics", gravity=(0.0, 0.0, -9.81),
        boundaries={"outlets": {"removed": np.arange(2)}},
        particles={"identity": np.arange(500), "position": rows},
    )  # fmt: skip
    facts = facts_of(RunOptions("box", height=0.016), find_scene("box"))
    Checkpoint(facts, 5, state).write(tmp_path / "kept.npz")
    return tmp_path / "kept.npz"


def refusal(*command: object) -> str:
    """What is said of a run that is refused before it starts."""
    message, code = invoke(["run", *map(str, command)])
    assert code == 2
    return message


def test_a_cut_damaged_or_foreign_file_is_one_sentence(kept: Path, tmp_path: Path) -> None:
    content = kept.read_bytes()
    rows = Checkpoint.read(kept).state.particles["position"].tobytes()
    middle = bytearray(content)
    middle[content.index(rows) + len(rows) // 2] ^= 0xFF
    for name, some in {
        "cut": content[: len(content) // 2], "damaged": bytes(middle), "empty": b"",
        "text": b"no checkpoint",
    }.items():  # fmt: skip
        path = tmp_path / name
        path.write_bytes(some)
        with pytest.raises(InputError, match=rf"--resume .*{name}: not a whole checkpoint"):
            Checkpoint.read(path)
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(InputError, match="not a whole checkpoint"):
        Checkpoint.read(tmp_path / "other.npz")
    with pytest.raises(InputError, match="there is no such file"):
        Checkpoint.read(tmp_path / "none")


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (["--height", "0.012"], "its height differs: 0.016 there, 0.012 here"),
        (["--model", "implicit"], "its model differs: physics there, implicit here"),
        (["--seed", "3"], "its seed differs: 0 there, 3 here"),
    ],
)
def test_another_run_is_not_gone_on_with(kept: Path, changed: list[str], expected: str) -> None:
    assert expected in refusal("box", *SEEN, *changed, "--resume", kept)


def test_a_run_whose_surface_has_changed_is_not_gone_on_with(kept: Path, tmp_path: Path) -> None:
    moved, shipped_box = tmp_path / "elsewhere" / "box", shipped()["box"].parent
    moved.mkdir(parents=True)
    for file in ("scene.toml", "lumen.ply"):
        (moved / file).write_bytes((shipped_box / file).read_bytes())
    here = facts_of(RunOptions(str(moved), height=0.016), find_scene(str(moved)))
    assert difference(Checkpoint.read(kept).facts, here) is None, "it may lie elsewhere"
    with (moved / "lumen.ply").open("ab") as surface:
        surface.write(b"\n")
    assert "is of another run, its surface lumen.ply differs" in refusal(
        moved, *SEEN, "--resume", kept
    )


FACTS: dict[str, Any] = {
    "scene": "pump", "scene_text": "title = 1", "seed": 0,
    "files": {"surface lumen.ply": "a", "waveform beat.csv": "b", "weights": "c"},
}  # fmt: skip


@pytest.mark.parametrize("file", sorted(FACTS["files"]))
def test_a_file_that_has_changed_is_named(file: str) -> None:
    assert difference(FACTS, FACTS) is None
    changed = FACTS | {"files": FACTS["files"] | {file: "d"}}
    assert difference(FACTS, changed) == f"{file} differs"
    gone = FACTS | {"files": FACTS["files"] | {file: ""}}
    assert difference(FACTS, gone) == f"{file} is not there"
    unknown = FACTS | {"files": {name: x for name, x in FACTS["files"].items() if name != file}}
    assert difference(unknown, FACTS) is None


@pytest.mark.parametrize("number", [2, 3])
def test_a_checkpoint_of_a_format_before_is_read(number: int, tmp_path: Path) -> None:
    controls = {
        "model": "pcnet", "gravity": [0.0, 0.0, -9.81], "wounds": [], "wall": [0.5, 0.1],
        "added": 4, "next_identity": 504, "pistons": [[1.0, 1.0, 0.2, 0.0, 0.0, 4]],
        "suction": [1e-6, 1e-3, 0.0, 0.1],
        "tool": [[0.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.0]] * 2 + [[0.0] * 3] * 2,
    }  # fmt: skip
    numbers = {"time": 0.1, "last_step": 1e-4, "fallback_time": 0.0, "steps": 9,
               "wall_corrections": 0, "controls": controls}  # fmt: skip
    facts: dict[str, Any] = {"scene": "pump", "seed": 0}
    facts |= {"weights": "c"} if number == 2 else {"files": FACTS["files"]}
    head = {"format": f"vesselflow checkpoint {number}", "facts": facts, "frame": 7,
            "numbers": numbers}  # fmt: skip
    position = np.random.default_rng(1).normal(size=(20, 3))
    np.savez(tmp_path / "old.npz", head=np.array(json.dumps(head)), position=position,
             removed=np.array([3, 1]))  # fmt: skip
    old = Checkpoint.read(tmp_path / "old.npz")
    assert (old.frame, old.state.model, old.state.steps) == (7, "pcnet", 9)
    assert (old.state.particles["position"] == position).all()
    assert old.state.boundaries["inflow"]["next_identity"] == 504
    assert old.state.boundaries["wall_motion"] == {"displacement_factor": 0.5, "rate": 0.1}
    known = {"scene": "pump", "seed": 0, "files": FACTS["files"]}
    assert difference(old.facts, known) is None
    other = known | {"files": FACTS["files"] | {"weights": "d"}}
    assert difference(old.facts, other) == "weights differs"


def test_a_recording_of_the_run_so_far_is_not_replaced(kept: Path, tmp_path: Path) -> None:
    recording = tmp_path / "a.rrd"
    recording.write_bytes(b"RRF2....")
    said = refusal("box", *SEEN, "--resume", kept, "--rrd", recording)
    assert "holds the run so far" in said
    assert recording.read_bytes() == b"RRF2...."


def test_a_checkpoint_that_cannot_be_written_is_named(kept: Path) -> None:
    state = Checkpoint.read(kept).state
    simulation: Any = SimpleNamespace(save_state=lambda: state)
    figures: Any = None
    writer = Checkpointer(Path("/no/such/folder/a.npz"), 1, {})
    with pytest.raises(OSError, match=r"^/no/such/folder/a.npz: the checkpoint cannot be written"):
        writer.on_frame(simulation, 3, figures)
