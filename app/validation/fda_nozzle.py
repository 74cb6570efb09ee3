"""The FDA's benchmark nozzle at a throat Reynolds number of 500, beside five laboratories.

The scene `fda_nozzle` is poured as any scene is, and its flow averaged once it has set in.  Mean
and standard deviation of what the laboratories measured by particle image velocimetry are derived
from SE_exp_0500.zip of github.com/OSEL-DAM/CFD-and-Blood-Damage-Benchmarks
(doi:10.17917/C78G69), a work of the US Food and Drug Administration in the public domain; see
Hariharan et al. 2011, doi:10.1115/1.4003440, and Stewart et al. 2012,
doi:10.1007/s13239-012-0087-5.
z = 0 is the expansion.

The run keeps its state in the cache every few minutes and goes on from there when it was stopped.
"""

import contextlib
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from app import version
from app.files import console
from app.run.checkpoint import Checkpoint
from app.scenes.library import find_scene, varied
from app.validation import flows
from app.validation.report import Curve, Report
from taichi_sph.boundary.boundary import Boundary
from taichi_sph.errors import InputError
from taichi_sph.geometry.mesh import Floats
from taichi_sph.geometry.wall_sampling import cache_file
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation

AXIS = {
    -88: (0.0871, 0.0041), -64: (0.0878, 0.0018), -20: (0.680, 0.023), -8: (0.733, 0.030),
    0: (0.728, 0.022), 8: (0.726, 0.019), 16: (0.703, 0.022), 24: (0.667, 0.011),
    32: (0.638, 0.011), 40: (0.625, 0.014), 48: (0.615, 0.015), 60: (0.537, 0.057),
}  # fmt: skip
"""By z [mm]: speed on the axis and its standard deviation [m/s]."""
WIDTH = {0: 2.96, 8: 2.95, 16: 2.99, 24: 3.05, 32: 3.13}
"""By z [mm]: width of the jet, where it has half of its speed on the axis [mm]."""
RADII = (0.0, 0.5, 1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0, 5.0, 5.5)
"""Of the profiles [mm]."""
PROFILES = {
    0: (0.728, 0.701, 0.588, 0.486, 0.351, 0.190, 0.039),
    8: (0.726, 0.693, 0.569, 0.467, 0.350, 0.237, 0.147, 0.044, 0.005, -0.018, -0.015, -0.009),
    16: (0.703, 0.665, 0.541, 0.450, 0.349, 0.255, 0.175, 0.071, 0.018, -0.022, -0.021, -0.013),
    32: (0.637, 0.596, 0.486, 0.414, 0.338, 0.265, 0.201, 0.101, 0.035, -0.026, -0.032, -0.020),
}  # fmt: skip
"""By z [mm]: speed along the axis at RADII [m/s]."""
WALL_PRESSURE = {-63: (389, 31), -40: (111, 18), -30: (40, 12), -20: (-16, 15), -10: (-107, 3)}
"""By z [mm]: pressure at the wall over that at z = 32, and its standard deviation [Pa]."""
REFERENCE = 32
"""z at which the pressure at the wall counts as zero [mm]."""
FLOW = 5.20624e-6
"""Q [m^3/s]."""
CUTS = (-70, -66, -55, -45, -35, -25, -15, -5, 5, 15, 25, 35)
"""z of the cuts that blood is counted through [mm]."""
HELD = (-8, 0, 8, 16, 24, 32)
"""z where the axis is held against the laboratories [mm]."""
BINS = 28
"""Rings of a profile, a quarter of a millimetre wide each."""
RING = 0.25e-3
"""[m]"""
HALF = 1.0
"""A profile is of blood within so many spacings of its z."""
SIDES = 4
"""Quarters of a section that are held against each other."""
ENDS, AVERAGED = 0.5, 0.1
"""The run ends at a time, of which it is averaged over the last part [s]."""
LOOK = 0.005
"""Time between two looks [s]."""
KEPT = 10
"""Looks between two checkpoints."""
QUICK = 8e-4
"""Spacing of a quick run [m]."""


STATIONS = tuple(sorted({*AXIS, *WIDTH, *PROFILES, *WALL_PRESSURE, *CUTS, REFERENCE}))
"""All z [mm] at which a profile is taken."""
ROW = {z: row for row, z in enumerate(STATIONS)}
"""Row of each."""
LABORATORIES = "five laboratories, mean"


@dataclass(frozen=True)
class Means:
    """Means over the looks, a row a station."""

    speed: Floats
    """Along the axis, by quarter and ring, NaN where there was no blood [m/s], (n, SIDES, BINS)."""
    axis: Floats
    """Along the axis on it [m/s], (n,)."""
    flow: Floats
    """Through the section [m^3/s], (n,)."""
    wall_pressure: Floats
    """At the wall [Pa], (n,)."""

    def profile(self, row: int) -> Floats:
        """Speed over the rings, all quarters together [m/s], (BINS,)."""
        found = np.full(BINS, np.nan)
        some = np.isfinite(self.speed[row]).any(axis=0)
        found[some] = np.nanmean(self.speed[row][:, some], axis=0)
        return found


class Survey(Boundary):
    """Sums over looks of what is held against the laboratories; it acts on nothing."""

    name = "survey"

    def __init__(self, spacing: float):
        """Nothing is summed yet; spacing of the blood [m]."""
        self.spacing = spacing
        self.reset()

    def reset(self) -> None:
        """Nothing is summed."""
        n = len(STATIONS)
        self.looks = 0
        self.sums = np.zeros((2, n, SIDES, BINS))
        """Of the speeds [m/s], and of particles."""
        self.near_axis = np.zeros((n, 3, 3))
        """Of products of (1, r^2, u): the axis' speed is where a parabola in r meets it."""
        self.flow = np.zeros(n)
        """[m^3/s]"""
        self.pressure = np.zeros((2, n))
        """Of the pressures at the wall [Pa], and of particles."""

    def save_state(self) -> dict[str, Any]:
        """The sums."""
        return {
            "looks": self.looks, "sums": self.sums, "near_axis": self.near_axis,
            "flow": self.flow, "wall_pressure": self.pressure,
        }  # fmt: skip

    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from saved sums."""
        self.looks = int(saved["looks"])
        self.sums, self.near_axis = saved["sums"].copy(), saved["near_axis"].copy()
        self.flow, self.pressure = saved["flow"].copy(), saved["wall_pressure"].copy()

    def look(self, x: Floats, v: Floats, pressure: Floats) -> None:
        """Add positions [m], velocities [m/s], (n, 3), and pressures [Pa], (n,)."""
        d = self.spacing
        r = np.hypot(x[:, 0], x[:, 1])
        side = (np.arctan2(x[:, 1], x[:, 0]) // (0.5 * math.pi)).astype(int) % SIDES
        ring = np.minimum((r / RING).astype(int), BINS - 1)
        for row, z in enumerate(STATIONS):
            here = np.abs(x[:, 2] - 1e-3 * z) < HALF * d
            place = side[here], ring[here]
            np.add.at(self.sums[0, row], place, v[here, 2])
            np.add.at(self.sums[1, row], place, 1.0)
            self.flow[row] += d**3 * v[here, 2].sum() / (2.0 * HALF * d)
            core = here & (r < 1e-3)
            basis = np.column_stack([np.ones(core.sum()), 1e6 * r[core] ** 2, v[core, 2]])
            self.near_axis[row] += basis.T @ basis
            outermost = here & (r > r[here].max(initial=0.0) - 1.5 * d)
            self.pressure[:, row] += pressure[outermost].sum(), outermost.sum()
        self.looks += 1

    def means(self) -> Means:
        """Means over all looks."""
        with np.errstate(invalid="ignore"):
            speed = self.sums[0] / self.sums[1]
            pressure = self.pressure[0] / self.pressure[1]
        axis = [
            np.linalg.lstsq(products[:2, :2], products[:2, 2], rcond=None)[0][0]
            for products in self.near_axis
        ]
        return Means(speed, np.array(axis), self.flow / self.looks, pressure)


def half_width(profile: Floats, axis: float) -> float:
    """Diameter at which a profile over rings has half the axis' speed [m]."""
    r = RING * (np.arange(BINS) + 0.5)
    known = np.isfinite(profile)
    r, u = r[known], profile[known]
    below = int(np.argmax(u < 0.5 * axis))
    if u[below] >= 0.5 * axis:
        return math.nan
    if below == 0:
        return 2.0 * float(r[0])
    share = (u[below - 1] - 0.5 * axis) / (u[below - 1] - u[below])
    return 2.0 * float(r[below - 1] + share * (r[below] - r[below - 1]))


def _facts(scene: Scene, ends: float, averaged: float) -> dict[str, Any]:
    return {"version": version(), "scene_text": scene.text, "spacing": scene.discretization.spacing,
            "stations": list(STATIONS), "ends": ends, "averaged": averaged}  # fmt: skip


def survey(report: Report, scene: Scene, ends: float, averaged: float) -> tuple[Survey, Simulation]:
    """Pour the nozzle until a time [s] and average over the last part of it [s]."""
    simulation = Simulation.from_scene(scene)
    measured = Survey(scene.discretization.spacing)
    simulation.boundaries = (*simulation.boundaries, measured)
    path = cache_file("validation", f"{scene.name}-{1e6 * scene.discretization.spacing:.0f}um")
    facts, begun = _facts(scene, ends, averaged), 0
    with contextlib.suppress(InputError):  # none there, or of another run: begin at the beginning
        kept = Checkpoint.read(path)
        kept.require(facts, path)
        simulation.load_state(kept.state)
        begun = kept.frame
        console(sys.stderr).print(
            f"{scene.name}: goes on from {simulation.time:g} s, kept in {path}; delete it to begin "
            "again",
            soft_wrap=True,
        )
    looks = round(ends / LOOK)
    for look in range(begun + 1, looks + 1):
        simulation.advance_to(look * LOOK)
        if simulation.time > ends - averaged + 0.5 * LOOK:
            x, v = (a.astype(float) for a in simulation.positions_and_velocities())
            measured.look(x, v, simulation.pressures())
        if look % KEPT == 0:
            _keep(path, Checkpoint(facts, look, simulation.save_state()))
        report.advance(look / looks)
    path.unlink(missing_ok=True)
    return measured, simulation


def _keep(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; a cache that cannot be written is no error."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        checkpoint.write(path)


def nozzle(report: Report, quick: bool) -> None:
    """Axis, jet, profiles, flow and pressure of the nozzle against five laboratories."""
    scene = find_scene("fda_nozzle")
    ends, averaged = ENDS, AVERAGED
    if quick:
        scene, ends, averaged = varied(scene, None, QUICK), 0.3, 0.05
    measured, simulation = survey(report, scene, ends, averaged)
    case = f"FDA nozzle, Re 500, {4e-3 / scene.discretization.spacing:.0f} across the throat"
    means = measured.means()
    _hold_jet(report, case, means)
    _hold_flow(report, case, means)
    _hold_profiles(report, case, means)
    _hold_wall_pressure(report, case, means)
    leaks = simulation.diagnostics().leaks
    report.add(f"{case}: particles outside", f"{leaks}", "0", float(leaks), 0.0)


def _hold_jet(report: Report, case: str, means: Means) -> None:
    for z in HELD:
        (u, deviation), found = AXIS[z], means.axis[ROW[z]]
        report.add(
            f"{case}: speed on the axis at z = {z} mm",
            f"{found:.3f} m/s", f"{u:.3f} ({deviation:.3f}) m/s",
            abs(found / u - 1.0), max(2.0 * deviation / u, 0.06), flows.RESISTING,
        )  # fmt: skip
    for z, width in WIDTH.items():
        wide = half_width(means.profile(ROW[z]), float(means.axis[ROW[z]]))
        report.compare(
            f"{case}: width of the jet at z = {z} mm", 1e3 * wide, width, 0.06, "mm",
            flows.RESISTING,
        )  # fmt: skip
    shown = [z for z in AXIS if z >= CUTS[0]]
    report.draw(
        "fda-nozzle-axis", "z [mm]", "u [m/s]",
        Curve("on the axis", np.array(shown), np.array([means.axis[ROW[z]] for z in shown]),
              np.array(shown), np.array([AXIS[z][0] for z in shown]), LABORATORIES),
    )  # fmt: skip


def _hold_flow(report: Report, case: str, means: Means) -> None:
    flow = np.array([means.flow[ROW[z]] for z in CUTS]) / FLOW
    worst = int(np.abs(flow - 1.0).argmax())
    report.add(
        f"{case}: flow through {len(CUTS)} cuts, the worst at z = {CUTS[worst]} mm",
        f"{flow.min():.3f} to {flow.max():.3f} Q", "1 Q", abs(flow[worst] - 1.0), 0.02,
    )  # fmt: skip
    row = ROW[8]
    sides = np.nanmean(means.speed[row][:, : round(2e-3 / RING)], axis=1)
    report.add(
        f"{case}: quarters of the jet at z = 8 mm, r < 2 mm (error: the largest difference over "
        "the axis' speed)",
        f"{sides.min():.3f} to {sides.max():.3f} m/s", "alike",
        float(np.ptp(sides) / means.axis[row]), 0.03,
    )  # fmt: skip


def _hold_profiles(report: Report, case: str, means: Means) -> None:
    errors = []
    for z, speeds in PROFILES.items():
        measured, radii = np.array(speeds), np.array(RADII[: len(speeds)])
        profile = means.profile(ROW[z])
        known = np.isfinite(profile)
        centres = 1e3 * RING * (np.arange(BINS) + 0.5)[known]
        found = np.interp(radii, centres, profile[known])
        found[0] = means.axis[ROW[z]]
        errors.append(np.abs(measured - found) / np.abs(measured))
        report.draw(
            "fda-nozzle", "r [mm]", "u [m/s]",
            Curve(f"z = {z} mm", centres, profile[known], radii, measured, LABORATORIES),
        )  # fmt: skip
    mean = float(np.concatenate(errors).mean())
    report.add(
        f"{case}: E_g, the mean of |(u_exp - u)/u_exp| over the profiles (28 groups' laminar "
        "codes: 0.34)",
        f"{mean:.2f}", "0", mean, 0.34, flows.RESISTING,
    )  # fmt: skip


def _hold_wall_pressure(report: Report, case: str, means: Means) -> None:
    zero, highest = means.wall_pressure[ROW[REFERENCE]], WALL_PRESSURE[-63][0]
    for z, (pressure, deviation) in WALL_PRESSURE.items():
        found = means.wall_pressure[ROW[z]] - zero
        report.add(
            f"{case}: pressure at the wall at z = {z} mm over that at {REFERENCE} mm (error: over "
            f"the {highest} Pa at -63 mm)",
            f"{found:.0f} Pa", f"{pressure} ({deviation}) Pa",
            abs(found - pressure) / highest, max(2.0 * deviation / highest, 0.1),
        )  # fmt: skip
