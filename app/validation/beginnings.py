"""How a run begins: how much blood there is, and how still."""

import math

import msgspec
import numpy as np

from app.scenes.library import find_scene
from app.validation.flows import state_of
from app.validation.report import Report
from taichi_sph.assemble import initial_state
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation
from taichi_sph.waveform import RAMP_TIME

FULL = ("aorta_surgery", "carotid_surgery")
"""Scenes that begin full."""
COLUMN = "aortoiliac"
COARSER = (1.0, 1.25, 1.5, 2.0)
"""Spacings, times the scene's."""
FINE = 4.0
"""The lattice whose places tell a column's volume is so many times finer."""
PACKED = "blood out of order asks for more room than a lattice, and fills up as it flows"
UNEVEN = "blood that is let go parts where nothing holds it"
ENDS = 3.0
"""What is nearer to an end of the column has no blood beyond it [spacings]."""
INSTANT = 1e-9
"""A step in which nothing moves [s]."""
LOOKS = 10
"""Looks at the pressure while the drive sets in."""


def start_of_runs(report: Report, quick: bool) -> None:
    """Volume of the blood at the start, and pressure while the drive of a full vessel sets in."""
    scene = find_scene(COLUMN)
    vessel = read_vessel(scene)
    volume = column_volume(scene, vessel)
    for coarser in COARSER:
        spacing = coarser * scene.discretization.spacing
        grid = msgspec.structs.replace(scene.discretization, spacing=spacing)
        coarse = msgspec.structs.replace(scene, discretization=grid)
        count = len(initial_state(coarse, vessel).blood)
        report.compare(
            f"{COLUMN} at {1e3 * spacing:.3g} mm: volume of the column",
            1e9 * count * spacing**3, 1e9 * volume, 0.005, "mm^3",
        )  # fmt: skip
    report.add(*_evenness(Simulation.from_scene(scene)), 0.01, UNEVEN)
    names = FULL[:1] if quick else FULL
    for number, name in enumerate(names):
        scene = find_scene(name)
        simulation = Simulation.from_scene(scene)
        vessel = simulation.vessel
        held = int(vessel.contains(simulation.positions().astype(float)).sum())
        report.compare(
            f"{name}: volume of the blood in the lumen",
            1e9 * held * scene.discretization.spacing**3, 1e9 * vessel.volume, 0.005, "mm^3",
            PACKED,
        )  # fmt: skip
        most, asked = 0.0, 1.0
        for look in range(1, LOOKS + 1):
            simulation.advance_to(RAMP_TIME * look / LOOKS)
            report.advance((number + look / LOOKS) / len(names))
            highest = max(table.pressure or 0.0 for table in scene.openings.values())
            wanted = highest * look / LOOKS
            found = float(np.percentile(simulation.pressures(), 99))
            if found / wanted > most / asked:
                most, asked = found, wanted
        report.add(
            f"{name}: pressure in the first {RAMP_TIME:g} s, 99th percentile, when it is most over "
            "what is asked for (error: the ratio, less 1)",
            f"{most:.4g} Pa", f"{asked:.4g} Pa", max(0.0, most / asked - 1.0), 1.0,
        )  # fmt: skip


def _evenness(simulation: Simulation) -> tuple[str, str, str, float]:
    """Row of the density of a column before it falls, far from its ends."""
    scene = simulation.scene
    opening, spacing = simulation.vessel.opening(scene.column.opening), scene.discretization.spacing
    simulation.step(INSTANT)
    state = state_of(simulation)
    depth = (opening.centre - state.position) @ opening.normal
    inner = np.abs(depth - 0.5 * (depth.min() + depth.max())) < 0.5 * np.ptp(depth) - ENDS * spacing
    ratio = state.density[inner] / scene.blood.density
    return (
        f"{scene.name}: density at the start, {ENDS:g} spacings from the column's ends, 99th "
        "percentile of |rho/rho_0 - 1|",
        f"median {np.median(ratio):.4f}", "1",
        float(np.percentile(np.abs(ratio - 1.0), 99)),
    )  # fmt: skip


def column_volume(scene: Scene, vessel: Vessel) -> float:
    """Volume of the lumen in which a column of a height stands [m^3], from a finer lattice.

    Its places keep half their spacing from the wall; the layer that they leave out there is a
    volume of the wall's area beside them, which halves with the spacing: extrapolated.
    """
    finer = [scene.discretization.spacing / factor for factor in (0.5 * FINE, FINE)]
    coarse, fine = (len(vessel.fill_column(scene.column, d)) * d**3 for d in finer)
    assert scene.column.height is not None and math.isfinite(fine)
    return 2.0 * fine - coarse
