"""Particles: the blood's state in Taichi fields."""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from taichi_sph.errors import RunError
from taichi_sph.runtime import float_dtype


@dataclass(eq=False)
class Particles:
    """Blood particles; rows 0..count-1 are live, in the order of the neighbour grid.

    Rows move whenever the grid is rebuilt: `identity` says which particle a row holds.
    """

    capacity: int
    """Rows allocated."""
    mass: float
    """Blood that a particle stands for, rho_0 d^3 [kg]."""
    count: ti.Field
    """Number of live particles, 0-D."""
    position: ti.MatrixField
    """x [m], shape (capacity,)."""
    velocity: ti.MatrixField
    """v [m/s], shape (capacity,)."""
    acceleration: ti.MatrixField
    """a [m/s^2], shape (capacity,); state, for a model may read the previous step's."""
    density: ti.Field
    """rho [kg/m^3], shape (capacity,)."""
    identity: ti.Field
    """Number of the particle, the same for its whole life, shape (capacity,)."""

    @classmethod
    def allocate(cls, capacity: int, mass: float) -> "Particles":
        """Make the fields; once a run, since Taichi frees none."""
        return cls(
            capacity=capacity,
            mass=mass,
            count=ti.field(int, ()),
            position=ti.Vector.field(3, float, capacity),
            velocity=ti.Vector.field(3, float, capacity),
            acceleration=ti.Vector.field(3, float, capacity),
            density=ti.field(float, capacity),
            identity=ti.field(int, capacity),
        )

    @classmethod
    def from_numpy(
        cls, position: np.ndarray, velocity: np.ndarray | None = None, mass: float = 1.0,
        room: int = 0,
    ) -> "Particles":  # fmt: skip
        """Particles at given positions [m] and velocities [m/s] (at rest), shape (n, 3).

        There is room for so many more.

        Raises:
            RunError: a position or velocity is not finite.
        """
        n = len(position)
        velocity = np.zeros((n, 3)) if velocity is None else velocity
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            raise RunError("initial positions and velocities must be finite numbers")
        particles = cls.allocate(n + room, mass)
        # One kernel for all: each field's own would cost some 0.05 s at start.
        place_rows(
            particles, *(np.ascontiguousarray(a, float_dtype()) for a in (position, velocity))
        )
        return particles

    def replace(self, **rows: np.ndarray) -> None:
        """Other live rows: fields by name, each (n,) or (n, 3) with the same n <= capacity."""
        for name, values in rows.items():
            field = getattr(self, name)
            whole = field.to_numpy()
            whole[: len(values)] = values
            field.from_numpy(whole)
            self.count[None] = len(values)

    def in_order(self, field: ti.Field) -> np.ndarray:
        """Copy of a field's live rows, sorted by identity."""
        n = self.count[None]
        order = np.argsort(self.identity.to_numpy()[:n])
        return field.to_numpy()[:n][order]

    def live(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Copies of identities (n,), positions [m] and velocities [m/s], (n, 3), as `copy_to`."""
        n = int(self.count[None])
        identity = np.empty(n, np.int32)
        position, velocity = (np.empty((n, 3), float_dtype()) for _ in range(2))
        self.copy_to(identity, position, velocity)
        return identity, position, velocity

    def copy_to(self, identity: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> int:
        """Copy the live rows into arrays of the caller, in one pass, in the order of the grid.

        Args:
            identity: int32, (m,).
            position: [m], of the precision of the run, (m, 3).
            velocity: [m/s], likewise.

        Returns:
            how many rows were written: what there is, or m if that is less.
        """
        copy_rows(self, identity, position, velocity)
        return min(int(self.count[None]), len(identity))

    def identities(self) -> np.ndarray:
        """Live identities, ascending, shape (n,)."""
        return np.sort(self.identity.to_numpy()[: self.count[None]])


@ti.kernel
def place_rows(
    p: ti.template(), position: ti.types.ndarray(ndim=2), velocity: ti.types.ndarray(ndim=2)
):
    """Row i is particle i.  Writes: position, velocity, identity, count."""
    p.count[None] = position.shape[0]
    for i in range(position.shape[0]):
        for a in ti.static(range(3)):
            p.position[i][a] = position[i, a]
            p.velocity[i][a] = velocity[i, a]
        p.identity[i] = i


@ti.kernel
def copy_rows(
    p: ti.template(),
    identity: ti.types.ndarray(ndim=1),
    position: ti.types.ndarray(ndim=2),
    velocity: ti.types.ndarray(ndim=2),
):
    """Writes: the arrays, as far as they reach."""
    for i in range(ti.min(p.count[None], identity.shape[0])):
        identity[i] = p.identity[i]
        for a in ti.static(range(3)):
            position[i, a] = p.position[i][a]
            velocity[i, a] = p.velocity[i][a]
