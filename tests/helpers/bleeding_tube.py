"""A tube under pressure that wounds may be made in, and what must hold for it at all times."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh

from app.scenes.centreline import Tube, make_surface
from meshes import write_scene
from taichi_sph.scene import Blood, NewtonianTable, OpeningTable, ToolTable
from taichi_sph.simulation import Simulation

D = 1.2e-3
RADIUS, LENGTH = 5e-3, 20e-3
"""Of the tube [m]."""
ENDS = {"top": (0.0, 0.0, 0.5 * LENGTH), "bottom": (0.0, 0.0, -0.5 * LENGTH)}
PRESSURE = 300.0
DENSITY = 1060.0
OF_ONE = D**3
"""Volume of a particle [m^3]."""
HOLE = 2.0 * D
"""Radius of a wound [m]."""
SIDE = np.array([RADIUS, 0.0, 1e-3])
"""On the tube's wall [m]."""


def make_bleeding_tube(folder: Path) -> Simulation:
    """A tube under pressure from its top, closed at its bottom, a ball in it as the tool."""
    mesh = make_surface(Tube(name="tube", radius=1e3 * RADIUS, length=1e3 * LENGTH, segments=48))
    scene = write_scene(folder, mesh, ENDS, 'opening = "top"\nfull = true', D)
    trimesh.creation.icosphere(subdivisions=2, radius=2e-3).export(folder / "tool.ply")
    scene = msgspec.structs.replace(
        scene,
        gravity=(0.0, 0.0, -9.81),
        openings={
            "top": OpeningTable(centre=ENDS["top"], pressure=PRESSURE),
            "bottom": OpeningTable(centre=ENDS["bottom"], state="capped"),
        },
        blood=Blood(density=DENSITY, rheology=NewtonianTable(viscosity=3.5e-3)),
        tool=ToolTable(surface="tool.ply", position=(0.0, 0.0, -5e-3)),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        return Simulation.from_scene(scene)


def wall_of(sim: Simulation) -> list[np.ndarray]:
    """All that blood knows of the wall and the tool: rows that no list can name are left out."""
    w, lists = sim.wall, sim.neighbors.proxies
    starts = lists.cell_start.to_numpy()
    named = np.r_[: starts[-1], w.count : w.count + w.tool]
    rows = [f.to_numpy()[named] for f in (w.position, w.normal, w.volume, w.velocity)]
    return [*rows, *(f.to_numpy()[: starts[-1]] for f in (lists.x, lists.y, lists.z)), starts]


def assert_same(one: list[np.ndarray], other: list[np.ndarray]) -> None:
    for a, b in zip(one, other, strict=True):
        assert a.tobytes() == b.tobytes()


def assert_account_is_whole(sim: Simulation) -> None:
    names = sim.particles.identity.to_numpy()[: sim.particles.count[None]]
    live = int((names >= 0).sum())
    assert live == sim.derived.blood_particles + sim.inflow.added - int(
        sim.outlets.outflow_counts().sum()
    )
