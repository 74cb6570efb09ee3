import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from app.run.checkpoint import Checkpoint, Checkpointer, difference
from commands import HERE, vesselflow
from taichi_sph.errors import InputError


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
def whole(box: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The last checkpoint of an uninterrupted run by each model."""
    ends = {}
    for model in ("physics", "implicit", "pcnet"):
        folder = tmp_path_factory.mktemp(model)
        vesselflow(folder, *arguments(box, model, 12))
        ends[model] = folder / f"{box.name}.checkpoint.npz"
    return ends


@pytest.mark.parametrize("model", ["physics", "implicit", "pcnet"])
def test_a_resumed_run_ends_bitwise_like_one_that_was_not_interrupted(
    box: Path, whole: dict[str, Path], tmp_path: Path, model: str
) -> None:
    vesselflow(tmp_path, *arguments(box, model, 5))
    half = tmp_path / f"{box.name}.checkpoint.npz"
    assert Checkpoint.read(half).frame == 5
    assert not same(half, whole[model])
    vesselflow(tmp_path, *arguments(box, model, 12), "--resume", half)
    assert same(half, whole[model])


def test_a_run_killed_at_any_moment_goes_on(
    box: Path, whole: dict[str, Path], tmp_path: Path
) -> None:
    kept = tmp_path / f"{box.name}.checkpoint.npz"
    generator = random.Random(1)
    command = [sys.executable, "-m", "app", *arguments(box, "physics", 12)]
    kills = 0
    for _ in range(10):
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
            run.send_signal(signal.SIGKILL)
            kills += 1
        run.wait()
        Checkpoint.read(kept)
    assert kills >= 3
    vesselflow(tmp_path, *arguments(box, "physics", 12), "--resume", kept)
    assert same(kept, whole["physics"])


def test_a_cut_damaged_or_foreign_file_is_one_sentence(
    whole: dict[str, Path], tmp_path: Path
) -> None:
    content = whole["physics"].read_bytes()
    middle = bytearray(content)
    middle[len(middle) // 2] ^= 0xFF
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
def test_another_run_is_not_gone_on_with(
    box: Path, whole: dict[str, Path], changed: list[str], expected: str
) -> None:
    command = ["run", str(box), "--height", "0.016", "--frames", "13", *changed]
    assert expected in vesselflow(Path.cwd(), *command, "--resume", whole["physics"], code=2)


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


def test_a_checkpoint_of_the_format_before_is_read(whole: dict[str, Path], tmp_path: Path) -> None:
    with np.load(whole["pcnet"]) as file:
        arrays = dict(file)
    head = json.loads(str(arrays.pop("head")))
    weights = head["facts"].pop("files")["weights"]
    head["facts"]["weights"] = weights
    head["format"] = "vesselflow checkpoint 2"
    np.savez(tmp_path / "old.npz", head=np.array(json.dumps(head)), **arrays)
    old, new = Checkpoint.read(tmp_path / "old.npz"), Checkpoint.read(whole["pcnet"])
    assert difference(old.facts, new.facts) is None
    assert old.facts["files"] == {"weights": weights}
    assert same(tmp_path / "old.npz", whole["pcnet"])


def test_a_recording_of_the_run_so_far_is_not_replaced(
    box: Path, whole: dict[str, Path], tmp_path: Path
) -> None:
    recording = tmp_path / "a.rrd"
    recording.write_bytes(b"RRF2....")
    command = [*arguments(box, "physics", 13), "--resume", whole["physics"], "--rrd", recording]
    assert "holds the run so far" in vesselflow(tmp_path, *command, code=2)
    assert recording.read_bytes() == b"RRF2...."


def test_a_checkpoint_that_cannot_be_written_is_named(whole: dict[str, Path]) -> None:
    kept = Checkpoint.read(whole["physics"])
    simulation: Any = SimpleNamespace(save_state=lambda: kept.state)
    figures: Any = None
    writer = Checkpointer(Path("/no/such/folder/a.npz"), 1, kept.facts)
    with pytest.raises(OSError, match=r"^/no/such/folder/a.npz: the checkpoint cannot be written"):
        writer.on_frame(simulation, 3, figures)
