"""Pistons: blood is driven through an opening by a plug of blood beyond its plane.

Behind a driven opening the vessel goes on as a short sleeve, full of blood that moves into the
vessel as one plug, at a speed u:

    u     = Q / A                   where a flow Q is given
    du/dt = mean_i(a_i) + p A / M   where a pressure p_0 is given

with A the plug's cross-section, M its mass, a_i what its neighbours in the vessel do to it, along
the way in and without gravity: forces within the plug cancel.  p is the reservoir's p_0 while blood
leaves, and p_0 - rho u^2/2 while blood comes in: a reservoir at rest spends a part of its head on
the speed of what it gives (Bernoulli), a jet into it gives none back.  With p_0 both ways two
openings drive blood in a round, faster and faster, as backflow does where a traction is given
(Bertoglio et al. 2018, doi:10.1002/cnm.2918).

Whatever blood is beyond the plane belongs to the plug, so that flow may turn.  The plug is made of
columns of particles a spacing apart; a column that has moved on by a spacing gets another particle
at its far end.  The columns are staggered, so that blood is added particle by particle: what was
added differs from the integral of u A by two particles at most, and those that are due since the
lists were built.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import taichi as ti
from scipy.spatial import cKDTree

from taichi_sph.errors import InputError
from taichi_sph.geometry.mesh import Floats, Integers, inside_polygon, plane_axes
from taichi_sph.geometry.openings import Opening
from taichi_sph.particles.particles import Particles
from taichi_sph.runtime import float_dtype, has_wide_atomics
from taichi_sph.waveform import Waveform

RAMP_TIME = 0.05
"""Time in which a flow or a pressure rises from nothing to what is asked for [s]: blood that is
set going at once rings."""

HYSTERESIS = 0.25
"""A particle leaves the plug this far beyond its end [spacings], and another takes its place only
when the column has come back by as much: blood that trembles adds and removes nothing."""

LEAST_APART = 0.5
"""No particle is added nearer to another than this [spacings]."""

FIXED_POINT_SCALE = float(1 << 20)
"""Accelerations are summed as whole multiples of 1/FINE m/s^2: the order then does not matter."""

GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
"""Multiples of it, less their whole parts, lie evenly in [0, 1) however many are taken."""


@ti.data_oriented
@dataclass(frozen=True)
class BufferRegions:
    """Where the plugs are."""

    centre: tuple[tuple[float, float, float], ...] = ()
    """Of each driven opening [m]."""
    normal: tuple[tuple[float, float, float], ...] = ()
    """Unit normals out of the vessel."""
    radius: tuple[float, ...] = ()
    """No blood of a plug is farther from its axis [m]."""
    depth: float = 0.0
    """No blood of a plug is farther from the opening's plane [m]."""

    @property
    def count(self) -> int:
        """Number of plugs."""
        return len(self.centre)

    @ti.func
    def buffer_at(self, x):
        """Number of the plug that a position belongs to; -1 if to none."""
        found = -1
        for k in ti.static(range(self.count)):
            r = x - ti.Vector(self.centre[k])
            along = r.dot(ti.Vector(self.normal[k]))
            aside2 = r.norm_sqr() - along * along
            if along > 0.0 and along < self.depth and aside2 < ti.static(self.radius[k] ** 2):
                found = k
        return found

    @ti.func
    def inward_normal(self, plug):
        """Unit vector into the vessel."""
        n = ti.Vector([0.0, 0.0, 0.0])
        for k in ti.static(range(self.count)):
            if plug == k:
                n = -ti.Vector(self.normal[k])
        return n


@dataclass(eq=False)
class DrivenOpening:
    """What drives one opening."""

    opening: Opening
    flow: float | None
    """Q [m^3/s] into the vessel, times the waveform; None where a pressure is given."""
    pressure: float | None
    """p [Pa], times the waveform."""
    waveform: Waveform
    sites: Floats
    """Where the columns cross the opening's plane [m], (n, 3)."""
    asked: float = 1.0
    """What flow or pressure is multiplied by, beside the waveform."""
    level: float = 0.0
    """The same, on its way there in RISE."""
    speed: float = 0.0
    """u [m/s]."""
    way: float = 0.0
    """How far the plug has moved into the vessel [m]."""
    pushed: float = 0.0
    """Volume that has crossed the plane, the integral of u A [m^3]."""
    taken: Integers = field(init=False)
    """How many particles each column has got more than it has lost, (n,)."""

    def __post_init__(self) -> None:
        """No column has moved."""
        self.taken = np.zeros(len(self.sites), np.int64)

    @property
    def lead(self) -> Floats:
        """How far each column is ahead of the first [spacings], in [0, 1), (n,)."""
        return np.asarray(GOLDEN * np.arange(len(self.sites)) % 1.0)

    def start_again(self) -> None:
        """As at the start, at rest."""
        self.asked = 1.0
        self.level = self.speed = self.way = self.pushed = 0.0
        self.taken[:] = 0

    def state(self) -> list[Any]:
        """All that changes, as numbers and a list."""
        return [
            self.asked, self.level, self.speed, self.way, self.pushed, self.taken.tolist()
        ]  # fmt: skip

    def load_state(self, state: list[Any]) -> None:
        """Go on from what `state` gave."""
        self.asked, self.level, self.speed, self.way, self.pushed = state[:5]
        self.taken = np.array(state[5], np.int64)

    def cross_section(self, spacing: float) -> float:
        """A [m^2]: what the columns take up."""
        return len(self.sites) * spacing**2

    def bearing(self, spacing: float) -> float:
        """What pressure acts on [m^2]: midway between the columns' area and the opening's.

        Blood in the vessel also pushes on the plug beside the outermost columns.
        """
        return math.sqrt(self.cross_section(spacing) * self.opening.area)


def buffer_sites(rim: Floats, opening: Opening, spacing: float) -> Floats:
    """Where columns cross an opening's plane: a square lattice half a spacing from the rim, (n, 3).

    Args:
        rim: closed polygon round the opening (m, 3) [m].
        opening: whose plane it is.
        spacing: of the columns [m].
    """
    first, second = plane_axes(opening.normal)
    flat = np.stack([(rim - opening.centre) @ first, (rim - opening.centre) @ second], axis=1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    best = np.zeros((0, 2))
    middle = 0.5 * (low + high)
    for shift in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)):
        lines = []
        for a in range(2):
            most = math.ceil((high[a] - low[a]) / spacing)
            lines.append(middle[a] + (np.arange(-most, most + 1) + shift[a]) * spacing)
        points = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 2)
        points = points[inside_polygon(points, flat)]
        points = points[rim_distance(points, flat) >= 0.499 * spacing]
        if len(points) > len(best):
            best = points
    return opening.centre + best[:, :1] * first + best[:, 1:] * second


def rim_distance(points: Floats, polygon: Floats) -> Floats:
    """Distance of points (n, 2) to a closed polygon (m, 2), (n,)."""
    a, along = polygon, np.roll(polygon, -1, axis=0) - polygon
    apart = points[:, None] - a
    share = (apart * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-300)
    foot = apart - np.clip(share, 0.0, 1.0)[..., None] * along
    return np.asarray(np.linalg.norm(foot, axis=2).min(axis=1))


def flow_extension(
    rim: Floats, opening: Opening, spacing: float, setback: float, depth: float
) -> tuple[Floats, Floats]:
    """Proxies of the sleeve behind an opening, and their normals, (n, 3) each.

    Args:
        rim: closed polygon round the opening (m, 3) [m].
        opening: where the sleeve begins.
        spacing: of the proxies [m].
        setback: how far behind the lumen they stand [m].
        depth: length of the sleeve [m].
    """
    after = np.roll(rim, -1, axis=0)
    length = np.linalg.norm(after - rim, axis=1)
    reached = np.concatenate([[0.0], np.cumsum(length)])
    count = max(6, round(float(reached[-1]) / spacing))
    points, normals = [], []
    for ring in range(math.ceil(depth / spacing)):
        place = (np.arange(count) + 0.5 * (ring % 2)) / count * reached[-1]
        edge = np.minimum(np.searchsorted(reached, place, side="right") - 1, len(rim) - 1)
        share = (place - reached[edge]) / np.maximum(length[edge], 1e-300)
        foot = rim[edge] + share[:, None] * (after - rim)[edge]
        # Out of the lumen: square to the rim's chord over a spacing and to the opening's normal.
        ahead, behind = np.roll(foot, -1, axis=0), np.roll(foot, 1, axis=0)
        out = np.cross(ahead - behind, opening.normal)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        out *= np.sign(((foot - opening.centre) * out).sum(axis=1))[:, None]
        points.append(foot + setback * out + (ring + 0.5) * spacing * opening.normal)
        normals.append(out)
    return np.concatenate(points), np.concatenate(normals)


def buffer_layers(spacing: float, support_radius: float) -> int:
    """Layers of a plug: blood at the plane must not feel its far end."""
    return math.ceil(support_radius / spacing) + 2


class BufferZones:
    """All that drives blood through openings; there may be none."""

    def __init__(
        self, pistons: list[DrivenOpening], spacing: float, support_radius: float, density: float
    ):
        """Make the fields; spacing [m], support radius [m] and rest density [kg/m^3] of blood.

        Raises:
            InputError: there are some, and this device cannot sum what acts on them.
        """
        if pistons and not has_wide_atomics():
            raise InputError(
                "driven openings need sums of 64-bit integers, which Metal does not have; "
                "use --arch cpu"
            )
        self.each = pistons
        self.spacing = spacing
        self.density = density
        self.layers = buffer_layers(spacing, support_radius)
        self.gates = BufferRegions(
            tuple(tuple(map(float, p.opening.centre)) for p in pistons),  # type: ignore[misc]
            tuple(tuple(map(float, p.opening.normal)) for p in pistons),  # type: ignore[misc]
            tuple(
                float(np.linalg.norm(p.sites - p.opening.centre, axis=1).max(initial=0.0))
                + 1.5 * spacing
                for p in pistons
            ),
            (self.layers + 2) * spacing,
        )
        count = max(1, len(pistons))
        self.speed = ti.field(float, count)
        """u of each plug [m/s]."""
        self.thrust = ti.field(ti.i64)
        """Sum of the accelerations into the vessel over a plug [1/FINE m/s^2]."""
        # In a tree of its own: among 32-bit fields it overlaps them on Vulkan.
        alone = ti.FieldsBuilder()
        alone.dense(ti.i, count).place(self.thrust)
        alone.finalize()
        self.members = ti.field(int, count)
        """Particles of each plug."""
        self._orders = np.zeros((count, 4), float_dtype())

    @property
    def capacity(self) -> int:
        """Particles that all plugs may hold."""
        return sum(len(p.sites) for p in self.each) * (self.layers + 2)

    @property
    def far_end(self) -> float:
        """Distance from the plane beyond which blood leaves a plug for good [m]."""
        return (self.layers + HYSTERESIS) * self.spacing

    def initial_blood(self, blood: Floats) -> Floats:
        """The plugs at the start (n, 3) [m], where they leave blood (m, 3) [m] its room."""
        found = [np.zeros((0, 3))]
        for piston in self.each:
            depth = self.spacing * (np.arange(self.layers) + 1.0 - piston.lead[:, None])
            plug = piston.sites[:, None] + depth[..., None] * piston.opening.normal
            plug = plug.reshape(-1, 3)
            apart, _ = cKDTree(blood).query(plug) if len(blood) else (np.full(len(plug), 1.0), 0)
            found.append(plug[apart > 0.8 * self.spacing])
        return np.concatenate(found)

    def advance(
        self, particles: Particles, time: float, dt: float, gravity: tuple[float, float, float]
    ) -> None:
        """Work out the speeds for a step of dt that begins at a time [s]."""
        orders = self._orders
        for k, piston in enumerate(self.each):
            most = dt / RAMP_TIME
            piston.level += min(most, max(-most, piston.asked - piston.level))
            factor = piston.level * piston.waveform(time + dt)
            area = piston.cross_section(self.spacing)
            if piston.flow is not None:
                orders[k] = 0.0, piston.flow * factor / area, 0.0, piston.speed
            elif piston.pressure is not None:
                # p A/M, times the number of particles that M is of.
                head = piston.pressure * factor - 0.5 * self.density * max(0.0, piston.speed) ** 2
                push = head * piston.bearing(self.spacing) / (self.density * self.spacing**3)
                orders[k] = 1.0, push, float(-np.dot(gravity, piston.opening.normal)), piston.speed
        drive_buffers(particles, self, orders, dt)
        for piston, order in zip(self.each, orders, strict=False):
            piston.speed = float(order[3])
            piston.way += piston.speed * dt
            piston.pushed += piston.speed * dt * piston.cross_section(self.spacing)

    def new_blood(self) -> tuple[Floats, Floats]:
        """Positions [m] and velocities [m/s] of blood that columns lack at their ends, (n, 3)."""
        positions, velocities = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for piston in self.each:
            moved = piston.way / self.spacing + piston.lead
            piston.taken -= moved < piston.taken - HYSTERESIS
            due = moved > piston.taken + 1
            if not due.any():
                continue
            piston.taken += due
            depth = self.spacing * (self.layers - (moved - piston.taken)[due])
            positions.append(piston.sites[due] + depth[:, None] * piston.opening.normal)
            velocities.append(np.tile(-piston.speed * piston.opening.normal, (int(due.sum()), 1)))
        return np.concatenate(positions), np.concatenate(velocities)


@ti.kernel
def drive_buffers(
    p: ti.template(), plugs: ti.template(), orders: ti.types.ndarray(ndim=2), dt: float
):
    """U = u_given, or u += dt (sum_i a_i . n/N - g . n + push/N), n the way in.

    Reads: position, acceleration.  Writes: the plugs' speed, and orders[:, 3] alike.
    """
    for k in range(orders.shape[0]):
        plugs.thrust[k] = ti.cast(0, ti.i64)
        plugs.members[k] = 0
    for i in range(p.count[None]):
        k = plugs.gates.buffer_at(p.position[i])
        if k >= 0:
            a = p.acceleration[i].dot(plugs.gates.inward_normal(k))
            ti.atomic_add(plugs.thrust[k], ti.cast(a * FIXED_POINT_SCALE, ti.i64))
            ti.atomic_add(plugs.members[k], 1)
    for k in range(orders.shape[0]):
        u = orders[k, 1]
        if orders[k, 0] > 0.0:
            u = orders[k, 3]
            if plugs.members[k] > 0:
                n = ti.cast(plugs.members[k], float)
                mean = ti.cast(plugs.thrust[k], float) / FIXED_POINT_SCALE / n
                u += dt * (mean - orders[k, 2] + orders[k, 1] / n)
        orders[k, 3] = u
        plugs.speed[k] = u


@ti.kernel
def add_blood(
    p: ti.template(),
    gates: ti.template(),
    position: ti.types.ndarray(ndim=2),
    velocity: ti.types.ndarray(ndim=2),
    crowded: ti.types.ndarray(ndim=1),
    identity: int,
    least2: float,
) -> int:
    """Add rows, but those that other blood is too near to; returns how many were added.

    The first gets the given identity, and so on.  Writes: all of the state's rows, crowded.
    """
    for i in range(p.count[None]):
        if p.identity[i] >= 0 and gates.buffer_at(p.position[i]) >= 0:
            for m in range(crowded.shape[0]):
                apart2 = 0.0
                for a in ti.static(range(3)):
                    apart2 += (p.position[i][a] - position[m, a]) ** 2
                if apart2 < least2:
                    crowded[m] = 1
    added = 0
    ti.loop_config(serialize=True)
    for m in range(crowded.shape[0]):
        row = p.count[None]
        if crowded[m] == 0 and row < p.position.shape[0]:
            for a in ti.static(range(3)):
                p.position[row][a] = position[m, a]
                p.velocity[row][a] = velocity[m, a]
                p.acceleration[row][a] = 0.0
            p.identity[row] = identity + added
            p.count[None] = row + 1
            added += 1
    return added
