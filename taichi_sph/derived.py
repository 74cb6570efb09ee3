"""Numbers that follow from a scene; printed, never typed."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taichi_sph.boundary.wall_motion import read_wall_motion
from taichi_sph.fluid.model import stable_step_limits
from taichi_sph.fluid.rheology import make_rheology
from taichi_sph.geometry.vessel import Vessel
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.scene import Scene
from taichi_sph.waveform import RAMP_TIME, read_waveform


@dataclass(frozen=True)
class Derived:
    """What a scene amounts to."""

    blood_particles: int
    proxy_particles: int
    support_radius: float
    """R [m]."""
    expected_speed: float
    """See the function of that name [m/s]."""
    sound_speed: float
    """c [m/s]: the scene's ratio times the expected speed."""
    quiet_speed: float | None
    """Of a closed scene, see the function of that name [m/s]; else None."""
    step: float
    """Time step of the physics at the expected speed, or the quiet one [s], before force limits."""
    reynolds_number: float
    """rho U D / eta at that speed and the narrowest opening's diameter."""
    particles_across_narrowest: float
    """Diameter of the narrowest opening over the spacing."""


def expected_speed(scene: Scene, vessel: Vessel) -> float:
    """Largest speed that the scene's drive can give blood [m/s].

    Of a free fall through the whole lumen and, where openings are driven, of a jet under the
    difference of the highest and the lowest pressure, that outside among them,
    sqrt(2 (g H + p/rho)), or of a parabolic profile of all that flows, 2 Q/A, in the narrowest
    place, whichever is more; and with a wall that pulses, beside either, of what it drives out
    through all open openings.
    """
    gravity = np.asarray(scene.gravity)
    g = float(np.linalg.norm(gravity))
    head = 0.0
    if g > 0.0:
        along = vessel.vertices @ (gravity / g)
        head = g * float(along.max() - along.min())
    pressures = [(0.0, 0.0), *_reservoir_pressures(scene)]
    span = max(high for _, high in pressures) - min(low for low, _ in pressures)
    jet = math.sqrt(2.0 * (head + span / scene.blood.density))
    flow, squeezed = _largest_flow(scene)[0], _squeezed(scene, vessel)
    if flow > 0.0:
        jet = max(jet, 2.0 * flow / (0.25 * math.pi * vessel.narrowest**2))
    if squeezed > 0.0:
        area = sum(opening.area for opening in vessel.openings if opening.is_open)
        jet += 2.0 * squeezed / area if area else squeezed / vessel.wall_area
    return jet


def is_closed(scene: Scene) -> bool:
    """Whether blood fills the lumen and no opening leads outside, but one at least to a reservoir.

    Only differences of pressure move blood then, until a wound is opened.  Where the wall pulses,
    blood follows it by the whole pressure: such a vessel is not closed.
    """
    uncapped = [table for table in scene.openings.values() if table.state == "open"]
    return (
        scene.column.full
        and scene.wall is None
        and all(table.driven for table in uncapped)
        and any(table.pressure is not None for table in uncapped)
    )


def quiet_speed(scene: Scene, vessel: Vessel) -> float:
    """Largest speed U_q that the drive of a closed scene asks sound to suit, unwounded [m/s].

        U_q^2 = (2 Q/A)^2 + 2 (p/rho + L (dQ/dt)/A)

    of a parabolic profile of all that pumps drive through the reservoirs' openings, of the
    difference of the reservoirs' pressures, and of what accelerates a column as long as the vessel.
    In a vessel that does not branch no less than 2 Q/A in its narrowest place: c then stays as it
    is while the flow sets in, for a change of c changes the pressure of all blood.
    """
    pressures = list(_reservoir_pressures(scene))
    span = max(high for _, high in pressures) - min(low for low, _ in pressures)
    tables = scene.openings
    ends = [o for o in vessel.openings if o.name in tables and tables[o.name].pressure is not None]
    area = sum(opening.area for opening in ends)
    flow, change = _largest_flow(scene)
    low, high = vessel.bounds
    column = float((high - low).max()) * change / area
    head = span / scene.blood.density + column
    speed = math.hypot(2.0 * flow / area, math.sqrt(2.0 * head))
    if len(vessel.openings) == 2:
        speed = max(speed, 2.0 * flow / (0.25 * math.pi * vessel.narrowest**2))
    # Where only a wound lets blood flow: as fast as out of it.
    return speed or math.inf


def _reservoir_pressures(scene: Scene) -> Iterator[tuple[float, float]]:
    """Lowest and highest pressure of each reservoir in a beat [Pa]."""
    for table in scene.openings.values():
        if table.pressure is not None:
            pressure = read_waveform(table.waveform, Path(scene.folder)).factor * table.pressure
            yield float(pressure.min()), float(pressure.max())


def _largest_flow(scene: Scene) -> tuple[float, float]:
    """Sums of what pumps drive at their peaks [m^3/s], and of its steepest change [m^3/s^2]."""
    flow = change = 0.0
    for table in scene.openings.values():
        if table.flow is not None:
            wave = read_waveform(table.waveform, Path(scene.folder))
            flow += float(np.abs(wave.factor * table.flow).max())
            slope = np.abs(np.diff(wave.factor) / np.diff(wave.time)).max(initial=0.0)
            change += abs(table.flow) * max(float(slope), 1.0 / RAMP_TIME)
    return flow, change


def _squeezed(scene: Scene, vessel: Vessel) -> float:
    """What a wall that pulses drives out at its fastest [m^3/s]."""
    motion = read_wall_motion(scene, vessel)
    return 0.0 if motion is None else vessel.wall_area * motion.amplitude * motion.peak_rate


def derive(scene: Scene, vessel: Vessel, blood_count: int, proxy_count: int) -> Derived:
    """Work out the derived numbers of a scene in its vessel."""
    grid = scene.discretization
    radius = grid.support_ratio * grid.spacing
    speed = expected_speed(scene, vessel)
    # Without gravity nothing drives the blood but itself: 1 m/s, an arterial speed, then.
    sound = grid.sound_speed_ratio * (speed or 1.0)
    quiet = min(quiet_speed(scene, vessel), speed or 1.0) if is_closed(scene) else None
    usual = speed if quiet is None else quiet
    limits = stable_step_limits(
        WendlandC2(radius).smoothing_length, scene.blood.density,
        make_rheology(scene.blood.rheology).largest_viscosity,
        grid.sound_speed_ratio * (usual or 1.0), grid.courant_number, usual,
    )  # fmt: skip
    narrowest = 2.0 * min((o.radius for o in vessel.openings), default=math.nan)
    return Derived(
        blood_particles=blood_count,
        proxy_particles=proxy_count,
        support_radius=radius,
        expected_speed=speed,
        sound_speed=sound,
        quiet_speed=quiet,
        step=limits.smallest,
        reynolds_number=scene.blood.density * usual * narrowest / scene.blood.rheology.viscosity,
        particles_across_narrowest=narrowest / grid.spacing,
    )
