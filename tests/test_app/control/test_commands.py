"""Each command: documented, on the page, logged, replayed, and done within its bounds."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from app.control.auto_model import ModelSelection
from app.control.commands import (
    COMMANDS,
    NAMES,
    Clamp,
    Command,
    Dye,
    Gravity,
    Inflow,
    Model,
    Pause,
    Reset,
    Speed,
    Step,
    Suction,
    Tool,
    Wound,
    as_dict,
    parse_command,
)
from app.control.log import SessionLog, read_session
from app.control.page_controls import CONTROLS, NO_CONTROL
from app.control.replay import ReplayChecker, commands_of
from app.control.session import Session
from app.run.loop import drive
from places import ROOT
from taichi_sph.errors import InputError
from taichi_sph.simulation import Simulation
from taichi_sph.state import State

WALL = (0.005, 0.0, 0.0)
"""A place on the wall of the driven tube [m]."""
EXAMPLES: dict[type[Command], Command] = {
    Step: Step(),
    Pause: Pause(on=False),
    Speed: Speed(factor=1000.0),
    Gravity: Gravity(vector=(3.0, 0.0, -9.0)),
    Inflow: Inflow(factor=0.0, opening="top"),
    Model: Model(name="implicit"),
    Tool: Tool(position=(0.003, 0.0, 0.0)),
    Suction: Suction(rate=2e-5, radius=0.002),
    Wound: Wound(centre=WALL, radius=0.002),
    Clamp: Clamp(wound=0),
    Dye: Dye(centre=(0.0, 0.0, 0.005), radius=0.004, concentration=0.5),
    Reset: Reset(),
}
"""One of each, in the order in which a session can do them."""


def documented() -> dict[str, set[str]]:
    """Commands and keys of the table in docs/theatre.md."""
    text = (ROOT / "docs" / "theatre.md").read_text(encoding="utf-8")
    table = text.split("\n## Commands\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \|([^|]*)\|", table, re.MULTILINE)
    return {name: set(re.findall(r"`(\w+)`", keys)) for name, keys in rows}


def test_every_command_is_documented_with_its_keys() -> None:
    keys = {str(c.__struct_config__.tag): set(c.__struct_fields__) for c in COMMANDS}
    assert documented() == keys


def test_every_command_has_a_control_on_the_page_or_a_reason_why_not() -> None:
    on_page = {command for control in CONTROLS for command in control.commands}
    assert on_page | NO_CONTROL.keys() == set(COMMANDS)
    assert not on_page & NO_CONTROL.keys()
    assert all(NO_CONTROL.values())


def test_every_command_has_its_own_name_and_says_what_it_does() -> None:
    assert len(set(NAMES)) == len(COMMANDS) == len(EXAMPLES)
    for command in COMMANDS:
        assert command.__doc__ != Command.__doc__
        assert "apply" in vars(command), command


@pytest.mark.parametrize("command", EXAMPLES.values(), ids=lambda command: type(command).__name__)
def test_every_command_is_read_as_it_is_written(command: Command) -> None:
    assert parse_command(json.dumps(as_dict(command))) == command


def advance(session: Session, first: int, last: int, *observers: Any) -> None:
    """Run from a frame to another."""
    simulation = session.simulation
    interval = simulation.scene.frame_interval
    outcome = drive(
        simulation, [session, *observers], last * interval, interval, frame=first,
        before_step=session.before_step,
    )  # fmt: skip
    assert outcome.error is None


def replayed(
    simulation: Simulation, models: ModelSelection, beginning: State, log: SessionLog, entries: Any
) -> ReplayChecker:
    """What a replay of some of a log's commands finds."""
    simulation.use_model(models.ready["physics"])
    simulation.load_state(beginning)
    session = Session(simulation, models)
    session.recorded = list(entries)
    checker = ReplayChecker(log)
    advance(session, 0, max(log.digests), checker)
    return checker


def test_every_command_is_logged_and_replayed_bit_by_bit(
    session: Session, models: ModelSelection, beginning: State, tmp_path: Path
) -> None:
    *first, reset = EXAMPLES.values()
    for command in first:
        session.submit(as_dict(command), "test")

    def at_frame(_: Any, frame: int, __: Any) -> None:
        if frame == 2:
            session.submit(as_dict(reset), "test")

    advance(session, 0, 3, SimpleNamespace(on_frame=at_frame, close=lambda ending: None))
    log = read_session(tmp_path / "s.jsonl", "replay")
    assert [entry.command for entry in log.entries] == list(EXAMPLES.values())

    entries = commands_of(log)
    pacing = [type(e.command) for e in log.entries if e not in entries]
    assert pacing == [command for command in EXAMPLES if command.affects_pacing_only]
    checker = replayed(session.simulation, models, beginning, log, entries)
    assert checker.compared == 4 and checker.first_difference is None


# Gravity moves no blood in a closed vessel: its datum balances it.
@pytest.mark.parametrize("kind", [Inflow, Model, Suction, Wound])
def test_a_replay_without_a_command_that_moves_blood_differs(
    session: Session, models: ModelSelection, beginning: State, tmp_path: Path, kind: type[Command]
) -> None:
    session.submit(as_dict(EXAMPLES[kind]), "test")
    # So many frames that blood which is nearly at rest has had its lists built anew.
    advance(session, 0, 6)
    log = read_session(tmp_path / "s.jsonl", "replay")
    checker = replayed(session.simulation, models, beginning, log, [])
    assert checker.compared == 7 and checker.first_difference is not None


@pytest.mark.parametrize(
    ("given", "done"),
    [
        (Gravity(vector=(0.0, 0.0, -300.0)), Gravity(vector=(0.0, 0.0, -30.0))),
        (Gravity(vector=(0.0, 3.0, -9.0)), Gravity(vector=(0.0, 3.0, -9.0))),
        (Inflow(factor=50.0), Inflow(factor=2.0)),
        (Inflow(factor=0.5, opening="top"), Inflow(factor=0.5, opening="top")),
    ],
)
def test_what_is_too_much_is_bounded_and_the_bounded_is_told(
    session: Session, tmp_path: Path, given: Command, done: Command
) -> None:
    results: list[dict[str, Any]] = []
    session.submit(as_dict(given), "test", results.append)
    session.before_step()
    assert parse_command(results[0]["applied"]) == done
    last = json.loads((tmp_path / "s.jsonl").read_text().splitlines()[-1])
    assert parse_command(last["do"]) == done


def test_a_tool_is_wanted_inside_the_box_only(session: Session) -> None:
    session.submit(as_dict(Tool(position=(9.0, 0.0, 0.0))), "test")
    session.before_step()
    low, high = session.simulation.bounds
    assert session.simulation.tool.target_position.tolist() == [high[0], 0.0, 0.0]
    assert (low < high).all()


def test_a_rotation_is_made_a_unit_and_one_without_length_is_none(session: Session) -> None:
    for rotation, expected in (((0.0, 0.0, 0.0, 2.0), (0.0, 0.0, 1.0)), ((0.0,) * 4, None)):
        tool = session.simulation.tool
        before = tool.target_rotation.as_quat()
        session.submit(as_dict(Tool(position=(0.0, 0.0, 0.0), rotation=rotation)), "test")
        session.before_step()
        axis = tool.target_rotation.as_quat()[:3]
        np.testing.assert_allclose(axis, before[:3] if expected is None else expected, atol=1e-12)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"command": "inflow", "factor": 1.0, "opening": "side"}, "driven: top, bottom"),
        ({"command": "model", "name": "pcnet"}, "allowed: physics, implicit"),
        ({"command": "model", "name": "auto"}, "allowed: physics, implicit"),
        ({"command": "model", "name": "magic"}, "no command: Invalid enum value 'magic'"),
        ({"command": "fly"}, "no command: Invalid value 'fly'"),
        ({"command": "pause", "id": 3}, "no command: Object contains unknown field id"),
        (b"\xff\xfe", "no command: "),
        (b"[" * 100000, "no command: "),
        ({"command": "speed", "factor": -1.0}, "no command: Expected `float` > 0.0"),
    ],
)
def test_what_cannot_be_done_is_refused_at_once_in_one_sentence(
    session: Session, given: Any, message: str
) -> None:
    with pytest.raises(InputError) as error:
        session.submit(given, "test")
    assert message.replace("`", "") in str(error.value)
    assert "\n" not in str(error.value)


def test_without_driven_openings_there_is_no_inflow(session: Session) -> None:
    session.driven = []
    with pytest.raises(InputError, match="nothing drives this scene"):
        session.submit(as_dict(Inflow(factor=1.0)), "test")


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({}, "give centre and radius"),
        ({"centre": [0, 0, 0]}, "give centre and radius"),
        ({"centre": [0, 0, 0], "radius": 0.002, "opening": "top"}, "one of the two"),
        ({"opening": "side"}, "'side'; driven: top, bottom"),
        ({"opening": "top", "concentration": 2.0}, "concentration"),
    ],
)
def test_a_dye_that_says_not_where_is_refused_at_once(session, keys, says) -> None:
    with pytest.raises(InputError, match=says):
        session.submit({"command": "dye", **keys}, "test")


def test_a_dye_marks_the_blood_that_it_names(session: Session) -> None:
    simulation = session.simulation
    session.submit(as_dict(EXAMPLES[Dye]), "test")
    session.before_step()
    rows = simulation.particles.rows()
    away = np.linalg.norm(rows["position"] - (0.0, 0.0, 0.005), axis=1)
    marked = away < 0.004
    assert marked.any() and not marked.all()
    np.testing.assert_array_equal(rows["dye"], np.where(marked, np.float32(0.5), 0.0))
    session.submit({"command": "reset"}, "test")
    session.before_step()
    assert not simulation.particles.rows()["dye"].any()
