"""Made-up runs in a dataset: blood of which some leaves, a wall, and a scene with its surface."""

from pathlib import Path

import numpy as np

from nn.dataset.schema import Proxies, RecordedState, RunMetadata, Substeps, mean_acceleration
from nn.dataset.writer import RunWriter, merge
from taichi_sph.scene_files import sha256

SCENE = """
title = "A tank"
duration = 0.5
frame_interval = 0.002
gravity = [0.0, 0.0, -9.81]
vessel = { surface = "lumen.ply" }
column = { opening = "top", particles = 9 }
discretization = { spacing = 0.001 }
"""
FILES = {"lumen.ply": b"a surface"}
FACTS = RunMetadata(
    scene=SCENE,
    scene_name="tank",
    scene_folder="/vessels/tank",
    surface_sha256=sha256(FILES["lumen.ply"]),
    program_version="0.1.0",
    architecture="cpu",
    seed=3,
    height=0.004,
    frames=6,
    particles=50,
    spacing=1e-3,
    support_radius=2e-3,
    sound_speed=6.0,
    substep=5e-5,
    substeps=4,
    frame_interval=2e-4,
    feature_version=0,
)
WALL = Proxies(
    np.linspace(0.0, 1.0, 21, dtype=np.float32).reshape(7, 3),
    np.tile(np.array([0.0, 0.0, 1.0], np.float32), (7, 1)),
    np.full(7, 1e-9, np.float32),
)
FEATURES = 23


def states(facts: RunMetadata) -> list[RecordedState]:
    """Blood of which ten particles leave after every second frame."""
    random = np.random.default_rng(facts.seed)
    alive = np.ones(facts.particles, bool)
    made = []
    for frame in range(facts.frames + 1):
        if frame and frame % 2 == 0:
            alive[np.flatnonzero(alive)[:10]] = False
        position, velocity = random.normal(size=(2, facts.particles, 3)).astype(np.float32)
        position[~alive] = velocity[~alive] = 0.0
        made.append(RecordedState(position, velocity, alive.copy()))
    return made


def write(writer: RunWriter, made: list[RecordedState], width: int, upto: int) -> None:
    """Append states from where the writer is up to a number of them."""
    interval = writer.metadata.frame_interval
    for frame in range(writer.states, upto):
        state = made[frame]
        acceleration = np.zeros_like(state.velocity)
        if frame:
            before = made[frame - 1].velocity
            acceleration = mean_acceleration(before, state.velocity, state.alive, interval)
        features = None
        if width and frame < writer.metadata.frames:
            features = np.full((len(state.alive), width), frame, np.float32)
            features[~state.alive] = 0.0
        writer.append(state, acceleration, features, Substeps(4 + frame % 2, 4e-5, 5e-5))


def make(
    path: Path, facts: tuple[RunMetadata, ...] = (FACTS,), width: int = 0
) -> list[list[RecordedState]]:
    """A dataset of made-up runs."""
    parts, everything = [], []
    for number, one in enumerate(facts):
        part = path.with_name(f"{path.name}.{number}")
        made = states(one)
        with RunWriter(part, one, WALL, FILES, width) as writer:
            write(writer, made, width, one.frames + 1)
        parts.append(part)
        everything.append(made)
    merge(parts, path)
    assert not any(part.exists() for part in parts)
    return everything
