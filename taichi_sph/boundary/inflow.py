"""Inflow: blood is driven through an opening by a buffer zone of blood beyond its plane.

Behind a driven opening the vessel goes on as a short flow extension, full of blood that moves into
the vessel as one body, at a speed u:

    u     = Q / A                   where a flow Q is given
    du/dt = mean_i(a_i) + p A / M   where a pressure p_0 is given

measured from the datum (`taichi_sph.boundary.datum`) at the opening's centre, with A the buffer's
cross-section, M its mass, a_i what its neighbours in the vessel do to it, along
the inward normal and without gravity: forces within the buffer cancel.  p is the reservoir's p_0
while blood leaves, and p_0 - rho u^2/2 while blood comes in: a reservoir at rest spends a part of
its head on the speed of what it gives (Bernoulli), a jet into it gives none back.  With p_0 both
ways two openings drive blood in a round, faster and faster, as backflow does where a traction is
given (Bertoglio et al. 2018, doi:10.1002/cnm.2918).

Whatever blood is beyond the plane belongs to the buffer, so that flow may turn.  The buffer is made
of strands of particles a spacing apart; a strand that has moved on by a spacing gets another
particle at its far end.  The strands are staggered, so that blood is added particle by particle:
what was added differs from the integral of u A by two particles at most, and those that are due
since the lists were built.

    symbol   code                                unit
    u        DrivenOpening.speed                 m/s
    Q        flow * factor * waveform            m^3/s
    p_0      pressure * factor * waveform        Pa
    A        cross_section                       m^2
    M        particle_count * rho_0 d^3          kg
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import taichi as ti
from scipy.spatial import cKDTree

from taichi_sph.boundary.boundary import BloodFlow, Boundary, finite_numbers
from taichi_sph.errors import InputError, RunError
from taichi_sph.fluid.model import AccelerationModel
from taichi_sph.geometry.mesh import Floats, Integers
from taichi_sph.geometry.openings import Opening
from taichi_sph.runtime import float_dtype, has_wide_atomics
from taichi_sph.waveform import RAMP_TIME, Waveform

HYSTERESIS = 0.25
"""A particle leaves the buffer this far beyond its end [spacings], and another takes its place only
when the strand has come back by as much: blood that trembles adds and removes nothing."""

LEAST_APART = 0.5
"""No particle is added nearer to another than this [spacings]."""

FIXED_POINT_SCALE = float(1 << 20)
"""Accelerations are summed as whole multiples of 1/FIXED_POINT_SCALE m/s^2: the order then does not
matter."""

GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
"""Multiples of it, less their whole parts, lie evenly in [0, 1) however many are taken."""


@ti.data_oriented
@dataclass(frozen=True)
class BufferRegions:
    """Where the buffers of driven openings are."""

    centre: tuple[tuple[float, float, float], ...] = ()
    """Centre of each driven opening [m]."""
    normal: tuple[tuple[float, float, float], ...] = ()
    """Unit normals out of the vessel."""
    radius: tuple[float, ...] = ()
    """No blood of a buffer is farther from its axis [m]."""
    depth: float = 0.0
    """No blood of a buffer is farther from the opening's plane [m]."""

    @property
    def count(self) -> int:
        """Number of buffers."""
        return len(self.centre)

    @ti.func
    def buffer_at(self, x, before: ti.template() = 0.0):
        """Number of the buffer that a position is in, or so far before [m]; -1 if in none."""
        buffer = -1
        for k in ti.static(range(self.count)):
            r = x - ti.Vector(self.centre[k])
            along = r.dot(ti.Vector(self.normal[k]))
            aside2 = r.norm_sqr() - along * along
            if along > -before and along < self.depth and aside2 < ti.static(self.radius[k] ** 2):
                buffer = k
        return buffer

    def number_at(self, x: Floats) -> Integers:
        """Number of the buffer that positions (n, 3) [m] are in; -1 if in none, (n,)."""
        found = np.full(len(x), -1)
        for k in range(self.count):
            r = x - self.centre[k]
            along = r @ self.normal[k]
            aside2 = (r**2).sum(axis=1) - along**2
            found[(along > 0.0) & (along < self.depth) & (aside2 < self.radius[k] ** 2)] = k
        return found

    @ti.func
    def inward_normal(self, buffer):
        """Unit vector into the vessel."""
        n = ti.Vector([0.0, 0.0, 0.0])
        for k in ti.static(range(self.count)):
            if buffer == k:
                n = -ti.Vector(self.normal[k])
        return n


@dataclass(eq=False)
class DrivenOpening:
    """What drives one opening."""

    opening: Opening
    flow: float | None
    """Q [m^3/s] into the vessel, times the waveform; None where a pressure is given."""
    pressure: float | None
    """p_0 [Pa], times the waveform."""
    waveform: Waveform
    sites: Floats
    """Where the strands cross the opening's plane [m], (n, 3)."""
    target_factor: float = 1.0
    """What flow or pressure is multiplied by in the end, beside the waveform."""
    factor: float = 0.0
    """What it is multiplied by now: the target is reached within RAMP_TIME."""
    speed: float = 0.0
    """u [m/s]."""
    displacement: float = 0.0
    """How far the buffer has moved into the vessel [m]."""
    volume_in: float = 0.0
    """Volume that has crossed the plane, the integral of u A [m^3]."""
    emitted: Integers = field(init=False)
    """How many particles each strand has got more than it has lost, (n,)."""

    def __post_init__(self) -> None:
        """No strand has moved."""
        self.emitted = np.zeros(len(self.sites), np.int64)

    @property
    def phase(self) -> Floats:
        """How far each strand is ahead of the first [spacings], in [0, 1), (n,)."""
        return np.asarray(GOLDEN * np.arange(len(self.sites)) % 1.0)

    def factor_after(self, dt: float) -> float:
        """Factor a step of dt [s] from now: the target is reached within RAMP_TIME."""
        most = dt / RAMP_TIME
        return self.factor + min(most, max(-most, self.target_factor - self.factor))

    def pressure_at(self, time: float, dt: float) -> float:
        """p_0 [Pa] at a time [s], dt [s] from now; 0 where a flow is given."""
        return (self.pressure or 0.0) * self.factor_after(dt) * self.waveform(time)

    def reset(self) -> None:
        """Be as at the start, at rest."""
        self.target_factor = 1.0
        self.factor = self.speed = self.displacement = self.volume_in = 0.0
        self.emitted[:] = 0

    def save_state(self) -> dict[str, Any]:
        """All that changes, as numbers and a list."""
        return {
            "target_factor": self.target_factor, "factor": self.factor, "speed": self.speed,
            "displacement": self.displacement, "volume_in": self.volume_in,
            "emitted": self.emitted.tolist(),
        }  # fmt: skip

    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self.target_factor, self.factor = saved["target_factor"], saved["factor"]
        self.speed, self.displacement = saved["speed"], saved["displacement"]
        self.volume_in = saved["volume_in"]
        self.emitted = np.array(saved["emitted"], np.int64)

    def cross_section(self, spacing: float) -> float:
        """A [m^2]: what the strands take up."""
        return len(self.sites) * spacing**2

    def pressure_area(self, spacing: float) -> float:
        """What pressure acts on [m^2]: midway between the strands' area and the opening's.

        Blood in the vessel also pushes on the buffer beside the outermost strands.
        """
        return math.sqrt(self.cross_section(spacing) * self.opening.area)


def buffer_layers(spacing: float, support_radius: float) -> int:
    """Layers of a buffer: blood at the plane must not feel its far end."""
    return math.ceil(support_radius / spacing) + 2


def buffer_regions(
    openings: list[DrivenOpening], spacing: float, support_radius: float
) -> BufferRegions:
    """Where the buffers of driven openings are; spacing and support radius of the blood [m]."""
    return BufferRegions(
        tuple(tuple(map(float, o.opening.centre)) for o in openings),  # type: ignore[misc]
        tuple(tuple(map(float, o.opening.normal)) for o in openings),  # type: ignore[misc]
        tuple(
            float(np.linalg.norm(o.sites - o.opening.centre, axis=1).max(initial=0.0))
            + 1.5 * spacing
            for o in openings
        ),
        (buffer_layers(spacing, support_radius) + 2) * spacing,
    )


def buffer_capacity(openings: list[DrivenOpening], layers: int) -> int:
    """Particles that all buffers may hold."""
    return sum(len(o.sites) for o in openings) * (layers + 2)


def buffer_blood(
    openings: list[DrivenOpening], blood: Floats, spacing: float, layers: int
) -> Floats:
    """The buffers at the start (n, 3) [m], where they leave blood (m, 3) [m] its room."""
    found = [np.zeros((0, 3))]
    for driven in openings:
        depth = spacing * (np.arange(layers) + 1.0 - driven.phase[:, None])
        buffer = driven.sites[:, None] + depth[..., None] * driven.opening.normal
        buffer = buffer.reshape(-1, 3)
        apart, _ = cKDTree(blood).query(buffer) if len(blood) else (np.full(len(buffer), 1.0), 0)
        found.append(buffer[apart > 0.8 * spacing])
    return np.concatenate(found)


class BufferZones(Boundary):
    """All that drives blood through openings; there may be none."""

    name = "inflow"

    def __init__(
        self, blood: BloodFlow, openings: list[DrivenOpening], spacing: float,
        support_radius: float, density: float,
    ):  # fmt: skip
        """Make the fields; spacing [m], support radius [m] and rest density [kg/m^3] of blood.

        Raises:
            InputError: there are driven openings, and this device cannot sum what acts on them.
        """
        if openings and not has_wide_atomics():
            raise InputError(
                "driven openings need sums of 64-bit integers, which Metal does not have; "
                "use --arch cpu"
            )
        self.blood = blood
        self.openings = openings
        self.spacing = spacing
        self.density = density
        self.layers = buffer_layers(spacing, support_radius)
        self.regions = buffer_regions(openings, spacing, support_radius)
        self.added = 0
        """Particles that were added since the start."""
        self.next_identity = int(blood.particles.count[None])
        count = max(1, len(openings))
        self.speed = ti.field(float, count)
        """u of each buffer [m/s]."""
        self.acceleration_sum = ti.field(ti.i64)
        """Sum of the accelerations into the vessel over a buffer [1/FIXED_POINT_SCALE m/s^2]."""
        # In a tree of its own: among 32-bit fields it overlaps them on Vulkan.
        alone = ti.FieldsBuilder()
        alone.dense(ti.i, count).place(self.acceleration_sum)
        alone.finalize()
        self.particle_count = ti.field(int, count)
        """Particles of each buffer."""
        self._control = np.zeros((count, 4), float_dtype())

    def set_factor(self, factor: float, opening: str | None = None) -> None:
        """Multiply what drives an opening, or all, by a factor; it takes RAMP_TIME to get there.

        Raises:
            InputError: nothing drives that opening, or the factor is not finite.
        """
        finite_numbers("inflow: factor", factor)
        chosen = [o for o in self.openings if opening in (None, o.opening.name)]
        if not chosen:
            names = ", ".join(o.opening.name for o in self.openings) or "none"
            raise InputError(f"inflow: nothing drives {opening or 'this scene'}; driven: {names}")
        for driven in chosen:
            driven.target_factor = factor

    def before_lists(self) -> None:
        """Add the blood that is due.

        Raises:
            RunError: there is no room for so much blood.
        """
        position, velocity = self.new_blood()
        if len(position) == 0:
            return
        particles = self.blood.particles
        if particles.capacity - particles.count[None] < len(position):
            raise RunError(
                f"the run diverged: at t = {self.blood.time:.6g} s the vessel is over-full, "
                f"{particles.capacity} particles; likely cause: more is driven in than "
                "can leave, or the pressure is too high for the sound speed"
            )
        added = add_blood(
            particles, self.regions,
            *(np.ascontiguousarray(a, float_dtype()) for a in (position, velocity)),
            np.zeros(len(position), np.int32), self.next_identity,
            (LEAST_APART * self.spacing) ** 2,
        )  # fmt: skip
        self.added += added
        self.next_identity += added

    def new_blood(self) -> tuple[Floats, Floats]:
        """Positions [m] and velocities [m/s] of blood that strands lack at their ends, (n, 3)."""
        positions, velocities = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for driven in self.openings:
            moved = driven.displacement / self.spacing + driven.phase
            driven.emitted -= moved < driven.emitted - HYSTERESIS
            due = moved > driven.emitted + 1
            if not due.any():
                continue
            driven.emitted += due
            depth = self.spacing * (self.layers - (moved - driven.emitted)[due])
            positions.append(driven.sites[due] + depth[:, None] * driven.opening.normal)
            velocities.append(np.tile(-driven.speed * driven.opening.normal, (int(due.sum()), 1)))
        return np.concatenate(positions), np.concatenate(velocities)

    def before_drift(self, dt: float, model: AccelerationModel) -> float:
        """Work out the speeds for a step of dt [s]; no proxy moves."""
        if not self.openings:
            return 0.0
        time, control = self.blood.time + dt, self._control
        gravity, datum = self.blood.felt_gravity, self.blood.datum
        for k, driven in enumerate(self.openings):
            pressure = driven.pressure_at(time, dt) - float(datum.at(driven.opening.centre))
            driven.factor = driven.factor_after(dt)
            area = driven.cross_section(self.spacing)
            if driven.flow is not None:
                flow = driven.flow * driven.factor * driven.waveform(time)
                control[k] = 0.0, flow / area, 0.0, driven.speed
            elif driven.pressure is not None:
                # p A/M, times the number of particles that M is of.
                head = pressure - 0.5 * self.density * max(0.0, driven.speed) ** 2
                push = head * driven.pressure_area(self.spacing) / (self.density * self.spacing**3)
                control[k] = 1.0, push, float(-np.dot(gravity, driven.opening.normal)), driven.speed
        drive_buffers(self.blood.particles, self, control, dt)
        for driven, row in zip(self.openings, control, strict=False):
            driven.speed = float(row[3])
            driven.displacement += driven.speed * dt
            driven.volume_in += driven.speed * dt * driven.cross_section(self.spacing)
        return 0.0

    def reset(self) -> None:
        """Buffers are at rest; identities go on after those of the blood that there is."""
        self.added, self.next_identity = 0, int(self.blood.particles.count[None])
        for driven in self.openings:
            driven.reset()

    def save_state(self) -> dict[str, Any]:
        """What was added, and each driven opening."""
        return {
            "added": self.added,
            "next_identity": self.next_identity,
            "openings": [driven.save_state() for driven in self.openings],
        }

    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from a saved state.

        Raises:
            InputError: it is of another number of driven openings.
        """
        if len(saved["openings"]) != len(self.openings):
            raise InputError(
                f"a state of {len(saved['openings'])} driven openings: the scene has "
                f"{len(self.openings)}"
            )
        self.added, self.next_identity = saved["added"], saved["next_identity"]
        for driven, row in zip(self.openings, saved["openings"], strict=True):
            driven.load_state(row)


@ti.kernel
def drive_buffers(
    p: ti.template(), inflow: ti.template(), control: ti.types.ndarray(ndim=2), dt: float
):
    """Speed of each buffer: u = u_given, or u += dt (sum_i a_i . n/N - g . n + push/N).

    n is the inward normal; a row of `control` is: whether a pressure is given, u_given [m/s] or
    push [m/s^2], g . n [m/s^2], u [m/s].
    Reads: position, acceleration.  Writes: the buffers' speed, and control[:, 3] alike.
    """
    for k in range(control.shape[0]):
        inflow.acceleration_sum[k] = ti.cast(0, ti.i64)
        inflow.particle_count[k] = 0
    for i in range(p.count[None]):
        k = inflow.regions.buffer_at(p.position[i])
        if k >= 0:
            a = p.acceleration[i].dot(inflow.regions.inward_normal(k))
            ti.atomic_add(inflow.acceleration_sum[k], ti.cast(a * FIXED_POINT_SCALE, ti.i64))
            ti.atomic_add(inflow.particle_count[k], 1)
    for k in range(control.shape[0]):
        u = control[k, 1]
        if control[k, 0] > 0.0:
            u = control[k, 3]
            if inflow.particle_count[k] > 0:
                n = ti.cast(inflow.particle_count[k], float)
                mean = ti.cast(inflow.acceleration_sum[k], float) / FIXED_POINT_SCALE / n
                u += dt * (mean - control[k, 2] + control[k, 1] / n)
        control[k, 3] = u
        inflow.speed[k] = u


@ti.kernel
def add_blood(
    p: ti.template(),
    regions: ti.template(),
    position: ti.types.ndarray(ndim=2),
    velocity: ti.types.ndarray(ndim=2),
    crowded: ti.types.ndarray(ndim=1),
    identity: int,
    least2: float,
) -> int:
    """Add rows, but those that other blood is too near to; returns how many were added.

    The first gets the given identity, and so on; what else a particle has is zero.
    Writes: all of the state's rows, count, crowded.
    """
    for i in range(p.count[None]):
        if p.identity[i] >= 0 and regions.buffer_at(p.position[i]) >= 0:
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
            for values in ti.static(p.fields):
                values[row] = ti.zero(values[row])
            for a in ti.static(range(3)):
                p.position[row][a] = position[m, a]
                p.velocity[row][a] = velocity[m, a]
            p.identity[row] = identity + added
            p.count[None] = row + 1
            added += 1
    return added
