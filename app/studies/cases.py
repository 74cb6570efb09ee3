"""Cases where methods fail: a start, a scene and a time each, and what must hold at the end."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from app.scenes.library import find_scene
from app.studies.timed_run import TimedRun
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation

Start = tuple[np.ndarray, np.ndarray]
"""Positions [m] and velocities [m/s] of the blood, (n, 3) each."""
Begin = Callable[[Simulation, np.random.Generator], Start]
Check = Callable[["StartedRun"], str]


@dataclass
class StartedRun:
    """One method from one start of a case."""

    run: TimedRun
    start: Start
    case: "Case"


@dataclass(frozen=True)
class Case:
    """Where methods fail."""

    name: str
    scene: Callable[[Path], Scene]
    """Makes the scene; files it needs go into the folder given."""
    until: float
    """Simulated time [s]."""
    begin: Begin | None = None
    """Makes the start; the scene's column at rest by default."""
    check: Check | None = None
    """Says what is wrong at the end, if anything; beside the rules."""
    spacing: float = 1.0
    """Times the scene's."""
    step: float = 1.0
    """Times the method's own."""
    must_fail_with: str = ""
    """The case cannot be lived through: a method passes by stopping with this in its sentence."""


def shipped(
    name: str,
    spacing: float,
    height: float | None = None,
    offset: float | None = None,
    **changes: Any,
) -> Callable[[Path], Scene]:
    """A shipped scene at a spacing [m], with another column [m] or gravity."""

    def make(_: Path) -> Scene:
        scene = find_scene(name)
        grid = msgspec.structs.replace(scene.discretization, spacing=spacing)
        column = scene.column
        if height is not None:
            column = msgspec.structs.replace(column, height=height, particles=None)
        if offset is not None:
            column = msgspec.structs.replace(column, offset=offset)
        return msgspec.structs.replace(scene, discretization=grid, column=column, **changes)

    return make


def narrowed(percent: float, spacing: float, height: float) -> Callable[[Path], Scene]:
    """The stenosis with another narrowing of its radius, spacing [m] and column [m]."""

    def make(folder: Path) -> Scene:
        from app.scenes.centreline import remake
        from taichi_sph.scene import read_scene

        source = Path(find_scene("stenosis").folder)
        table = msgspec.json.decode((source / "centreline.json").read_bytes())
        table["narrowing"] = percent
        (folder / "centreline.json").write_bytes(msgspec.json.encode(table))
        (folder / "scene.toml").write_bytes((source / "scene.toml").read_bytes())
        remake(folder)
        scene = read_scene(folder / "scene.toml")
        grid = msgspec.structs.replace(scene.discretization, spacing=spacing)
        column = msgspec.structs.replace(scene.column, height=height)
        return msgspec.structs.replace(scene, discretization=grid, column=column)

    return make


def turned(name: str, spacing: float, height: float) -> Callable[[Path], Scene]:
    """A shipped scene turned about an axis that is nobody's, gravity with it."""

    def make(folder: Path) -> Scene:
        import trimesh

        scene = shipped(name, spacing, height)(folder)
        turn = trimesh.transformations.rotation_matrix(1.0, (1.0, 2.0, -1.5))
        mesh = trimesh.load_mesh(Path(scene.folder) / scene.vessel.surface)
        mesh.apply_transform(turn)
        mesh.export(folder / "lumen.ply")
        openings = {
            key: msgspec.structs.replace(o, centre=tuple(turn[:3, :3] @ np.array(o.centre)))
            for key, o in scene.openings.items()
        }
        gravity = turn[:3, :3] @ np.array(scene.gravity)
        vessel = msgspec.structs.replace(scene.vessel, surface="lumen.ply")
        return msgspec.structs.replace(
            scene,
            folder=str(folder),
            vessel=vessel,
            openings=openings,
            gravity=tuple(map(float, gravity)),
        )

    return make


# Starts


def column_start(simulation: Simulation, _: np.random.Generator) -> Start:
    """The scene's column at rest."""
    x = simulation.positions().astype(float)
    return x, np.zeros_like(x)


def sinking_start(simulation: Simulation, generator: np.random.Generator) -> Start:
    """The scene's column, already moving along gravity at 0.3 m/s."""
    x, v = column_start(simulation, generator)
    g = np.asarray(simulation.scene.gravity)
    return x, v + 0.3 * g / np.linalg.norm(g)


def ball_start(speed: float, radius: float = 3.2) -> Begin:
    """A ball of blood, so many spacings in radius, in the middle of it all; moves at a speed."""

    def make(simulation: Simulation, generator: np.random.Generator) -> Start:
        x, _ = column_start(simulation, generator)
        low, high = x.min(axis=0), x.max(axis=0)
        d = simulation.scene.discretization.spacing
        apart = np.linalg.norm(x - 0.5 * (low + high), axis=1)
        x = x[apart < radius * d]
        return x, np.tile([0.0, 0.0, -speed], (len(x), 1))

    return make


def particles_start(count: int, apart: float) -> Begin:
    """So many particles, `apart` spacings from each other, where the column has its middle."""

    def make(simulation: Simulation, generator: np.random.Generator) -> Start:
        x, _ = column_start(simulation, generator)
        d = simulation.scene.discretization.spacing
        middle = x[np.linalg.norm(x - x.mean(axis=0), axis=1).argmin()]
        x = middle + np.outer(np.arange(count), [apart * d, 0.0, 0.0])
        return x, np.zeros_like(x)

    return make


def pair_start(simulation: Simulation, generator: np.random.Generator) -> Start:
    """A sinking column in which one particle stands a tenth of a spacing from another."""
    x, v = sinking_start(simulation, generator)
    i = int(np.linalg.norm(x - x.mean(axis=0), axis=1).argmin())
    j = int(np.argsort(np.linalg.norm(x - x[i], axis=1))[1])
    x[j] = x[i] + [0.1 * simulation.scene.discretization.spacing, 0.0, 0.0]
    return x, v


def fast_particle_start(simulation: Simulation, generator: np.random.Generator) -> Start:
    """A sinking column in which one particle is ten times as fast, and goes sideways."""
    x, v = sinking_start(simulation, generator)
    i = int(np.linalg.norm(x - x.mean(axis=0), axis=1).argmin())
    v[i] = 10.0 * np.linalg.norm(v[i]) * np.array([0.6, 0.0, 0.8])
    return x, v


def hole_start(simulation: Simulation, generator: np.random.Generator) -> Start:
    """A sinking column with a hole of two spacings' radius."""
    x, v = sinking_start(simulation, generator)
    d = simulation.scene.discretization.spacing
    keep = np.linalg.norm(x - x.mean(axis=0), axis=1) > 2.0 * d
    return x[keep], v[keep]


def nan_start(simulation: Simulation, generator: np.random.Generator) -> Start:
    """A sinking column in which one velocity is not a number."""
    x, v = sinking_start(simulation, generator)
    v[len(v) // 2, 0] = np.nan
    return x, v


# What must hold at the end, beside the rules


def check_rest(started: StartedRun) -> str:
    """Blood that has come to rest stays so: 2 % of the scene's speed."""
    v = started.run.simulation.velocities().astype(float)
    speed = math.sqrt((v**2).sum(axis=1).mean())
    limit = 0.02 * (started.run.simulation.derived.expected_speed or 1.0)
    return f"still moves at {speed:.2g} m/s" if speed > limit else ""


def check_free_fall(started: StartedRun) -> str:
    """What is alone falls freely, to a fifth of a spacing (a long step is ahead by g t T/2)."""
    simulation = started.run.simulation
    x, v = started.start
    gravity = np.asarray(simulation.scene.gravity)
    expected = (x + v * started.case.until + 0.5 * gravity * started.case.until**2).mean(axis=0)
    found = simulation.positions()
    if len(found) != len(x):
        return "left the vessel"
    apart = np.linalg.norm(found.mean(axis=0) - expected)
    apart /= simulation.scene.discretization.spacing
    return f"{apart:.2g} spacings from free fall" if apart > 0.2 else ""


def check_uniform_motion(started: StartedRun) -> str:
    """Blood in uniform motion keeps its form: 5 % of its speed."""
    v = started.run.simulation.velocities().astype(float)
    _, before = started.start
    mean = before.mean(axis=0)
    speed = math.sqrt(((v - mean) ** 2).sum(axis=1).mean()) / np.linalg.norm(mean)
    return f"velocities spread by {100 * speed:.0f} %" if speed > 0.05 else ""


CHANNEL = ("aortoiliac", 1.2e-3, 0.010)
"""The scene of most cases: some 900 particles."""
AORTA = shipped(*CHANNEL)
TANK = shipped("box", 2e-3)
WEIGHTLESS = shipped("box", 2e-3, 0.04, 0.0, gravity=(0.0, 0.0, 0.0))

CASES: tuple[Case, ...] = (
    Case("rest, no gravity", WEIGHTLESS, 0.46, check=check_rest),
    Case("standing column", TANK, 0.46, check=check_rest),
    Case("lone particle", AORTA, 0.03, particles_start(1, 0.0), check_free_fall),
    Case("two in contact", AORTA, 0.03, particles_start(2, 0.6), check_free_fall),
    Case("uniform motion", WEIGHTLESS, 0.01, ball_start(0.5), check_uniform_motion),
    Case("turned scene", turned(*CHANNEL), 0.15),
    Case("step x 0.5", AORTA, 0.15, step=0.5),
    Case("step x 2", AORTA, 0.15, step=2.0),
    Case("step x 4", AORTA, 0.15, step=4.0),
    Case("spacing x 0.75", AORTA, 0.15, spacing=0.75),
    Case("spacing x 1.25", AORTA, 0.15, spacing=1.25),
    Case("low column", shipped("aortoiliac", 1.2e-3, 0.004), 0.15),
    Case("high column", shipped("aortoiliac", 1.2e-3, 0.022), 0.15),
    Case("portal vein", shipped("portal_vein", 8e-4, 0.006), 0.3),
    Case("carotid siphon", shipped("carotid_siphon", 4.4e-4, 0.006), 0.15),
    Case("narrowed by 50 %", narrowed(50.0, 8e-4, 0.008), 0.15),
    Case("narrowed by 75 %", narrowed(75.0, 6e-4, 0.005), 0.15),
    Case("jet, 1 x speed", WEIGHTLESS, 0.03, ball_start(0.9)),
    Case("jet, 2 x speed", WEIGHTLESS, 0.03, ball_start(1.8)),
    Case("jet, 4 x speed", WEIGHTLESS, 0.03, ball_start(3.6)),
    Case("pair at 0.1 d", AORTA, 0.05, pair_start),
    Case("one at 10 x speed", AORTA, 0.05, fast_particle_start),
    Case("hole", AORTA, 0.05, hole_start),
    Case("one NaN", AORTA, 0.05, nan_start, must_fail_with="not finite"),
    Case("standing, 1000 x", TANK, 4.6, check=check_rest),
)
