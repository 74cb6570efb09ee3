"""Stage: a simulation that can be put into a recorded state and driven by either model."""

import numpy as np
import taichi as ti

from nn.dataset import RecordedState, Substeps
from nn.features import GATHERED, FeatureScales, extract
from taichi_sph.errors import InputError
from taichi_sph.fluid.wcsph import Fluid, SphAcceleration, sum_density
from taichi_sph.geometry.vessel import Vessel
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation


class ReplaySimulation(Simulation):
    """A simulation whose future is a function of what a frame stores, and of nothing else.

    Lists that are built once in some steps sum in an order that depends on where blood was then.
    `settle` builds them at every frame, so that a run restored from a frame goes on bit for bit.
    """

    fluid: Fluid
    """The constants of the physics."""
    physics: SphAcceleration

    def __init__(self, scene: Scene, vessel: Vessel, seed: int):
        """As `Simulation`, by the physics and with no step longer than the scene's own.

        Raises:
            InputError: as `Simulation`, or a pump or the wall drives it, and not the blood alone.
        """
        for name, table in scene.openings.items():
            if table.driven:
                raise InputError(
                    f"openings.{name}: is driven; only scenes whose blood stays the same can be "
                    "recorded: take flow and pressure out"
                )
        if scene.wall is not None:
            raise InputError("wall: pulses; only scenes whose wall stands still can be recorded")
        super().__init__(scene, vessel, self._make_model, seed)
        self.step_limit = self.derived.step
        self._taken: list[float] = []
        self._features = ti.ndarray(float, (self.particles.capacity, GATHERED))

    def _make_model(self, fluid: Fluid, capacity: int) -> SphAcceleration:
        self.fluid = fluid
        self.physics = SphAcceleration(fluid, capacity)
        return self.physics

    def step(self, remaining: float) -> None:
        """As `Simulation`; the step is noted."""
        super().step(remaining)
        self._taken.append(self.last_step)

    def substeps(self) -> Substeps:
        """Steps taken since this was last asked."""
        taken, self._taken = self._taken, []
        return Substeps(len(taken), min(taken), max(taken)) if taken else Substeps()

    def settle(self) -> None:
        """Drop what has left, and build the lists for blood as it stands."""
        self.before_build()
        self.neighbors.build(self.particles, self.wall)
        self._stale = False

    def state(self) -> RecordedState:
        """The blood, a row for each particle of the start."""
        particles = self.particles
        identity = particles.identity.to_numpy()[: particles.count[None]]
        alive = np.zeros(particles.capacity, bool)
        alive[identity] = True
        rows = []
        for field in (particles.position, particles.velocity):
            values = field.to_numpy()[: len(identity)]
            rows.append(np.zeros((len(alive), 3), values.dtype))
            rows[-1][identity] = values
        position, velocity = rows
        return RecordedState(position, velocity, alive)

    def restore(self, state: RecordedState, time: float, steps: int) -> None:
        """Go back, or on, to a state at a time [s] after a number of steps."""
        rows = np.flatnonzero(state.alive)
        self.put(rows, state.position[rows], state.velocity[rows])
        self.time = time
        self.steps = steps
        self.settle()

    def set_acceleration(self, acceleration: np.ndarray) -> None:
        """Give every particle a previous acceleration [m/s^2], by identity, (n, 3)."""
        particles = self.particles
        identity = particles.identity.to_numpy()[: particles.count[None]]
        rows = particles.acceleration.to_numpy()
        rows[: len(identity)] = acceleration[identity]
        particles.acceleration.from_numpy(rows)

    def viscosity(self) -> np.ndarray:
        """The physics' viscosity of the blood as it stands [Pa s], a row a particle."""
        own = self.physics
        sum_density(
            self.particles, self.wall, self.neighbors, own.fluid, own.pressure_term, own.viscosity
        )
        return own.viscosity.to_numpy()[: self.particles.count[None]]

    def features(self, scales: FeatureScales) -> np.ndarray:
        """What `nn.features.features_of` gives for the state as it stands, a row a particle."""
        self._features.fill(0.0)
        extract(self.particles, self.wall, self.neighbors, self.fluid, scales, self._features)
        return self._features.to_numpy()
