"""A small tube that a pump and a reservoir drive."""

import shutil
from pathlib import Path

import pytest

from app.scenes.library import shipped

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


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the scene."""
    folder = tmp_path_factory.mktemp("driven")
    shutil.copy(shipped()["tube"].parent / "lumen.ply", folder)
    (folder / "scene.toml").write_text(SCENE)
    return folder
