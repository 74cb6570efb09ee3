"""Settling: blood at the start, brought to rest under its own pressure before a run.

A lattice that is cut to the lumen leaves a void of up to half a spacing at the wall, and other
blood at every spacing.  A finer lattice with as many particles as there is room for is let go:

    v_i += a_i dt,   x_i += (v_i + w_i) dt,   v_i *= 0.9,   dt = C h_s/c,   |a_i| <= 0.01 d/dt^2

under the physics without gravity, for STEPS steps.  Blood in the buffers of driven
openings stays where it is.  A column does not rise above its opening; its other end is free,
and sinks a little.  A full lumen gives no way, and blood out of order asks for more room than a
lattice: what then has none is left out, and what has gone into a buffer.
"""

import contextlib
import hashlib
import zipfile
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import taichi as ti

from taichi_sph.boundary.boundary import BloodFlow
from taichi_sph.fluid.model import Fluid
from taichi_sph.fluid.wcsph import SphAcceleration
from taichi_sph.geometry.mesh import Floats
from taichi_sph.geometry.wall_sampling import cache_file
from taichi_sph.integrator import kick_drift
from taichi_sph.system import replaced

ALGORITHM = 3
"""Change it when the positions change: it is part of the cache's key."""
STEPS = 100
"""Of a full lumen: after 40 the mean density is 1.010 of rho_0 in `aorta_surgery`, after 400 1.006.
A column takes as many again until it is CALM."""
MOST_STEPS = 1000
"""Of a column."""
CALM = 1.0
"""99.9th percentile of rho/rho_0 in a column that has settled."""
LOOSENED = 0.003
"""A column is let go with this part of rho_0 c^2 as a background pressure, until its density is as
much under rho_0: without it every last trace of pressure, rho_0 c^2 a thousandth, is some ten g."""
MOST_EXCESS = 0.01
"""Excess of the median of the density over rho_0 that stays: flow finds the room."""
KEPT = 0.9
"""Part of the velocity that a step keeps."""
MOST_MOVED = 0.01
"""Farthest that an acceleration moves blood in a step [spacings]: places of a much finer lattice,
as in a narrow tube, are under a pressure that would throw it out of the vessel."""
CACHE_FROM = 500
"""Particles from which it is worth a file."""


@dataclass(frozen=True)
class Plane:
    """A plane that blood stays below."""

    point: Floats
    """Of the plane [m], (3,)."""
    normal: Floats
    """Unit normal, upwards, (3,)."""


NOWHERE = Plane(np.zeros(3), np.zeros(3))
"""No plane: everything is below it."""


def settle(
    blood: BloodFlow, fluid: Fluid, inflow: Any, count: int, top: Plane | None = None
) -> Floats:
    """Positions of the settled blood [m], (n, 3), in order of identity; from the cache if there.

    Args:
        blood: at its start; its positions are replaced, its velocities are zero.
        fluid: constants of the sums.
        inflow: the `BufferZones`, whose blood stays.
        count: of the particles in the lumen, the first; those of buffers follow.
        top: what a column stays below; None where the lumen is full.
    """
    particles = blood.particles
    start = particles.in_order(particles.position)
    key = _key(start, blood, fluid, count, top)
    settled = _load(key)
    if settled is None:
        settled = _settled(blood, fluid, inflow, count, top)
        _store(key, settled)
    _put(blood, settled)
    return settled


def _settled(blood: BloodFlow, fluid: Fluid, inflow: Any, count: int, top: Plane | None) -> Floats:
    if top is not None:
        law = fluid.equation_of_state
        looser = LOOSENED * law.rest_density * law.sound_speed**2
        fluid = replace(fluid, equation_of_state=replace(law, background_pressure=looser))
    model = SphAcceleration(fluid, blood.particles.capacity)

    def ratio() -> Floats:
        """rho/rho_0 in the lumen."""
        density = blood.particles.in_order(blood.particles.density)[:count]
        return np.asarray(density / fluid.rest_density)

    settled = _let_go(blood, model, inflow, NOWHERE if top is None else top)
    if top is None:
        excess = float(np.median(ratio())) - 1.0 - MOST_EXCESS
        if excess > 0.0:
            kept = np.ones(len(settled), bool)
            kept[np.random.default_rng(0).permutation(count)[: round(excess * count)]] = False
            _put(blood, settled[kept])
            count = int(kept[:count].sum())
            settled = _let_go(blood, model, inflow, NOWHERE)
    else:
        for _ in range(MOST_STEPS // STEPS - 1):
            if np.percentile(ratio(), 99.9) < CALM:
                break
            settled = _let_go(blood, model, inflow, top)
    kept = inflow.regions.number_at(settled) < 0
    kept[count:] = True
    return settled[kept]


def _put(blood: BloodFlow, position: Floats) -> None:
    """Replace the blood, at rest."""
    numbers, velocity = np.arange(len(position)), np.zeros_like(position)
    blood.particles.replace({"identity": numbers, "position": position, "velocity": velocity})
    blood.neighbors.stale = True


def _let_go(blood: BloodFlow, model: SphAcceleration, inflow: Any, top: Plane) -> Floats:
    """Positions [m] after STEPS steps, (n, 3); the density is of the last."""
    particles, wall, neighbors, fluid = blood.particles, blood.wall, blood.neighbors, model.fluid
    dt = fluid.step_limits(fluid.sound_speed, 0.0, 0.0).sound
    for _ in range(STEPS):
        if neighbors.stale:
            neighbors.build(particles, wall)
        model.accelerate(particles, wall, neighbors, (0.0, 0.0, 0.0))
        bound_acceleration(particles, MOST_MOVED * fluid.spacing / (dt * dt))
        moved2, _ = kick_drift(particles, wall, neighbors, inflow, False, dt, 0.0)
        slow(particles, KEPT, *top.point, *top.normal)
        neighbors.note_drift(float(moved2) ** 0.5, 0.0)
    return np.asarray(particles.in_order(particles.position), float)


@ti.kernel
def bound_acceleration(p: ti.template(), most: float):
    """Shorten accelerations to a largest one [m/s^2].  Writes: acceleration."""
    for i in range(p.count[None]):
        p.acceleration[i] *= most / ti.max(most, p.acceleration[i].norm())


@ti.kernel
def slow(
    p: ti.template(), kept: float,
    x: float, y: float, z: float, n_x: float, n_y: float, n_z: float,
):  # fmt: skip
    """Slow all blood, and put what is above a plane on it.  Writes: velocity, position."""
    point, normal = ti.Vector([x, y, z]), ti.Vector([n_x, n_y, n_z])
    for i in range(p.count[None]):
        above = ti.max(0.0, (p.position[i] - point).dot(normal))
        p.position[i] -= above * normal
        v = kept * p.velocity[i]
        if above > 0.0:
            v -= ti.max(0.0, v.dot(normal)) * normal
        p.velocity[i] = v


def _key(start: Floats, blood: BloodFlow, fluid: Fluid, count: int, top: Plane | None) -> str:
    """Hash of all that the positions follow from."""
    text = hashlib.sha256()
    for values in (start, *blood.wall.given):
        text.update(np.ascontiguousarray(values, "<f4").tobytes())
    text.update(repr((ALGORITHM, str(start.dtype), count, fluid, top)).encode())
    return text.hexdigest()[:40]


def _load(key: str) -> Floats | None:
    """The positions stored under a key; None where there are none or the file is damaged."""
    try:
        with cache_file("blood", key).open("rb") as file, np.load(file, allow_pickle=False) as data:
            positions = data["positions"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    whole = positions.ndim == 2 and positions.shape[1] == 3 and np.isfinite(positions).all()
    return positions if whole else None


def _store(key: str, positions: Floats) -> None:
    """Keep positions for the next start; a cache that cannot be written is no error."""
    if len(positions) < CACHE_FROM:
        return
    path = cache_file("blood", key)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as file:
            np.savez(file, positions=positions)
