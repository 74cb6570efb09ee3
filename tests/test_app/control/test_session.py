"""Sessions: commands between steps, holding and pace, on a small tube that is driven."""

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.control import auto_model
from app.control.auto_model import ModelSelection
from app.control.commands import Reset, Wound, as_dict
from app.control.session import MOST_WAITING, Session, start_session
from nn.training.rollout import ReplaySimulation
from taichi_sph.errors import InputError, RunError
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.scene import read_scene
from taichi_sph.simulation import Simulation

WOUND = {"command": "wound", "centre": [0.005, 0.0, 0.0], "radius": 0.002}
TILT = {"command": "gravity", "vector": [0.0, 1.0, 0.0]}


def test_a_command_is_applied_before_the_next_step(session: Session) -> None:
    simulation = session.simulation
    results: list[dict[str, Any]] = []
    session.submit(TILT, "test", results.append)
    assert simulation.gravity == simulation.scene.gravity and not results
    simulation.advance_to(simulation.time + 1e-5, session.before_step)
    assert simulation.gravity == (0.0, 1.0, 0.0)
    (result,) = results
    assert result["step"] == simulation.steps - 1
    assert result["time"] == simulation.time - simulation.last_step


def test_more_commands_than_can_wait_are_refused_and_the_rest_is_done(session: Session) -> None:
    with pytest.raises(InputError, match="send fewer"):
        for _ in range(MOST_WAITING + 1):
            session.submit({"command": "gravity", "vector": [0.0, 0.0, -1.0]}, "test")
    session.before_step()
    session.submit({"command": "reset"}, "test")


def test_what_turns_out_impossible_is_told_and_harms_nothing(session: Session) -> None:
    told: list[str] = []
    results: list[dict[str, Any]] = []
    session.on_rejected.append(told.append)
    inside = {"command": "wound", "centre": [0.0, 0.0, 0.0], "radius": 0.002}
    session.submit(inside, "test", results.append)
    session.submit({"command": "clamp", "wound": 3}, "test")
    session.before_step()
    assert len(told) == 2 and "the wall is" in told[0] and "there is no wound 3" in told[1]
    assert results == [
        {"refused": told[0], "step": session.simulation.steps, "time": session.simulation.time}
    ]


def test_what_still_waits_when_the_run_ends_is_refused(session: Session) -> None:
    results: list[dict[str, Any]] = []
    session.submit(TILT, "test", results.append)
    session.close("finished")
    assert results == [{"refused": "the run has ended"}]
    with pytest.raises(InputError, match="the run has ended"):
        session.submit(TILT, "test")


def test_a_held_session_does_not_move_but_for_single_steps(session: Session) -> None:
    simulation = session.simulation
    for command in ({"command": "step"}, {"command": "step"}):
        session.submit(command, "test")
        steps = simulation.steps
        session.before_step()
        simulation.step(1e-5)
        assert simulation.steps == steps + 1 and session.paused
    session.submit({"command": "pause", "on": False}, "test")
    session.before_step()
    assert not session.paused


def test_a_step_that_is_asked_for_while_blood_is_held_is_one_step(session: Session) -> None:
    simulation, seen = session.simulation, []
    session.submit({"command": "pause"}, "test")

    def act() -> None:
        time.sleep(0.1)
        session.submit({"command": "step"}, "test")
        time.sleep(0.5)
        seen.append(simulation.steps)
        session.submit({"command": "pause", "on": False}, "test")

    hand = threading.Thread(target=act)
    steps = simulation.steps
    hand.start()
    for _ in range(2):
        session.before_step()
        simulation.step(1e-5)
    hand.join()
    assert seen == [steps + 1]


def test_a_speed_limit_holds_blood_to_its_pace(session: Session) -> None:
    simulation = session.simulation
    session.submit({"command": "speed", "factor": 0.005}, "test")
    session.before_step()
    began, at = time.perf_counter(), simulation.time
    simulation.advance_to(at + 1e-3, session.before_step)
    session.before_step()
    # 1 ms of blood at 0.005 x real time takes 0.2 s of the wall's, or longer.
    assert time.perf_counter() - began >= 0.19


def test_reset_puts_everything_back_but_the_clock(session: Session) -> None:
    simulation = session.simulation
    start = simulation.positions()
    for command in (WOUND, {"command": "inflow", "factor": 0.1}):
        session.submit(command, "test")
    simulation.advance_to(simulation.time + 2e-3, session.before_step)
    at, count = simulation.time, len(start)
    assert len(simulation.wounds) and not np.array_equal(simulation.positions()[:count], start)
    session.submit(as_dict(Reset()), "test")
    session.before_step()
    assert simulation.time == at and not len(simulation.wounds)
    assert np.array_equal(simulation.positions(), start)
    assert simulation.outlets.outflow_counts().sum() == 0
    assert simulation.inflow.openings[0].target_factor == 1.0


def test_auto_leaves_pcnet_where_blood_is_denser_than_its_training_and_comes_back(
    session: Session,
) -> None:
    simulation = session.simulation
    session.models.ready["pcnet"] = session.models.ready["physics"]
    session.submit({"command": "model", "name": "auto"}, "test")
    session.before_step()
    diagnostics = simulation.diagnostics()
    for k, (compression, name) in enumerate(
        ((0.05, "physics"), (0.09, "implicit"), (0.05, "implicit"), (0.03, "physics")), 1
    ):
        frame = replace(diagnostics, time=simulation.time + 0.01 * k, compression_p99=compression)
        session.on_frame(simulation, k, frame)
        assert simulation.model.name == name
        assert session.status()["model"] == "auto"
    # Neither of the two stands for pcnet by its name: all frames count.
    assert session.status()["guard_share"] == pytest.approx(1.0)


def test_a_script_that_cannot_be_done_ends_the_run(
    simulation: Simulation, models: ModelSelection
) -> None:
    simulation.reset()
    script = [(simulation.time, Wound(centre=(0.0, 0.0, 0.0), radius=1e-3))]
    session = Session(simulation, models, None, script)
    with pytest.raises(RunError, match="the script cannot go on: wound"):
        session.before_step()


# A network that does not fit the blood


UNFIT = "pcnet.npz: viscosity_ratio is 17.32 in the weights, 1 in the scene"


@pytest.fixture
def unfit(monkeypatch: pytest.MonkeyPatch) -> None:
    made = auto_model.model_factory

    def model_factory(name: str, *arguments: Any) -> Any:
        if name == "pcnet":
            raise InputError(UNFIT)
        return made(name, *arguments)

    monkeypatch.setattr(auto_model, "model_factory", model_factory)

    def hashed(*_: Any) -> Any:
        raise AssertionError("weights are read where there is no network")

    monkeypatch.setattr("app.control.session.network_metadata", hashed)


def test_a_network_that_does_not_fit_is_refused_in_its_sentence_and_the_rest_is_there(
    simulation: Simulation, unfit: None
) -> None:
    session = start_session(simulation, {"model": "physics"}, all_models=True)
    assert session.models.names == ("physics", "implicit")
    for name in ("pcnet", "auto"):
        with pytest.raises(InputError, match=f"{name}.* is not ready: {UNFIT}; allowed: physics"):
            session.submit({"command": "model", "name": name}, "test")
    session.submit({"command": "model", "name": "implicit"}, "test")
    session.before_step()
    assert simulation.model.name == "implicit"
    simulation.use_model(session.models.ready["physics"])


def test_a_network_that_is_asked_for_and_does_not_fit_ends_the_start(
    simulation: Simulation, unfit: None, tmp_path: Path
) -> None:
    script = tmp_path / "s.jsonl"
    script.write_text('{"at": 1.0, "command": "model", "name": "auto"}')
    for how in ({"script": script}, {"weights": tmp_path / "w.npz"}):
        with pytest.raises(InputError, match=UNFIT):
            start_session(simulation, {"model": "physics"}, all_models=True, **how)  # type: ignore[arg-type]


def test_a_driven_scene_cannot_be_recorded_for_training(driven: Path) -> None:
    scene = read_scene(driven / "scene.toml")
    with pytest.raises(InputError, match=r"openings\.top: is driven"):
        ReplaySimulation(scene, read_vessel(scene), 0)
