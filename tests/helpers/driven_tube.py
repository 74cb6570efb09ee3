"""A short tube of viscous blood, driven at both ends: by a pump at its top, a reservoir below."""

from pathlib import Path

import msgspec
import pytest

from app.scenes.centreline import Tube, make_surface
from meshes import RADIUS, write_scene
from taichi_sph.scene import Blood, NewtonianTable, OpeningTable
from taichi_sph.simulation import Simulation
from taichi_sph.waveform import STEADY, Waveform

D = 1.2e-3
LENGTH = 15e-3
"""Of the tube; its radius is 5 mm [m]."""
ENDS = {"top": (0.0, 0.0, 0.5 * LENGTH), "bottom": (0.0, 0.0, -0.5 * LENGTH)}
FLOW = 2e-5
DENSITY = 1060.0
VISCOSITY = 0.05
"""Fourteen times blood's, so that sound and stray flow die within 0.1 s [Pa s]."""
OF_ONE = D**3
"""Volume of a particle [m^3]."""


def make_tube(folder: Path, viscosity: float) -> Simulation:
    """A short tube full of blood, a pump at its top and a reservoir at its bottom."""
    mesh = make_surface(Tube(name="tube", radius=1e3 * RADIUS, length=1e3 * LENGTH, segments=48))
    scene = write_scene(folder, mesh, ENDS, 'opening = "top"\nfull = true', D)
    scene = msgspec.structs.replace(
        scene,
        gravity=(0.0, 0.0, 0.0),
        openings={
            "top": OpeningTable(centre=ENDS["top"], flow=FLOW),
            "bottom": OpeningTable(centre=ENDS["bottom"], pressure=0.0),
        },
        blood=Blood(density=DENSITY, rheology=NewtonianTable(viscosity=viscosity)),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        return Simulation.from_scene(scene)


def drive(
    sim: Simulation, name: str, flow: float | None = None, pressure: float | None = None,
    waveform: Waveform = STEADY,
) -> None:  # fmt: skip
    """Let a pump or a reservoir drive an opening."""
    inlet = next(p for p in sim.inflow.openings if p.opening.name == name)
    inlet.flow, inlet.pressure, inlet.waveform = flow, pressure, waveform


def area(sim: Simulation) -> float:
    """Cross-section of a buffer: a square spacing a strand [m^2]."""
    return len(sim.inflow.openings[0].sites) * D**2
