"""Simulation: the blood of a scene in its vessel."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti

from taichi_sph.acceleration import AccelerationModel, Fluid, SphAcceleration
from taichi_sph.calibration import calibrate
from taichi_sph.derived import Derived, derive
from taichi_sph.diagnostics import Diagnostics, diagnose
from taichi_sph.equation_of_state import Tait
from taichi_sph.errors import InputError
from taichi_sph.motion import Motion
from taichi_sph.neighbors import Neighbors, cells_within, make_grid
from taichi_sph.particles import Particles
from taichi_sph.rheology import rheology_of
from taichi_sph.scene import Scene
from taichi_sph.smoothing_kernels import WendlandC2
from taichi_sph.vessel import Vessel, read_vessel
from taichi_sph.wall import Wall

ModelMaker = Callable[[Fluid, int], AccelerationModel]
"""Makes a model for a fluid and a number of particles."""

SKIN = 0.1
"""Skin of the neighbour lists over the support radius: a wider one is built less often and holds
more candidates; from 0.12 on (2.24 d) it holds the lattice's next shell.  Of 0.02 to 0.3, PcNet
pours A fastest with 0.1 and the physics, whose steps are short, is 7 % faster with 0.05 to 0.08."""

OPENING_REACH = 2.5
"""Blood beyond an opening's plane has left by it within this many radii of its centre."""

LOST = -2
"""identity of a particle that left the grid's box; drained ones have -3 - opening."""


@ti.kernel
def mark_removed(
    p: ti.template(),
    grid: ti.template(),
    centre: ti.template(),
    normal: ti.template(),
    reach: ti.template(),
    removed: ti.template(),
):
    """Mark blood beyond an open opening, or out of the box.  Writes: identity, removed."""
    for i in range(p.count[None]):
        x = p.position[i]
        for k in range(centre.shape[0]):
            r = x - centre[k]
            beyond = reach[k] > 0.0 and r.dot(normal[k]) > 0.0 and r.norm() < reach[k]
            if beyond and p.identity[i] >= 0:
                p.identity[i] = LOST - 1 - k
                ti.atomic_add(removed[k], 1)
        if p.identity[i] >= 0:
            for a in ti.static(range(3)):
                upper = grid.lower[a] + grid.cell[a] * grid.shape[a]
                outside = x[a] < grid.lower[a] or x[a] > upper
                if outside and p.identity[i] >= 0:
                    p.identity[i] = LOST
                    ti.atomic_add(removed[centre.shape[0]], 1)


@dataclass(frozen=True)
class Snapshot:
    """All that changes from step to step; rows in the order of the grid."""

    time: float
    """[s]"""
    last_step: float
    """[s]"""
    fallback_time: float
    """[s]"""
    steps: int
    wall_corrections: int
    removed: np.ndarray
    """Particles that left by each opening, then those lost, (openings + 1,)."""
    identity: np.ndarray
    """(n,)"""
    position: np.ndarray
    """[m], (n, 3)."""
    velocity: np.ndarray
    """[m/s], (n, 3)."""
    acceleration: np.ndarray
    """[m/s^2], (n, 3)."""
    density: np.ndarray
    """[kg/m^3], (n,)."""


class Simulation(Motion):
    """Blood of a scene in its vessel."""

    def __init__(
        self, scene: Scene, vessel: Vessel, make_model: ModelMaker = SphAcceleration, seed: int = 0
    ):
        """Sample the wall, fill the column and set up the model (the physics by default).

        Raises:
            InputError: the column does not fit the vessel.
        """
        grid = scene.discretization
        kernel = WendlandC2(grid.support_ratio * grid.spacing)
        wall_spacing = grid.wall_spacing_ratio * grid.spacing
        calibration = calibrate(kernel, grid.spacing, wall_spacing, scene.blood.density)
        setback = calibration.setback
        sample = vessel.sample_wall(wall_spacing, setback, seed)
        blood = vessel.fill_column(scene.column, grid.spacing)
        self.scene = scene
        self.vessel = vessel
        self.derived: Derived = derive(scene, vessel, len(blood), len(sample.positions))
        fluid = Fluid(
            kernel=kernel,
            state=Tait(scene.blood.density, self.derived.sound_speed),
            rheology=rheology_of(scene.blood.rheology),
            calibration=calibration,
            artificial_viscosity=scene.blood.artificial_viscosity,
            courant_number=grid.courant_number,
            nested=grid.viscous_form == "nested",
        )
        particles = Particles.from_numpy(blood, mass=scene.blood.density * grid.spacing**3)
        wall = Wall.from_numpy(sample.positions, sample.normals, kernel, setback, wall_spacing)
        skin = SKIN * kernel.support_radius
        margin = 2.0 * (kernel.support_radius + skin)
        lower, upper = vessel.vertices.min(axis=0) - margin, vessel.vertices.max(axis=0) + margin
        cells = make_grid(lower, upper, kernel.support_radius + skin)
        neighbors = Neighbors.allocate(
            cells,
            kernel.support_radius,
            skin,
            len(blood),
            grid.spacing,
            wall,
            # The wall's proxies, and blood that leaves through an opening, are within this.
            cells_within(cells, vessel.signed_distance, margin),
        )
        super().__init__(
            particles,
            wall,
            neighbors,
            make_model(fluid, len(blood)),
            scene.gravity,
            # Faster than sound the equation of state means nothing.
            speed_limit=self.derived.sound_speed,
            integrator=grid.integrator,
        )
        openings = vessel.openings
        self._opening_centre = ti.Vector.field(3, float, max(1, len(openings)))
        self._opening_normal = ti.Vector.field(3, float, max(1, len(openings)))
        self._opening_reach = ti.field(float, max(1, len(openings)))
        self._removed = ti.field(int, max(1, len(openings)) + 1)
        for k, opening in enumerate(openings):
            self._opening_centre[k] = opening.centre
            self._opening_normal[k] = opening.normal
            self._opening_reach[k] = OPENING_REACH * opening.radius if opening.is_open else 0.0

    @classmethod
    def from_scene(
        cls, scene: Scene, make_model: ModelMaker = SphAcceleration, seed: int = 0
    ) -> "Simulation":
        """Read the vessel of a scene and set everything up.

        Raises:
            InputError: the surface cannot be used, or the column does not fit.
        """
        return cls(scene, read_vessel(scene), make_model, seed)

    def place(self, position: np.ndarray, velocity: np.ndarray) -> None:
        """Begin again, at time zero, with other blood.

        Args:
            position: [m], (n, 3); row k gets identity k; n at most what the column had.
            velocity: [m/s], (n, 3).

        Raises:
            InputError: there is no room for so many.
        """
        particles = self.particles
        if len(position) > particles.capacity:
            raise InputError(
                f"{len(position)} particles: there is room for {particles.capacity}, those of the "
                "scene's column"
            )
        self.put(np.arange(len(position)), position, velocity)
        particles.acceleration.fill(0.0)
        self._removed.fill(0)
        self.time = self.last_step = self.fallback_time = 0.0
        self.steps = self.wall_corrections = 0

    def put(self, identity: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> None:
        """Replace the blood: identities (n,), positions [m] and velocities [m/s], (n, 3)."""
        self.particles.replace(identity=identity, position=position, velocity=velocity)
        self._stale = True

    def snapshot(self) -> Snapshot:
        """A copy of the state; the lists are built anew at the next step.

        A simulation that goes on from the copy builds them too: both then add up in the same order
        and stay bitwise alike on the CPU.
        """
        p, n = self.particles, self.particles.count[None]
        self._stale = True
        return Snapshot(
            self.time, self.last_step, self.fallback_time, self.steps, self.wall_corrections,
            self._removed.to_numpy(),
            *(
                field.to_numpy()[:n]
                for field in (p.identity, p.position, p.velocity, p.acceleration, p.density)
            ),
        )  # fmt: skip

    def go_on_from(self, state: Snapshot) -> None:
        """Go on from a state of the same scene and model.

        Raises:
            InputError: it is of another number of openings, or there is no room for so many.
        """
        n, p = len(state.identity), self.particles
        if n > p.capacity or state.removed.shape != self._removed.shape:
            raise InputError(
                f"a state of {n} particles and {len(state.removed) - 1} openings: the scene has "
                f"{p.capacity} and {self._removed.shape[0] - 1}"
            )
        p.replace(
            identity=state.identity,
            position=state.position,
            velocity=state.velocity,
            acceleration=state.acceleration,
            density=state.density,
        )
        self._removed.from_numpy(state.removed)
        self.time, self.last_step, self.fallback_time = (
            state.time, state.last_step, state.fallback_time
        )  # fmt: skip
        self.steps, self.wall_corrections = state.steps, state.wall_corrections
        self._stale = True

    def before_build(self) -> None:
        """Mark what has left through an opening, or out of the box."""
        mark_removed(
            self.particles,
            self.neighbors.grid,
            self._opening_centre,
            self._opening_normal,
            self._opening_reach,
            self._removed,
        )

    def positions(self) -> np.ndarray:
        """Positions of the live blood [m], shape (n, 3), in order of identity."""
        return self.particles.in_order(self.particles.position)

    def velocities(self) -> np.ndarray:
        """Velocities of the live blood [m/s], shape (n, 3), in order of identity."""
        return self.particles.in_order(self.particles.velocity)

    def identities(self) -> np.ndarray:
        """Identities of the live blood, ascending, shape (n,)."""
        return self.particles.identities()

    def diagnostics(self) -> Diagnostics:
        """Figures of the present state; leaks are counted against the surface itself."""
        removed = self._removed.to_numpy()
        names = [o.name for o in self.vessel.openings]
        drained = {name: int(n) for name, n in zip(names, removed, strict=False)}
        density = self.particles.in_order(self.particles.density)
        leaks = self.vessel.count_leaks(self.positions()) + int(removed[-1])
        return diagnose(self, density, drained, leaks)
