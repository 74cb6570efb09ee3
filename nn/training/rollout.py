"""Replay: a simulation that can be put into a recorded state and driven by either model."""

from dataclasses import replace

import numpy as np
import taichi as ti

from nn.dataset.schema import RecordedState, Substeps
from nn.features import ROW_COUNT, FeatureScales, extract
from taichi_sph.errors import InputError
from taichi_sph.fluid.model import Fluid
from taichi_sph.fluid.rheology import Newtonian
from taichi_sph.fluid.wcsph import SphAcceleration, sum_acceleration, sum_density
from taichi_sph.geometry.vessel import Vessel
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation


class ReplaySimulation:
    """A simulation whose future is a function of what a frame stores, and of nothing else.

    Lists that are built once in some steps sum in an order that depends on where blood was then.
    `settle` builds them at every frame, so that a run restored from a frame goes on bit for bit.
    """

    def __init__(self, scene: Scene, vessel: Vessel, seed: int):
        """Set up the scene, by the physics and with no step longer than the scene's own.

        Raises:
            InputError: as `Simulation.from_scene`, or a pump or the wall drives the blood.
        """
        for name, table in scene.openings.items():
            if table.driven:
                raise InputError(
                    f"openings.{name}: is driven; only scenes whose blood stays the same can be "
                    "recorded: take flow and pressure out"
                )
        if scene.wall is not None:
            raise InputError("wall: pulses; only scenes whose wall stands still can be recorded")
        self.simulation = Simulation.from_scene(scene, SphAcceleration, seed, vessel)
        assert isinstance(self.simulation.model, SphAcceleration)
        self.physics: SphAcceleration = self.simulation.model
        self.fluid: Fluid = self.simulation.fluid
        """Constants of the physics."""
        self.use_physics()
        self._step_lengths: list[float] = []
        self._zero: ti.Field | None = None
        """Neither pressure nor viscosity, for `other_acceleration`."""
        self._features = ti.ndarray(float, (self.simulation.particles.capacity, ROW_COUNT))

    def use_physics(self) -> None:
        """Let the physics drive, with no step longer than the scene's own."""
        self.simulation.use_model(self.physics)
        self.simulation.step_limit = self.simulation.derived.step

    def advance_to(self, time: float) -> None:
        """Step until a simulated time [s], noting each step.

        Raises:
            RunError: the run diverged.
        """
        self.simulation.advance_to(time, after_step=self._note_step)

    def _note_step(self) -> None:
        self._step_lengths.append(self.simulation.last_step)

    def substeps(self) -> Substeps:
        """Steps taken since this was last asked."""
        steps, self._step_lengths = self._step_lengths, []
        return Substeps(len(steps), min(steps), max(steps)) if steps else Substeps()

    def settle(self) -> None:
        """Drop what has left, and build the lists for blood as it stands."""
        self.simulation.rebuild_lists()

    def state(self) -> RecordedState:
        """The blood, a row for each particle of the start."""
        particles = self.simulation.particles
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
        self.simulation.set_blood(rows, state.position[rows], state.velocity[rows])
        self.simulation.time, self.simulation.steps = time, steps
        self.settle()

    def set_acceleration(self, acceleration: np.ndarray) -> None:
        """Give every particle a previous acceleration [m/s^2], by identity, (n, 3)."""
        particles = self.simulation.particles
        identity = particles.identity.to_numpy()[: particles.count[None]]
        rows = particles.acceleration.to_numpy()
        rows[: len(identity)] = acceleration[identity]
        particles.acceleration.from_numpy(rows)

    def viscosity(self) -> np.ndarray:
        """The physics' viscosity of the blood as it stands [Pa s], a row a particle.

        It leaves the densities of the blood as it stands.
        """
        blood, own = self.simulation.blood, self.physics
        sum_density(
            blood.particles, blood.wall, blood.neighbors, own.fluid, own.pressure_term,
            own.viscosity, own.sound_speed,
        )  # fmt: skip
        return own.viscosity.to_numpy()[: blood.particles.count[None]]

    def other_acceleration(self) -> np.ndarray:
        """Accelerations by all but pressure, viscosity and gravity [m/s^2], a row a particle.

        What `sum_acceleration` gives where both are zero, of the densities that `viscosity` leaves.
        """
        blood, n = self.simulation.blood, self.simulation.particles.count[None]
        if self._zero is None:
            self._zero = ti.field(float, blood.particles.capacity)
        previous = blood.particles.acceleration.to_numpy()
        inviscid = replace(self.fluid, rheology=Newtonian(0.0), nested=False)
        sum_acceleration(
            blood.particles, blood.wall, blood.neighbors, inviscid, self._zero, self._zero,
            self.physics.stress, self.physics.sound_speed, 0.0, 0.0, 0.0,
        )  # fmt: skip
        other = blood.particles.acceleration.to_numpy()[:n]
        blood.particles.acceleration.from_numpy(previous)
        return other

    def features(self, scales: FeatureScales) -> np.ndarray:
        """What `nn.features.features_of` gives for the state as it stands, a row a particle."""
        blood = self.simulation.blood
        self._features.fill(0.0)
        extract(blood.particles, blood.wall, blood.neighbors, self.fluid, scales, self._features)
        return self._features.to_numpy()
