"""Sessions as a user has them: run, killed, gone on with and replayed, each in its own process."""

import json
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from app.control.commands import parse_command
from app.control.log import read_session
from commands import HERE, vesselflow

SCRIPT = [
    {"at": 0.0, "command": "inflow", "factor": 0.5, "opening": "top"},
    {"at": 0.003, "command": "wound", "centre": [0.005, 0.0, 0.0], "radius": 0.002},
    {"at": 0.005, "command": "model", "name": "physics"},
    {"at": 0.005, "command": "tool", "position": [0.003, 0.0, 0.0]},
    {"at": 0.007, "command": "suction", "rate": 2e-5, "radius": 0.002},
    {"at": 0.009, "command": "model", "name": "auto"},
    {"at": 0.011, "command": "clamp"},
    {"at": 0.0125, "command": "gravity", "vector": [3.0, 0.0, -9.0]},
]
FRAMES = 11
"""Of the driven scene, the first among them."""


@pytest.fixture(scope="module")
def whole(driven: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a session that was run to its end, with a recording and checkpoints."""
    folder = tmp_path_factory.mktemp("session")
    script = folder / "script.jsonl"
    script.write_text("".join(json.dumps(line) + "\n" for line in SCRIPT))
    vesselflow(
        folder, "run", driven, "--model", "implicit", "--script", script, "--session", "s.jsonl",
        "--rrd", "s.rrd", "--checkpoint", "1",
    )  # fmt: skip
    return folder


@pytest.mark.validation
def test_a_script_is_logged_and_replayed_bit_for_bit(whole: Path) -> None:
    log = read_session(whole / "s.jsonl", "replay")
    assert [e.command for e in log.entries if e.source == "script"] == [
        parse_command({k: v for k, v in line.items() if k != "at"}) for line in SCRIPT
    ]
    assert len(log.digests) == len(set(log.digests.values())) == FRAMES
    vesselflow(whole, "replay", "s.jsonl")


@pytest.mark.validation
def test_a_replay_notices_another_course(whole: Path, tmp_path: Path) -> None:
    changed = (whole / "s.jsonl").read_text().replace('"vector":[3.0', '"vector":[3.1')
    (tmp_path / "s.jsonl").write_text(changed)
    error = vesselflow(tmp_path, "replay", "s.jsonl", code=1)
    assert "differs from frame" in error.splitlines()[-1]


@pytest.mark.validation
@pytest.mark.parametrize("kills", [1, 10])
def test_a_session_killed_again_and_again_ends_bitwise_like_the_whole_one(
    whole: Path, driven: Path, tmp_path: Path, kills: int
) -> None:
    shutil.copy(whole / "script.jsonl", tmp_path)
    command = [
        "run", str(driven), "--model", "implicit", "--script", str(tmp_path / "script.jsonl"),
        "--session", "s.jsonl", "--checkpoint", "1",
    ]  # fmt: skip
    log, checkpoint = tmp_path / "s.jsonl", tmp_path / f"{driven.name}.checkpoint.npz"
    moments, ends = random.Random(0), []
    for _ in range(kills):
        begun = log.read_text().count('"frame"') if log.is_file() else 0
        go_on = ["--resume", checkpoint.name] if checkpoint.is_file() else []
        process = subprocess.Popen(
            [sys.executable, "-m", "app", *command, *go_on],
            cwd=tmp_path, env=HERE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        # It has begun the log anew with what was before, and then gone on: now any moment will do.
        while process.poll() is None and not (
            log.is_file() and log.read_text().count('"frame"') > min(begun, 8)
        ):
            time.sleep(0.001)
        time.sleep(moments.uniform(0.0, 0.05))
        process.kill()
        ends.append(process.wait())
    assert ends.count(-signal.SIGKILL) > kills // 2
    vesselflow(tmp_path, *command, "--resume", checkpoint.name)
    expected, again = (read_session(f / "s.jsonl", "replay") for f in (whole, tmp_path))
    assert expected.digests == again.digests
    assert expected.rows == again.rows
