"""Cases of `vesselflow validate` about what is done to blood: pumps, wounds, tools."""

import math
import tempfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import trimesh

from app.scenes.library import find_scene
from app.validation.report import Report
from taichi_sph.boundary.datum import CHANGE_TIME
from taichi_sph.boundary.tool import RESPONSE_TIME
from taichi_sph.geometry.mesh import enclosed_volume
from taichi_sph.scene import Column, NewtonianTable, Scene, ToolTable, WallTable
from taichi_sph.simulation import Simulation
from taichi_sph.waveform import RAMP_TIME

DISCHARGE = 0.61
"""Coefficient of a sharp-edged orifice."""

IN_A_TUBE = 5.97
"""Drag of a sphere half as wide as its tube over Stokes' (Haberman and Sayre 1958); the tank of
`tool` is square and as wide."""

change = msgspec.structs.replace


def _tube(spacing: float, top: dict[str, Any], bottom: dict[str, Any]) -> Scene:
    """The straight tube, full, without gravity, driven at its ends."""
    scene = find_scene("tube")
    return change(
        scene,
        openings={
            "top": change(scene.openings["top"], **top),
            "bottom": change(scene.openings["bottom"], **bottom),
        },
        column=Column(opening="top", full=True),
        gravity=(0.0, 0.0, 0.0),
        discretization=change(scene.discretization, spacing=spacing),
    )


def _watch(simulation: Simulation, until: float, report: Report, begin: float, end: float) -> None:
    """Advance, telling progress between two fractions."""
    since = simulation.time
    for k in range(1, 21):
        simulation.advance_to(since + (until - since) * k / 20.0)
        report.advance(begin + (end - begin) * k / 20.0)


def account(report: Report, quick: bool) -> None:
    """A pump at one end, a reservoir at the other: no blood is made or lost."""
    flow, until = 1e-5, 0.1 if quick else 0.2
    simulation = Simulation.from_scene(_tube(1e-3, {"flow": flow}, {"pressure": 0.0}))
    begun = int(simulation.particles.count[None])
    # Until it has set in, the reservoir gives blood too.
    _watch(simulation, RAMP_TIME, report, 0.0, RAMP_TIME / until)
    pump = simulation.inflow.openings[0]
    before, volume_before = simulation.inflow.added, pump.volume_in
    _watch(simulation, until, report, RAMP_TIME / until, 1.0)
    # What is marked as gone is dropped at the next build.
    live = int((simulation.identities() >= 0).sum())
    left = int(simulation.outlets.outflow_counts().sum())
    wrong = live - (begun + simulation.inflow.added - left)
    report.add(
        f"pump and reservoir, {until:g} s: blood there (error: particles)", f"{live}",
        f"{begun} + {simulation.inflow.added} - {left}", abs(wrong), 0.0,
    )  # fmt: skip
    volume = simulation.scene.discretization.spacing**3
    added, driven = simulation.inflow.added - before, pump.volume_in - volume_before
    report.add(
        f"pump: volume added after {RAMP_TIME:g} s (error: particles)",
        f"{1e6 * added * volume:.4f} ml", f"{1e6 * driven:.4f} ml", abs(added - driven / volume),
        # Blood is added when lists are built, which is when it has moved half a skin, a tenth of a
        # spacing; the strands' phases are even to within two.
        0.1 * len(pump.sites) + 2.0,
    )  # fmt: skip


def wound(report: Report, quick: bool) -> None:
    """A hole in a vessel under venous pressure, 10 mmHg, beside the orifice formula."""
    pressure, radius = 1333.0, 1.5e-3
    spacing = 9e-4 if quick else 8e-4
    scene = _tube(spacing, {"pressure": pressure}, {"pressure": pressure})
    simulation = Simulation.from_scene(scene)
    _watch(simulation, 0.06, report, 0.0, 0.6)
    hole = simulation.wounds.open(np.array([5e-3, 0.0, 0.0]), radius)
    # It feels the whole pressure once the datum is taken back.
    steady = 0.06 + 1.5 * CHANGE_TIME
    _watch(simulation, steady, report, 0.6, 0.7)
    before = simulation.diagnostics().bled_volume
    _watch(simulation, steady + 0.02, report, 0.7, 1.0)
    rate = (simulation.diagnostics().bled_volume - before) / 0.02
    theory = DISCHARGE * hole.area * math.sqrt(2.0 * pressure / scene.blood.density)
    report.add(
        f"wound of 3 mm, {2e3 * radius / (1e3 * spacing):.1f} spacings, at 10 mmHg: rate "
        "(error: the factor, less 1)",
        f"{6e7 * rate:.0f} ml/min", f"{6e7 * theory:.0f} ml/min",
        max(rate / theory, theory / max(rate, 1e-30)) - 1.0, 1.0,
    )  # fmt: skip


def pulse(report: Report, quick: bool) -> None:
    """A vessel shut at one end whose wall moves out and in: blood follows by the other end."""
    swing, beat, pressure = 3e-4, 0.1, 600.0
    spacing = 1e-3 if quick else 7e-4
    scene = _tube(spacing, {"pressure": pressure}, {"state": "capped"})
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "beat.csv"
        time = np.linspace(0.0, beat, 101)
        level = 0.5 - 0.5 * np.cos(2.0 * math.pi * time / beat)
        np.savetxt(file, np.stack([time, level], axis=1), delimiter=",")
        blood = change(scene.blood, rheology=NewtonianTable(viscosity=0.02))
        wall = WallTable(pulse=swing, waveform=str(file))
        simulation = Simulation.from_scene(change(scene, wall=wall, blood=blood))
    # The lumen fills and rings in the first beat.
    _watch(simulation, 2.5 * beat, report, 0.0, 0.8)
    wide = len(simulation.identities())
    _watch(simulation, 3.0 * beat, report, 0.8, 1.0)
    moved = (wide - len(simulation.identities())) * spacing**3
    top, bottom = simulation.vessel.openings
    z = np.linspace(bottom.centre[2], top.centre[2], 2001)
    share = np.clip((top.centre[2] - np.abs(z)) / top.radius, 0.0, 1.0)
    radius = top.radius + swing * share**2 * (3.0 - 2.0 * share)
    room = float(np.trapezoid(math.pi * (radius**2 - top.radius**2), z))
    report.compare(
        f"wall that moves out by {1e3 * swing:.1f} mm and back: blood driven out",
        1e6 * moved, 1e6 * room, 0.05, "ml",
    )  # fmt: skip


def _tank_with_sphere(radius: float, viscosity: float) -> Simulation:
    """A tank of blood, as deep as it is wide and twice, round a sphere [m]."""
    scene = find_scene("box")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sphere.ply"
        trimesh.creation.icosphere(3, radius).export(file)
        scene = change(
            scene,
            tool=ToolTable(surface=str(file), position=(0.0, 0.0, 0.0)),
            column=Column(opening="top", height=0.032, offset=0.008),
            blood=change(scene.blood, rheology=NewtonianTable(viscosity=viscosity)),
        )
        return Simulation.from_scene(scene)


def tool(report: Report, quick: bool) -> None:
    """A sphere in a tank: it is lifted by the weight of the blood it displaces, and dragged."""
    radius, thick, speed = 4e-3, 0.5, 0.05
    simulation = _tank_with_sphere(radius, 0.05)
    blood, gravity = simulation.scene.blood, -simulation.scene.gravity[2]
    _watch(simulation, 0.12, report, 0.0, 0.5)
    simulation.tool.take_force()
    _watch(simulation, 0.16, report, 0.5, 0.6)
    surface = simulation.tool.surface
    assert surface is not None
    weight = enclosed_volume(surface.vertices, surface.faces) * blood.density * gravity
    lift = float(simulation.tool.take_force()[2])
    report.compare("sphere of 8 spacings in a tank: lift", 1e3 * lift, 1e3 * weight, 0.05, "mN")

    simulation = _tank_with_sphere(radius, thick)
    _watch(simulation, 0.08, report, 0.6, 0.8)
    lift = float(simulation.tool.take_force()[2])

    def go_down() -> None:
        place = simulation.tool.position
        simulation.tool.move_to(place - np.array([0.0, 0.0, speed * RESPONSE_TIME]))

    simulation.advance_to(0.12, go_down)
    simulation.tool.take_force()
    simulation.advance_to(0.16, go_down)
    report.advance(1.0)
    drag = float(simulation.tool.take_force()[2]) - lift
    theory = IN_A_TUBE * 6.0 * math.pi * thick * radius * speed
    report.add(
        "the sphere moved through thick blood: drag (error: the factor, less 1)",
        f"{1e3 * drag:.3g} mN", f"{1e3 * theory:.3g} mN (in a round tube)",
        max(drag / theory, theory / max(drag, 1e-30)) - 1.0, 1.0,
    )  # fmt: skip
