"""A small tube that a pump and a reservoir drive, and a session of it, compiled once a file."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.control.auto_model import ModelSelection
from app.control.log import LogWriter
from app.control.session import Session
from app.scenes.library import shipped
from taichi_sph.scene import read_scene
from taichi_sph.simulation import Simulation
from taichi_sph.state import State

SCENE = """
title = "Tube with a pump"
duration = 0.02
frame_interval = 0.002
gravity = [0.0, 0.0, -9.81]
[vessel]
surface = "lumen.ply"
[openings.top]
centre = [0.0, 0.0, 0.03]
flow = 1e-5
waveform = "common_carotid"
[openings.bottom]
centre = [0.0, 0.0, -0.03]
pressure = 300.0
[column]
opening = "top"
full = true
[discretization]
spacing = 0.0013
"""


@pytest.fixture(scope="session")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the scene."""
    folder = tmp_path_factory.mktemp("driven")
    shutil.copy(shipped()["tube"].parent / "lumen.ply", folder)
    (folder / "scene.toml").write_text(SCENE)
    return folder


@pytest.fixture(scope="session")
def simulation(driven: Path) -> Simulation:
    """One for all tests: each begins with a reset."""
    return Simulation.from_scene(read_scene(driven / "scene.toml"))


@pytest.fixture(scope="session")
def beginning(simulation: Simulation) -> State:
    """The state at time zero."""
    return simulation.save_state()


@pytest.fixture(scope="session")
def models(simulation: Simulation) -> ModelSelection:
    """The physics and the implicit model of the one simulation."""
    return ModelSelection(simulation, ["implicit"])


@pytest.fixture
def session(
    simulation: Simulation, models: ModelSelection, beginning: State, tmp_path: Path
) -> Iterator[Session]:
    """A session at time zero that has written its first frame to its log, s.jsonl."""
    simulation.load_state(beginning)
    log = LogWriter(tmp_path / "s.jsonl", {}, simulation.particles.names)
    made = Session(simulation, models, log)
    made.on_frame(simulation, 0, simulation.diagnostics())
    yield made
    simulation.use_model(models.ready["physics"])
    models.auto = False
    models.ready.pop("pcnet", None)
    made.close("tested")
