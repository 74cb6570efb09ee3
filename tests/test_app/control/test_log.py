"""Logs and scripts: what is read and refused, and when a file is made."""

import dataclasses
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.cli import invoke
from app.control.commands import Gravity, parse_command
from app.control.log import (
    FORMAT_1,
    STATE_1,
    LogWriter,
    digest,
    log_of,
    read_script,
    read_session,
    require_free,
)
from app.control.session import Session, start_session
from app.run.checkpoint import Checkpoint
from taichi_sph.errors import InputError
from taichi_sph.simulation import Simulation

WOUND = {"command": "wound", "centre": [0.005, 0.0, 0.0], "radius": 0.002}
HEAD = b'{"format": "vesselflow session 1", "facts": {}}\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"command": "clamp"}', "line 1 is"),
        ('{"at": "soon", "command": "clamp"}', "line 1 is"),
        ('{"at": NaN, "command": "clamp"}', "line 1 is"),
        ('# a note\n\n{"at": 0.1, "command": "clmap"}', "line 3: no command"),
        ("[]", "line 1 is"),
        ("\x00", "line 1 is"),
    ],
)
def test_a_script_with_a_mistake_names_the_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "s.jsonl").write_text(text)
    with pytest.raises(InputError) as error:
        read_script(tmp_path / "s.jsonl")
    assert message in str(error.value) and "\n" not in str(error.value)


def test_a_script_is_read_without_its_notes(tmp_path: Path) -> None:
    (tmp_path / "s.jsonl").write_text(json.dumps({"at": 0.5} | WOUND) + "\n# end\n")
    assert read_script(tmp_path / "s.jsonl") == [(0.5, parse_command(WOUND))]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "not a session"),
        (b"{}", "not a session"),
        (b"\xff\x00", "cannot be read: not UTF-8 text"),
        (HEAD, "holds no frame"),
        (HEAD.replace(b"1", b"2"), "not a session"),  # names no state
        (HEAD + b'rubbish\n{"frame": 0, "digest": ""}', "line 2 is no line of a session"),
        (HEAD + b'{"frame": 0, "digest": ""}', "its head is not whole"),
    ],
)
def test_what_is_no_session_is_refused_in_one_sentence(
    tmp_path: Path, text: bytes, message: str
) -> None:
    (tmp_path / "s.jsonl").write_bytes(text)
    sentence, code = invoke(["replay", str(tmp_path / "s.jsonl")])
    assert code == 2 and message in sentence and "\n" not in sentence


def test_a_log_that_begins_in_the_middle_is_not_replayed(tmp_path: Path, driven: Path) -> None:
    metadata = {
        "scene": "driven", "scene_text": (driven / "scene.toml").read_text(),
        "folder": str(driven), "particles": None, "height": None, "network": None,
        "model": "physics", "models": ["physics"], "arch": "cpu", "precision": "f32", "seed": 0,
    }  # fmt: skip
    rows = [{"format": FORMAT_1, "facts": metadata}, {"frame": 4, "digest": "0"}]
    (tmp_path / "s.jsonl").write_text("\n".join(map(json.dumps, rows)))
    sentence, code = invoke(["replay", str(tmp_path / "s.jsonl")])
    assert code == 2 and "begins with frame 4" in sentence


def test_the_file_is_made_by_the_first_frame_and_not_before(
    simulation: Simulation, tmp_path: Path
) -> None:
    file = tmp_path / "s.jsonl"
    session = start_session(simulation, {"model": "physics"}, log=file)
    assert not file.exists()
    session.close("refused")
    assert not file.exists()
    session = start_session(simulation, {"model": "physics"}, log=file)
    session.on_frame(simulation, 0, simulation.diagnostics())
    session.close("finished")
    assert sorted(read_session(file, "replay").digests) == [0]
    assert os.listdir(tmp_path) == ["s.jsonl"]


def test_an_explicit_file_of_another_session_is_refused_with_the_ways_out(
    simulation: Simulation, tmp_path: Path
) -> None:
    file = tmp_path / "s.jsonl"
    file.write_bytes(HEAD)
    with pytest.raises(InputError) as error:
        start_session(simulation, {"model": "physics"}, log=file)
    for way_out in ("vesselflow replay", "--resume", "--session"):
        assert way_out in str(error.value)
    assert file.read_bytes() == HEAD
    file.write_bytes(b"")
    require_free(file)


def test_of_two_sessions_that_begin_in_one_file_the_second_is_refused(
    simulation: Simulation, tmp_path: Path
) -> None:
    names = simulation.particles.names
    first, second = (LogWriter(tmp_path / "s.jsonl", {}, names) for _ in range(2))
    diagnostics = simulation.diagnostics()
    first.write_frame(simulation, 0, diagnostics)
    with pytest.raises(OSError, match="another session has begun"):
        second.write_frame(simulation, 0, diagnostics)
    first.close("finished")
    second.close("refused")
    assert len(read_session(tmp_path / "s.jsonl", "replay").digests) == 1


@pytest.fixture
def resumed(session: Session) -> Checkpoint:
    """A checkpoint of the session at its first frame."""
    return Checkpoint({}, 0, session.simulation.save_state())


def test_a_checkpoint_finds_its_own_log(
    resumed: Checkpoint, session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert log_of(resumed, "tube") is None
    other = json.loads((tmp_path / "s.jsonl").read_text().splitlines()[1]) | {"digest": "0"}
    head = (tmp_path / "s.jsonl").read_text().splitlines()[0]
    Path("tube.session.jsonl").write_text(head + "\n" + json.dumps(other))
    Path("tube.3.session.jsonl").write_text("{}")
    with pytest.raises(InputError, match="--session"):
        log_of(resumed, "tube")
    Path("tube.2.session.jsonl").write_bytes((tmp_path / "s.jsonl").read_bytes())
    assert str(log_of(resumed, "tube")) == "tube.2.session.jsonl"
    with pytest.raises(InputError, match="of another run"):
        start_session(
            session.simulation, {"model": "physics"}, log=Path("tube.session.jsonl"),
            checkpoint=resumed,
        )  # fmt: skip


def test_a_full_disk_ends_the_run_in_one_sentence(simulation: Simulation) -> None:
    writer = LogWriter(Path("/dev/full"), {}, simulation.particles.names)
    with pytest.raises(OSError, match=r"^/dev/full: the session cannot be kept: No space left"):
        writer.write_frame(simulation, 0, simulation.diagnostics())
    writer.close("refused")


def test_of_a_cut_log_the_whole_lines_are_read(session: Session, tmp_path: Path) -> None:
    simulation = session.simulation
    for frame in range(1, 6):
        session.on_frame(simulation, frame, simulation.diagnostics())
    whole = (tmp_path / "s.jsonl").read_bytes()
    (tmp_path / "cut.jsonl").write_bytes(whole[: int(0.6 * len(whole))])
    assert 1 <= len(read_session(tmp_path / "cut.jsonl", "replay").digests) < 6


def test_the_digest_covers_all_that_is_kept_of_a_particle(session: Session, tmp_path: Path) -> None:
    log = read_session(tmp_path / "s.jsonl", "replay")
    state = session.simulation.save_state()
    assert log.is_of(0, state) is True and log.is_of(1, state) is None
    assert len(state.particles) >= 5
    for name, values in state.particles.items():
        changed = values.copy()
        changed.reshape(-1).view(f"u{changed.itemsize}")[-1] ^= 1  # the last bit of the last
        other = dataclasses.replace(state, particles=state.particles | {name: changed})
        assert log.is_of(0, other) is False, name
        rest = {key: rows for key, rows in state.particles.items() if key != name}
        assert log.is_of(0, dataclasses.replace(state, particles=rest)) is False


def test_a_log_of_the_first_format_is_read_and_gone_on_with_in_it(
    session: Session, tmp_path: Path
) -> None:
    simulation = session.simulation
    text = hashlib.sha256()
    for rows in simulation.particles.live():
        text.update(rows.tobytes())
    old = {"frame": 0, "digest": text.hexdigest()[:16]}
    file = tmp_path / "old.jsonl"
    file.write_text("\n".join(map(json.dumps, ({"format": FORMAT_1, "facts": {}}, old))))
    log = read_session(file, "replay")
    assert log.state == STATE_1
    assert log.digests[0] == digest(simulation.particles.rows(), STATE_1)
    writer = LogWriter(file, {}, simulation.particles.names, log, log.rows)
    writer.write_frame(simulation, 1, simulation.diagnostics())
    writer.close("finished")
    again = read_session(file, "replay")
    assert again.digests == {0: old["digest"], 1: old["digest"]} and again.state == STATE_1


def test_a_log_is_written_as_json(session: Session, tmp_path: Path) -> None:
    row: Any = {"do": {"vector": np.float32(1.5)}}
    assert session._log is not None
    session._log.write(row)
    assert json.loads((tmp_path / "s.jsonl").read_text().splitlines()[-1])["do"]["vector"] == 1.5
    assert parse_command({"command": "gravity", "vector": [0, 0, 1]}) == Gravity(vector=(0, 0, 1))
