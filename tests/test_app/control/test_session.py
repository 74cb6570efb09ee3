"""Sessions: commands, script, log and replay, on a small tube that a pump and a reservoir drive."""

import json
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.control.commands import Gravity, Inflow, Reset, Tool, Wound, as_dict, parse_command
from app.control.session import MOST_WAITING, Session, read_script, read_session
from app.models import model_factory
from commands import HERE, vesselflow
from taichi_sph.errors import InputError, RunError
from taichi_sph.scene import read_scene
from taichi_sph.simulation import Simulation

WOUND = {"command": "wound", "centre": [0.005, 0.0, 0.0], "radius": 0.002}


@pytest.fixture(scope="module")
def simulation(driven: Path) -> Simulation:
    """One for all tests: each begins with a reset."""
    return Simulation.from_scene(read_scene(driven / "scene.toml"))


@pytest.fixture
def session(simulation: Simulation, tmp_path: Path) -> Iterator[Session]:
    simulation.reset()
    scene = simulation.scene
    made = Session(simulation, {"implicit": model_factory("implicit", scene)}, tmp_path / "s.jsonl")
    yield made
    simulation.use_model(made.models["physics"])
    made.close("tested")


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_command_is_applied_before_the_next_step_and_written_down_with_it(session, tmp_path):
    simulation = session.simulation
    session.offer(b'{"command": "gravity", "vector": [0.0, 1.0, 0.0]}', "test")
    assert simulation.gravity == simulation.scene.gravity
    simulation.advance_to(simulation.time + 1e-5, session.before_step)
    assert simulation.gravity == (0.0, 1.0, 0.0)
    last = lines(tmp_path / "s.jsonl")[-1]
    assert last["do"] == {"command": "gravity", "vector": [0.0, 1.0, 0.0]}
    assert last["source"] == "test" and last["step"] == simulation.steps - 1


@pytest.mark.parametrize(
    ("given", "done"),
    [
        (Gravity(vector=(0.0, 0.0, -300.0)), Gravity(vector=(0.0, 0.0, -30.0))),
        (Inflow(factor=50.0), Inflow(factor=2.0)),
        (Inflow(factor=0.5, opening="top"), Inflow(factor=0.5, opening="top")),
    ],
)
def test_what_is_too_much_is_bounded_and_the_bounded_is_written_down(
    session, tmp_path, given, done
):
    session.offer(as_dict(given), "test")
    session.before_step()
    assert lines(tmp_path / "s.jsonl")[-1]["do"] == json.loads(json.dumps(as_dict(done)))


def test_a_tool_is_wanted_inside_the_box_only(session):
    session.offer(as_dict(Tool(position=(9.0, 0.0, 0.0))), "test")
    session.before_step()
    low, high = session.simulation.bounds
    assert session.simulation.tool.target_position.tolist() == [high[0], 0.0, 0.0]
    assert (low < high).all()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"command": "inflow", "factor": 1.0, "opening": "side"}, "driven: top, bottom"),
        ({"command": "model", "name": "pcnet"}, "allowed: physics, implicit"),
        ({"command": "model", "name": "magic"}, "no command: Invalid enum value 'magic'"),
        ({"command": "fly"}, "no command: Invalid value 'fly'"),
        (b"\xff\xfe", "no command: "),
        (b"[" * 100000, "no command: "),
        ({"command": "speed", "factor": -1.0}, "no command: Expected `float` > 0.0"),
    ],
)
def test_what_cannot_be_done_is_refused_at_once_in_one_sentence(session, given, message):
    with pytest.raises(InputError) as error:
        session.offer(given, "test")
    assert message.replace("`", "") in str(error.value)
    assert "\n" not in str(error.value)


def test_more_commands_than_can_wait_are_refused_and_the_rest_is_done(session):
    with pytest.raises(InputError, match="send fewer"):
        for _ in range(MOST_WAITING + 1):
            session.offer({"command": "gravity", "vector": [0.0, 0.0, -1.0]}, "test")
    session.before_step()
    session.offer({"command": "reset"}, "test")


def test_what_turns_out_impossible_is_told_and_harms_nothing(session):
    told: list[str] = []
    session.refusals.append(told.append)
    session.offer({"command": "wound", "centre": [0.0, 0.0, 0.0], "radius": 0.002}, "test")
    session.offer({"command": "clamp", "wound": 3}, "test")
    session.before_step()
    assert len(told) == 2 and "the wall is" in told[0] and "there is no wound 3" in told[1]


def test_a_held_session_does_not_move_but_for_single_steps(session):
    simulation = session.simulation
    for command in ({"command": "step"}, {"command": "step"}):
        session.offer(command, "test")
        steps = simulation.steps
        session.before_step()
        simulation.step(1e-5)
        assert simulation.steps == steps + 1 and session.paused
    session.offer({"command": "pause", "on": False}, "test")
    session.before_step()
    assert not session.paused


def test_a_step_that_is_asked_for_while_blood_is_held_is_one_step(session):
    import threading
    import time

    simulation, seen = session.simulation, []
    session.offer({"command": "pause"}, "test")

    def act() -> None:
        time.sleep(0.1)
        session.offer({"command": "step"}, "test")
        time.sleep(0.5)
        seen.append(simulation.steps)
        session.offer({"command": "pause", "on": False}, "test")

    hand = threading.Thread(target=act)
    steps = simulation.steps
    hand.start()
    for _ in range(2):
        session.before_step()
        simulation.step(1e-5)
    hand.join()
    assert seen == [steps + 1]


def test_a_speed_limit_holds_blood_to_its_pace(session):
    import time

    simulation = session.simulation
    session.offer({"command": "speed", "factor": 0.005}, "test")
    session.before_step()
    began, at = time.perf_counter(), simulation.time
    simulation.advance_to(at + 1e-3, session.before_step)
    session.before_step()
    # 1 ms of blood at 0.005 x real time takes 0.2 s of the wall's, or longer.
    assert time.perf_counter() - began >= 0.19


def test_reset_puts_everything_back_but_the_clock(session):
    simulation = session.simulation
    start = simulation.positions()
    for command in (WOUND, {"command": "inflow", "factor": 0.1}):
        session.offer(command, "test")
    simulation.advance_to(simulation.time + 2e-3, session.before_step)
    time, count = simulation.time, len(start)
    assert len(simulation.wounds) and not np.array_equal(simulation.positions()[:count], start)
    session.offer(as_dict(Reset()), "test")
    session.before_step()
    assert simulation.time == time and not len(simulation.wounds)
    assert np.array_equal(simulation.positions(), start)
    assert simulation.outlets.outflow_counts().sum() == 0
    assert simulation.inflow.openings[0].target_factor == 1.0


def test_auto_leaves_pcnet_where_blood_is_denser_than_its_training_and_comes_back(session):
    from dataclasses import replace

    simulation = session.simulation
    session.models["pcnet"] = session.models["physics"]
    session.offer({"command": "model", "name": "auto"}, "test")
    session.before_step()
    figures = simulation.diagnostics()
    for k, (compression, name) in enumerate(
        ((0.05, "physics"), (0.09, "implicit"), (0.05, "implicit")), 1
    ):
        time = simulation.time + 0.01 * k
        session.on_frame(simulation, k, replace(figures, time=time, compression_p99=compression))
        assert simulation.model.name == name
    # Neither of the two stands for pcnet by its name: all three frames count.
    assert session.figures()["guard_share"] == pytest.approx(1.0)


def test_a_script_that_cannot_be_done_ends_the_run(simulation, tmp_path):
    simulation.reset()
    script = [(simulation.time, Wound(centre=(0.0, 0.0, 0.0), radius=1e-3))]
    session = Session(simulation, {}, None, None, script)
    with pytest.raises(RunError, match="the script cannot go on: wound"):
        session.before_step()


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
def test_a_script_with_a_mistake_names_the_line(tmp_path, text, message):
    (tmp_path / "s.jsonl").write_text(text)
    with pytest.raises(InputError) as error:
        read_script(tmp_path / "s.jsonl")
    assert message in str(error.value) and "\n" not in str(error.value)


def test_a_script_is_sorted_out_by_its_reader(tmp_path):
    (tmp_path / "s.jsonl").write_text(json.dumps({"at": 0.5} | WOUND) + "\n# end\n")
    assert read_script(tmp_path / "s.jsonl") == [(0.5, parse_command(WOUND))]


SCRIPT = [
    {"at": 0.0, "command": "inflow", "factor": 0.5, "opening": "top"},
    {"at": 0.003, **WOUND},
    {"at": 0.005, "command": "model", "name": "physics"},
    {"at": 0.005, "command": "tool", "position": [0.003, 0.0, 0.0]},
    {"at": 0.007, "command": "suction", "rate": 2e-5, "radius": 0.002},
    {"at": 0.009, "command": "model", "name": "auto"},
    {"at": 0.011, "command": "clamp"},
    {"at": 0.0125, "command": "gravity", "vector": [3.0, 0.0, -9.0]},
]


@pytest.fixture(scope="module")
def kept(driven: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a session that was run to its end, with a recording and checkpoints."""
    folder = tmp_path_factory.mktemp("session")
    script = folder / "script.jsonl"
    script.write_text("".join(json.dumps(line) + "\n" for line in SCRIPT))
    vesselflow(
        folder, "run", driven, "--model", "implicit", "--script", script, "--session", "s.jsonl",
        "--rrd", "s.rrd", "--checkpoint", "1",
    )  # fmt: skip
    return folder


def test_a_session_is_replayed_bit_for_bit(kept):
    log = read_session(kept / "s.jsonl", "replay")
    assert [e.command for e in log.entries if e.source == "script"] == [
        parse_command({k: v for k, v in line.items() if k != "at"}) for line in SCRIPT
    ]
    assert len(log.digests) == 11 and len(set(log.digests.values())) == 11
    vesselflow(kept, "replay", "s.jsonl")


def test_a_replay_notices_another_course(kept, tmp_path):
    changed = (kept / "s.jsonl").read_text().replace('"vector":[3.0', '"vector":[3.1')
    (tmp_path / "s.jsonl").write_text(changed)
    error = vesselflow(tmp_path, "replay", "s.jsonl", code=1)
    assert "differs from frame" in error.splitlines()[-1]


@pytest.mark.parametrize("kills", [3, pytest.param(10, marks=pytest.mark.validation)])
def test_a_session_killed_again_and_again_ends_bitwise_like_the_whole_one(
    kept, driven, tmp_path, kills
):
    shutil.copy(kept / "script.jsonl", tmp_path)
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
    whole, again = (read_session(f / "s.jsonl", "replay") for f in (kept, tmp_path))
    assert whole.digests == again.digests
    assert whole.rows == again.rows


def test_of_a_cut_log_the_whole_lines_are_replayed(kept, tmp_path):
    text = (kept / "s.jsonl").read_bytes()
    (tmp_path / "s.jsonl").write_bytes(text[: int(0.6 * len(text))])
    assert 2 <= len(read_session(tmp_path / "s.jsonl", "replay").digests) < 11


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "not a session"),
        (b"{}", "not a session"),
        (b"\xff\x00", "cannot be read: not UTF-8 text"),
        (b'{"format": "vesselflow session 1", "facts": {}}\n', "holds no frame"),
        (
            b'{"format": "vesselflow session 1", "facts": {}}\nrubbish\n{"frame": 0, "digest": ""}',
            "line 2 is no line of a session",
        ),
        (
            b'{"format": "vesselflow session 1", "facts": {}}\n{"frame": 0, "digest": ""}',
            "its head is not whole",
        ),
    ],
)
def test_what_is_no_session_is_refused_in_one_sentence(tmp_path, text, message):
    (tmp_path / "s.jsonl").write_bytes(text)
    error = vesselflow(tmp_path, "replay", "s.jsonl", code=2)
    assert message in error and error.count("\n") == 1


def test_a_log_of_another_session_is_not_written_over(kept, driven, tmp_path):
    shutil.copy(kept / "s.jsonl", tmp_path)
    error = vesselflow(tmp_path, "run", driven, "--session", "s.jsonl", "--frames", 1, code=2)
    assert "holds another session" in error


def test_a_log_on_a_full_disk_ends_the_run_in_one_sentence(driven, tmp_path):
    error = vesselflow(
        tmp_path, "run", driven, "--session", "/dev/full", "--frames", 1, code=2
    )  # fmt: skip
    assert "No space left on device" in error.splitlines()[-1]


def test_a_driven_scene_cannot_be_recorded_for_training(driven, tmp_path):
    error = vesselflow(
        tmp_path, "record", driven, "--heights", "0.01", "--frames", 1, "--out", "d.h5", code=2
    )
    assert "openings.top: is driven" in error.splitlines()[-1]
    assert not (tmp_path / "d.h5").exists()
