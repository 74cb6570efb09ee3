"""A rigid tool: it is moved from outside, pushes blood, and feels the blood's force."""

import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from taichi_sph.boundary.boundary import BloodFlow, Boundary, finite_numbers
from taichi_sph.boundary.tool_surface import ToolSurface
from taichi_sph.errors import InputError
from taichi_sph.fluid.model import AccelerationModel
from taichi_sph.fluid.wcsph import force_on_tool
from taichi_sph.geometry.mesh import Floats
from taichi_sph.particles.wall import place_tool
from taichi_sph.runtime import float_dtype

RESPONSE_TIME = 0.01
"""A tool nears its target by 1/e in this time [s]: a hand's jumps, which come 30 times a second,
become a motion."""

LARGEST_SPEED = 0.5
"""No part of a tool moves faster [m/s]; a surgeon's hand reaches some 0.2 m/s."""


class Tool(Boundary):
    """Where the tool is, and its target; without a surface, a mere tip for the suction."""

    name = "tool"

    def __init__(self, blood: BloodFlow, surface: ToolSurface | None, position: Floats):
        """Put it at a position [m]."""
        self.blood = blood
        self.surface = surface
        self.home = np.asarray(position, float)
        """Where it is at the start [m]."""
        self.position = self.target_position = self.home
        self.rotation = self.target_rotation = Rotation.identity()
        self.velocity = np.zeros(3)
        """[m/s]"""
        self.spin = np.zeros(3)
        """[rad/s]"""
        self.last_displacement = 0.0
        """How far a part of it may have gone in the last step [m]."""
        self._reached: tuple[object, object] = (None, None)
        """Target at which it came to rest: the position and the rotation themselves."""
        self._impulse = np.zeros(3)
        """Impulse of the blood on the tool since the force was last taken [N s]."""
        self._impulse_time = 0.0
        """Time over which it was summed [s]."""
        self.write_proxies()

    def move_to(self, position: Floats, rotation: Floats | None = None) -> None:
        """Set the target: a position [m] and, unless it stays, a quaternion w, x, y, z.

        Raises:
            InputError: a number is not finite, or the quaternion has no length.
        """
        target = finite_numbers("tool: position [m]", position, (3,))
        if rotation is not None:
            quaternion = finite_numbers("tool: rotation", rotation, (4,))
            if not quaternion.any():
                raise InputError("tool: a quaternion of length 0 is no rotation")
            self.target_rotation = kept_in_states(Rotation.from_quat(np.roll(quaternion, -1)))
        self.target_position = target

    def take_force(self) -> Floats:
        """Force of the blood on the tool, mean since this was last asked [N], (3,)."""
        force = self._impulse / self._impulse_time if self._impulse_time else np.zeros(3)
        self._impulse, self._impulse_time = np.zeros(3), 0.0
        return force

    @property
    def at_rest(self) -> bool:
        """Whether it stands still."""
        return not (self.velocity.any() or self.spin.any())

    @property
    def arrived(self) -> bool:
        """Whether it has come to rest at its target: most steps of most runs."""
        target = self.target_position, self.target_rotation
        return self._reached[0] is target[0] and self._reached[1] is target[1]

    def before_drift(self, dt: float, model: AccelerationModel) -> float:
        """Add the force of this step to the impulse, then move by it; how far a proxy may go [m].

        A mere tip pushes no blood and jumps: no proxy moves.
        """
        blood = self.blood
        if blood.wall.tool and model.pair_coefficients is not None:
            force = force_on_tool(
                blood.particles, blood.wall, blood.neighbors, *model.pair_coefficients,
                *self._datum(),
            )  # fmt: skip
            self._impulse += dt * np.array([force[0], force[1], force[2]])
            self._impulse_time += dt
        self.last_displacement = 0.0
        if self.arrived:
            return 0.0
        if self.surface is None:
            self.last_displacement = self.teleport()
            return 0.0
        moved = not self.at_rest
        self.update_velocity()
        if self.at_rest and not moved:
            return 0.0
        self.last_displacement = self.move(dt)
        self.write_proxies()
        return self.last_displacement

    def _datum(self) -> tuple[float, float, float, float]:
        """The datum over its value at the tool: at the origin [Pa], and its gradient [Pa/m].

        A vessel that has a datum is closed, and a level of pressure on all sides of the tool does
        nothing, but to particles, whose sum over its surface is not quite zero.
        """
        gradient = self.blood.datum.gradient
        return -float(np.dot(gradient, self.position)), *gradient

    def update_velocity(self) -> None:
        """Choose the velocity for the next step; of a tool with a surface, as `move`."""
        assert self.surface is not None
        away = self.target_position - self.position
        self.velocity = self._bounded(away, 1.0)
        self.spin = np.zeros(3)
        if self.target_rotation is not self.rotation:
            turn = (self.target_rotation * self.rotation.inv()).as_rotvec()
            self.spin = self._bounded(turn, self.surface.radius)
        if self.at_rest:
            self._reached = self.target_position, self.target_rotation

    @staticmethod
    def _bounded(away: Floats, arm: float) -> Floats:
        length = math.hypot(*away)
        if length * max(arm, 1e-3) < 1e-7:
            return np.zeros(3)
        speed = length / RESPONSE_TIME
        return away / length * min(speed, 0.5 * LARGEST_SPEED / max(arm, 1e-3))

    def teleport(self) -> float:
        """Be at the target at once; returns how far that is [m]."""
        distance = math.dist(self.position, self.target_position)
        self.position, self.rotation = self.target_position, self.target_rotation
        self._reached = self.target_position, self.target_rotation
        return distance

    def move(self, dt: float) -> float:
        """Move by a step of dt [s]; returns how far a part of it may have gone [m]."""
        self.position = self.position + dt * self.velocity
        if self.spin.any():
            self.rotation = kept_in_states(Rotation.from_rotvec(dt * self.spin) * self.rotation)
        assert self.surface is not None
        return dt * (math.hypot(*self.velocity) + self.surface.radius * math.hypot(*self.spin))

    def write_proxies(self) -> None:
        """Put the proxies into the wall's last rows."""
        if self.surface is None:
            return
        arm = self.rotation.apply(self.surface.position)
        rows = (
            self.position + arm,
            self.rotation.apply(self.surface.normal),
            self.velocity + np.cross(self.spin, arm),
        )
        place_tool(
            self.blood.wall, self.blood.neighbors.tool, self.blood.neighbors.tool_ball,
            *(np.ascontiguousarray(a, float_dtype()) for a in rows),
            self.surface.volume.astype(float_dtype()), *map(float, self.position),
            self.surface.radius,
        )  # fmt: skip

    def compile_kernels(self, model: AccelerationModel) -> None:
        """Sum the force on the tool, for nothing."""
        blood = self.blood
        if blood.wall.tool and model.pair_coefficients is not None:
            force_on_tool(
                blood.particles, blood.wall, blood.neighbors, *model.pair_coefficients,
                *self._datum(),
            )  # fmt: skip

    def reset(self) -> None:
        """At home and at rest."""
        self.position = self.target_position = self.home
        self.rotation = self.target_rotation = Rotation.identity()
        self.velocity, self.spin = np.zeros(3), np.zeros(3)
        self.last_displacement, self._reached = 0.0, (None, None)
        self.write_proxies()

    def save_state(self) -> dict[str, Any]:
        """Pose, target and motion; rotations as quaternions x, y, z, w."""
        return {
            name: [float(x) for x in value]
            for name, value in (
                ("position", self.position), ("rotation", self.rotation.as_quat()),
                ("target_position", self.target_position),
                ("target_rotation", self.target_rotation.as_quat()),
                ("velocity", self.velocity), ("spin", self.spin),
            )
        }  # fmt: skip

    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from a saved state."""
        rows = {name: np.array(row) for name, row in saved.items()}
        self.position, self.target_position = rows["position"], rows["target_position"]
        self.rotation = Rotation.from_quat(rows["rotation"])
        self.target_rotation = Rotation.from_quat(rows["target_rotation"])
        self.velocity, self.spin = rows["velocity"], rows["spin"]
        self.write_proxies()


def kept_in_states(rotation: Rotation) -> Rotation:
    """The rotation as it comes back from its quaternion, in which a state keeps it, bit by bit.

    A quaternion is brought to length 1 when it is read, which may turn its last digit.
    """
    for _ in range(8):
        again = Rotation.from_quat(rotation.as_quat())
        if np.array_equal(again.as_quat(), rotation.as_quat()):
            break
        rotation = again
    return rotation
