"""Particles: the blood's state in Taichi fields."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import taichi as ti

from taichi_sph.errors import RunError
from taichi_sph.runtime import float_dtype, require_runtime, runtime_number


@dataclass(frozen=True)
class Quantity:
    """One thing that each particle carries: sorted, saved, loaded and hashed with it."""

    name: str
    kind: Literal["scalar", "vector", "integer"] = "scalar"
    """A float, three of them, or a 32-bit integer."""

    def make_field(self, rows: int) -> Any:
        """A field of so many zeros."""
        if self.kind == "vector":
            return ti.Vector.field(3, float, rows)
        return ti.field(int if self.kind == "integer" else float, rows)


QUANTITIES = (
    Quantity("identity", "integer"),
    Quantity("position", "vector"),
    Quantity("velocity", "vector"),
    Quantity("acceleration", "vector"),
    Quantity("density"),
)
"""What every particle has; more follow after these."""
LOCAL_DATUM = Quantity("local_datum")
"""Part of the pressure term p/rho^2 of the neighbourhood in the last step [m^5/(kg s^2)], see
`taichi_sph.fluid.local_datum`."""


class Particles:
    """Blood particles; rows 0..count-1 are live, in the order of the neighbour grid.

    Rows move whenever the grid is rebuilt: `identity` says which particle a row holds.  Each
    quantity is a field of its name.
    """

    position: ti.MatrixField
    """x [m], shape (capacity,)."""
    velocity: ti.MatrixField
    """v [m/s], shape (capacity,)."""
    acceleration: ti.MatrixField
    """a [m/s^2], shape (capacity,); state, for a model may read the previous step's."""
    density: ti.Field
    """rho [kg/m^3], shape (capacity,)."""
    shifting: ti.MatrixField
    """Velocity beside the flow at which the next step moves a particle [m/s], shape (capacity,);
    no state: every model writes it."""
    identity: ti.Field
    """Number of the particle, the same for its whole life, shape (capacity,)."""

    def __init__(self, capacity: int, mass: float, more: Sequence[Quantity] = ()):
        """Make the fields; once a run, since Taichi frees none.

        Args:
            capacity: rows.
            mass: blood that a particle stands for, rho_0 d^3 [kg].
            more: what a particle has beside QUANTITIES.
        """
        self.capacity = capacity
        self.mass = mass
        self.quantities = (*QUANTITIES, *more)
        self.count = ti.field(int, ())
        """Number of live particles, 0-D."""
        self.fields = tuple(q.make_field(capacity) for q in self.quantities)
        """One for each quantity, in their order."""
        for quantity, field in zip(self.quantities, self.fields, strict=True):
            setattr(self, quantity.name, field)
        self.shifting = ti.Vector.field(3, float, capacity)
        self.has_local_datum = LOCAL_DATUM in self.quantities
        if self.has_local_datum:
            self.mean_pressure_term = ti.field(float, capacity)
            """Mean of p/rho^2 over the neighbourhood in this step, likewise [m^5/(kg s^2)]."""
        # A sort copies all rows but positions, which the lists hold, through these.
        moved = [k for k, q in enumerate(self.quantities) if q.name != "position"]
        self.sorted_fields = tuple(self.fields[k] for k in moved)
        self.scratch = tuple(self.quantities[k].make_field(capacity) for k in moved)
        self._runtime = runtime_number()

    @classmethod
    def from_numpy(
        cls, position: np.ndarray, velocity: np.ndarray | None = None, mass: float = 1.0,
        room: int = 0, more: Sequence[Quantity] = (),
    ) -> "Particles":  # fmt: skip
        """Particles at given positions [m] and velocities [m/s] (at rest), shape (n, 3).

        There is room for so many more; `more` is what they have beside QUANTITIES.

        Raises:
            RunError: a position or velocity is not finite.
        """
        n = len(position)
        velocity = np.zeros((n, 3)) if velocity is None else velocity
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            raise RunError("initial positions and velocities must be finite numbers")
        particles = cls(n + room, mass, more)
        # One kernel for all: each field's own would cost some 0.05 s at start.
        place_rows(
            particles, *(np.ascontiguousarray(a, float_dtype()) for a in (position, velocity))
        )
        return particles

    def replace(self, rows: Mapping[str, np.ndarray]) -> None:
        """Replace the blood: quantities by name, each (n,) or (n, 3) with the same n <= capacity.

        Quantities that are not given are zero.
        """
        require_runtime(self._runtime)
        for quantity, field in zip(self.quantities, self.fields, strict=True):
            whole = np.zeros_like(field.to_numpy())
            if quantity.name in rows:
                whole[: len(rows[quantity.name])] = rows[quantity.name]
            field.from_numpy(whole)
        self.count[None] = len(rows["identity"])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all quantities."""
        return tuple(quantity.name for quantity in self.quantities)

    def rows(self) -> dict[str, np.ndarray]:
        """Copies of all quantities by name, (n,) or (n, 3), in the order of the grid."""
        require_runtime(self._runtime)
        n = int(self.count[None])
        return {
            quantity.name: field.to_numpy()[:n]
            for quantity, field in zip(self.quantities, self.fields, strict=True)
        }

    def in_order(self, field: ti.Field) -> np.ndarray:
        """Copy of a field's live rows, sorted by identity."""
        require_runtime(self._runtime)
        n = self.count[None]
        order = np.argsort(self.identity.to_numpy()[:n])
        return field.to_numpy()[:n][order]

    def live(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Copies of identities (n,), positions [m] and velocities [m/s], (n, 3), as `copy_to`."""
        require_runtime(self._runtime)
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
        require_runtime(self._runtime)
        copy_rows(self, identity, position, velocity)
        return min(int(self.count[None]), len(identity))

    def identities(self) -> np.ndarray:
        """Live identities, ascending, shape (n,)."""
        require_runtime(self._runtime)
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
