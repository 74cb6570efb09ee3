"""Settling: blood that fills a lumen, brought to rest under its own pressure before a run.

A lattice that is cut to the lumen leaves a void of up to half a spacing at the wall, and other
blood at every spacing.  A finer lattice with as many particles as the lumen has room for is let go:

    v_i += a_i dt,   x_i += (v_i + w_i) dt,   v_i *= 0.9,   dt = C h_s/c

under the physics without gravity, for STEPS steps.  Blood in the buffers of driven
openings stays where it is.  Curved walls push the first layer farther in than half a spacing: what
then has no room is left out, and what has gone into a buffer.
"""

import contextlib
import hashlib
import zipfile
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

ALGORITHM = 2
"""Change it when the positions change: it is part of the cache's key."""
STEPS = 100
"""After 40 the mean density is 1.010 of rho_0 in `aorta_surgery`, after 400 1.006."""
MOST_EXCESS = 0.01
"""Excess of the median of the density over rho_0 that stays: flow finds the room."""
KEPT = 0.9
"""Part of the velocity that a step keeps."""
CACHE_FROM = 5_000
"""Particles from which it is worth a file."""


def settle(blood: BloodFlow, fluid: Fluid, inflow: Any, count: int) -> Floats:
    """Positions of the settled blood [m], (n, 3), in order of identity; from the cache if there.

    Args:
        blood: at its start; its positions are replaced, its velocities are zero.
        fluid: constants of the sums.
        inflow: the `BufferZones`, whose blood stays.
        count: of the particles in the lumen, the first; those of buffers follow.
    """
    particles = blood.particles
    start = particles.in_order(particles.position)
    key = _key(start, blood, fluid, count)
    settled = _load(key)
    if settled is None:
        settled = _settled(blood, fluid, inflow, count)
        _store(key, settled)
    _put(blood, settled)
    return settled


def _settled(blood: BloodFlow, fluid: Fluid, inflow: Any, count: int) -> Floats:
    model = SphAcceleration(fluid, blood.particles.capacity)
    settled = _let_go(blood, model, inflow)
    density = blood.particles.in_order(blood.particles.density)[:count]
    excess = float(np.median(density)) / fluid.rest_density - 1.0 - MOST_EXCESS
    if excess > 0.0:
        kept = np.ones(len(settled), bool)
        kept[np.random.default_rng(0).permutation(count)[: round(excess * count)]] = False
        _put(blood, settled[kept])
        count = int(kept[:count].sum())
        settled = _let_go(blood, model, inflow)
    kept = inflow.regions.number_at(settled) < 0
    kept[count:] = True
    return settled[kept]


def _put(blood: BloodFlow, position: Floats) -> None:
    """Replace the blood, at rest."""
    numbers, velocity = np.arange(len(position)), np.zeros_like(position)
    blood.particles.replace({"identity": numbers, "position": position, "velocity": velocity})
    blood.neighbors.stale = True


def _let_go(blood: BloodFlow, model: SphAcceleration, inflow: Any) -> Floats:
    """Positions [m] after STEPS steps, (n, 3); the density is of the last."""
    particles, wall, neighbors, fluid = blood.particles, blood.wall, blood.neighbors, model.fluid
    dt = fluid.step_limits(fluid.sound_speed, 0.0, 0.0).sound
    for _ in range(STEPS):
        if neighbors.stale:
            neighbors.build(particles, wall)
        model.accelerate(particles, wall, neighbors, (0.0, 0.0, 0.0))
        moved2, _ = kick_drift(particles, wall, neighbors, inflow, False, dt)
        slow(particles, KEPT)
        neighbors.note_drift(float(moved2) ** 0.5, 0.0)
    return np.asarray(particles.in_order(particles.position), float)


@ti.kernel
def slow(p: ti.template(), kept: float):
    """Writes: velocity."""
    for i in range(p.count[None]):
        p.velocity[i] *= kept


def _key(start: Floats, blood: BloodFlow, fluid: Fluid, count: int) -> str:
    """Hash of all that the positions follow from."""
    text = hashlib.sha256()
    for values in (start, *blood.wall.given):
        text.update(np.ascontiguousarray(values, "<f4").tobytes())
    text.update(repr((ALGORITHM, str(start.dtype), count, fluid)).encode())
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
