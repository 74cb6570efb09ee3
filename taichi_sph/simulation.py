"""Simulation: blood, the model of its accelerations and its boundaries, advanced step by step."""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from taichi_sph.assemble import Assembly, assemble
from taichi_sph.boundary.boundary import BloodFlow, Boundary, finite_numbers
from taichi_sph.boundary.inflow import BufferZones
from taichi_sph.boundary.outlets import Outlets
from taichi_sph.boundary.suction import Suction
from taichi_sph.boundary.tool import Tool
from taichi_sph.boundary.wall_motion import MovingWall
from taichi_sph.boundary.wall_stress import WallStress
from taichi_sph.boundary.wounds import Wounds
from taichi_sph.derived import Derived
from taichi_sph.diagnostics import Diagnostics, describe_divergence, diagnose_vessel
from taichi_sph.errors import InputError, RunError
from taichi_sph.fluid.model import AccelerationModel, Fluid
from taichi_sph.fluid.wcsph import SphAcceleration
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.integrator import kick_drift, largest_speed_and_acceleration
from taichi_sph.runtime import finish_fields, require_runtime, runtime_number
from taichi_sph.scene import Scene
from taichi_sph.state import State

ModelFactory = Callable[[Fluid, int], AccelerationModel]
"""Makes a model for a fluid and a number of particles."""

AnyBoundary = TypeVar("AnyBoundary", bound=Boundary)

SAME_TIME = 1e-12
"""Times that differ by less, relatively, are the same: sums of steps round."""


class Simulation:
    """Blood in a box, or in the vessel of a scene, and what moves it.

    Validation flows and tests make it of parts, without boundaries; `from_scene` of a scene.
    """

    def __init__(
        self,
        blood: BloodFlow,
        model: AccelerationModel,
        boundaries: Sequence[Boundary] = (),
        *,
        speed_limit: float,
        integrator: str = "symplectic",
        assembly: Assembly | None = None,
    ):
        """Put the parts together.

        Args:
            blood: to be moved, with its wall.
            model: of the accelerations.
            boundaries: in the order in which they are to be asked.
            speed_limit: a higher speed [m/s] ends the run.
            integrator: "symplectic", or "paper" for Eqs. 17 and 18 as printed.
            assembly: what it is assembled from, of a scene.
        """
        self.blood = blood
        self.particles, self.wall, self.neighbors = blood.particles, blood.wall, blood.neighbors
        self.model = model
        self.boundaries = tuple(boundaries)
        self.speed_limit = speed_limit
        self.as_printed = integrator == "paper"
        self.steps = 0
        self.last_step = 0.0
        """[s]"""
        self.wall_corrections = 0
        """How often blood was kept from passing the wall, see `kick_drift`."""
        self.fallback_time = 0.0
        """Simulated time for which the model fell back to the physics [s]."""
        self.step_limit = math.inf
        """Longest step allowed beside the model's own limit [s]."""
        self._assembly = assembly
        self._inflow = self._find(BufferZones)
        self._runtime = runtime_number()
        finish_fields()

    @classmethod
    def from_scene(
        cls, scene: Scene, make_model: ModelFactory = SphAcceleration, seed: int = 0,
        vessel: Vessel | None = None,
    ) -> "Simulation":  # fmt: skip
        """Read the vessel of a scene, unless it is given, and set everything up.

        Raises:
            InputError: the surface cannot be used, or the column does not fit.
            RunError: Taichi was not started, or in another thread.
        """
        runtime_number()
        parts = assemble(scene, read_vessel(scene) if vessel is None else vessel, seed)
        return cls(
            parts.blood,
            make_model(parts.fluid, parts.blood.particles.capacity),
            parts.boundaries,
            # Faster than sound the equation of state means nothing.
            speed_limit=parts.derived.sound_speed,
            integrator=scene.discretization.integrator,
            assembly=parts,
        )

    # A step

    def step(self, remaining: float) -> None:
        """Advance by one step of at most `remaining` seconds.

        Raises:
            RunError: a state that is not finite, too fast, or clumped; too much blood driven in.
        """
        self._require_runtime()
        p, w, nb = self.particles, self.wall, self.neighbors
        if nb.stale:
            self.rebuild_lists()
        self._accelerate(self.model)
        dt = self._choose_step(remaining)
        wall_moved = sum(b.before_drift(dt, self.model) for b in self.boundaries)
        blood_moved2, corrected = kick_drift(
            p, w, nb, self._inflow, self.as_printed, dt, self.blood.local_share
        )
        nb.note_drift(math.sqrt(blood_moved2), wall_moved)
        self._count_step(dt, int(corrected))

    def _accelerate(self, model: AccelerationModel) -> None:
        """Let a model compute accelerations, at the sound speed and from the datum of now."""
        if self.blood.sound_speed:
            model.sound_speed = self.blood.sound_speed
        model.accelerate(self.particles, self.wall, self.neighbors, self.blood.felt_gravity)

    def rebuild_lists(self) -> None:
        """Let boundaries add and remove blood, and build the lists for it as it stands.

        Raises:
            RunError: too much blood is driven in, or particles have clumped.
        """
        self._require_runtime()
        for boundary in self.boundaries:
            boundary.before_lists()
        self.neighbors.build(self.particles, self.wall)

    def _choose_step(self, remaining: float) -> float:
        """The next step [s], under the accelerations that there are.

        Raises:
            RunError: they or the velocities are not finite, or blood is too fast.
        """
        speed, acceleration, broken = largest_speed_and_acceleration(self.particles)
        if broken or speed > self.speed_limit:
            raise RunError(describe_divergence(self, int(broken)))
        self.blood.largest_speed = speed
        stable = min(self.model.stable_step(speed, acceleration), self.step_limit)
        # Equal steps to the end of the frame, so that none is a sliver.
        return remaining / max(1, math.ceil(remaining / stable * (1.0 - 1e-9)))

    def _count_step(self, dt: float, corrected: int) -> None:
        self.wall_corrections += corrected
        self.last_step = dt
        self.fallback_time += dt * self.model.used_fallback
        self.time += dt
        self.steps += 1

    def advance_to(
        self, time: float, before_step: Callable[[], None] | None = None,
        after_step: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        """Step until a simulated time [s]; the two are called before and after each step.

        Raises:
            InputError: the time is past, or no time.
            RunError: as `step`.
        """
        self._require_runtime()
        self._require_future(time)
        while self.time < time * (1.0 - SAME_TIME):
            if before_step is not None:
                before_step()
            if self.particles.count[None] == 0:
                break
            self.step(time - self.time)
            if after_step is not None:
                after_step()
        self.time = time

    def _require_future(self, time: float) -> None:
        finite_numbers("advance_to: time [s]", time)
        if time < self.time * (1.0 - SAME_TIME):
            raise InputError(
                f"advance_to: {time:g} s is past; blood is at {self.time:g} s and flows forward "
                "only; allowed: that time or a later one"
            )

    # The state

    def restart_with(self, position: np.ndarray, velocity: np.ndarray) -> None:
        """Begin again, at time zero, with other blood.

        Args:
            position: [m], (n, 3); row k gets identity k; n at most what the column had.
            velocity: [m/s], (n, 3).

        Raises:
            InputError: there is no room for so many, or a number is not finite.
        """
        self._require_blood(position, velocity)
        self.time = self.last_step = self.fallback_time = 0.0
        self.steps = self.wall_corrections = 0
        self._reset(position, velocity)

    def reset(self) -> None:
        """Put blood, boundaries and gravity back to the start; clock and steps go on."""
        self.gravity = self.scene.gravity
        blood = self._require_assembly().initial_blood
        self._reset(blood, np.zeros_like(blood))

    def _reset(self, position: np.ndarray, velocity: np.ndarray) -> None:
        """All but gravity as at the start, with such blood, whatever the clock says."""
        self.set_blood(np.arange(len(position)), position, velocity)
        for boundary in self.boundaries:
            boundary.reset()

    def set_blood(self, identity: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> None:
        """Replace the blood: identities (n,), positions [m] and velocities [m/s], (n, 3).

        What else a particle has is zero.

        Raises:
            InputError: there is no room for so many, or a number is not finite.
        """
        self._require_blood(position, velocity)
        self.particles.replace({"identity": identity, "position": position, "velocity": velocity})
        self.neighbors.stale = True

    def _require_blood(self, position: np.ndarray, velocity: np.ndarray) -> None:
        self._require_runtime()
        if len(position) > self.particles.capacity:
            raise InputError(
                f"{len(position)} particles: there is room for {self.particles.capacity}, those of "
                "the scene's column"
            )
        for name, values in (("position [m]", position), ("velocity [m/s]", velocity)):
            finite_numbers(name, values, (len(position), 3))

    def save_state(self) -> State:
        """A copy of the state; the lists are built anew at the next step.

        A simulation that goes on from the copy builds them too: both then add up in the same order
        and stay bitwise alike on the CPU.
        """
        self._require_runtime()
        self.neighbors.stale = True
        return State(
            self.time, self.last_step, self.fallback_time, self.steps, self.wall_corrections,
            self.model.name, self.gravity,
            {boundary.name: boundary.save_state() for boundary in self.boundaries},
            self.particles.rows(),
        )  # fmt: skip

    def load_state(self, state: State) -> None:
        """Go on from a state of the same scene, under a model of the name that it has.

        Raises:
            InputError: it is of other boundaries, or there is no room for so many; nothing changes.
        """
        self._require_runtime()
        n, capacity = len(state.particles["identity"]), self.particles.capacity
        unknown = state.boundaries.keys() - {boundary.name for boundary in self.boundaries}
        measured = WallStress.name in unknown
        unknown -= {WallStress.name}
        if n > capacity or unknown:
            raise InputError(
                f"a state of {n} particles with {', '.join(unknown) or 'nothing'} that the scene "
                f"has not; there is room for {capacity}"
            )
        if measured:
            self.measure_wall_stress()
        before = self.save_state()
        try:
            self._load(state)
        except InputError:
            self._load(before)
            raise

    def _load(self, state: State) -> None:
        self.particles.replace(state.particles)
        self.time, self.last_step = state.time, state.last_step
        self.fallback_time = state.fallback_time
        self.steps, self.wall_corrections = state.steps, state.wall_corrections
        self.gravity = state.gravity
        self.neighbors.stale = True
        for boundary in self.boundaries:
            if boundary.name in state.boundaries:
                boundary.load_state(state.boundaries[boundary.name])
            else:
                boundary.reset()  # the state is older than this kind of boundary

    # Models

    def use_model(self, model: AccelerationModel) -> None:
        """Let another model, made by `make_model`, compute accelerations from now on."""
        self.model = model

    def make_model(self, make_model: ModelFactory) -> AccelerationModel:
        """A model for this simulation; its fields stay in memory for good.

        Raises:
            RunError: this is not the thread that called `start`.
        """
        self._require_runtime()
        runtime_number()
        model = make_model(self.fluid, self.particles.capacity)
        finish_fields()
        return model

    def compile_kernels(self, models: Sequence[AccelerationModel]) -> None:
        """Have models and boundaries compile what they need, before anybody waits for it.

        Nothing moves.
        """
        self._require_runtime()
        self.neighbors.build(self.particles, self.wall)
        for model in models:
            acceleration = self.particles.acceleration.to_numpy()
            self._accelerate(model)
            self.particles.acceleration.from_numpy(acceleration)
            for boundary in self.boundaries:
                boundary.compile_kernels(model)
        self.neighbors.stale = True

    @property
    def outlets(self) -> Outlets:
        """Where blood leaves, how much has left, and droplets that fall."""
        return self.boundary(Outlets)

    @property
    def inflow(self) -> BufferZones:
        """What drives blood through openings."""
        return self.boundary(BufferZones)

    @property
    def wounds(self) -> Wounds:
        """Wounds: open and close them."""
        return self.boundary(Wounds)

    @property
    def suction(self) -> Suction:
        """Suction at the tool's tip: set its rate."""
        return self.boundary(Suction)

    @property
    def tool(self) -> Tool:
        """The tool: move it, take its force."""
        return self.boundary(Tool)

    def measure_wall_stress(self) -> WallStress:
        """Sum the friction on the wall from now on, or go on with it: wall shear stress.

        Raises:
            LookupError: the simulation is not of a scene.
        """
        measured = self._find(WallStress)
        if measured is None:
            vessel = self.vessel
            vertices = vessel.vertices[vessel.wall_vertices].astype(float)
            measured = WallStress(self.blood, self.fluid, vertices, vessel.wall_normals)
            self.boundaries = (*self.boundaries, measured)
        return measured

    @property
    def wall_motion(self) -> MovingWall | None:
        """What moves the vessel's wall; None where it stands still."""
        self._require_runtime()
        return self._find(MovingWall)

    def boundary(self, kind: type[AnyBoundary]) -> AnyBoundary:
        """The boundary of a kind.

        Raises:
            LookupError: there is none, as without a scene.
            RunError: it was made before the last `start`.
        """
        self._require_runtime()
        boundary = self._find(kind)
        if boundary is None:
            raise LookupError(f"this simulation has no {kind.__name__}")
        return boundary

    def _find(self, kind: type[AnyBoundary]) -> AnyBoundary | None:
        return next((b for b in self.boundaries if isinstance(b, kind)), None)

    # What it is of

    @property
    def scene(self) -> Scene:
        """The scene that it was made from."""
        return self._require_assembly().scene

    @property
    def vessel(self) -> Vessel:
        """The vessel of the scene."""
        return self._require_assembly().vessel

    @property
    def derived(self) -> Derived:
        """Numbers that follow from the scene."""
        return self._require_assembly().derived

    @property
    def fluid(self) -> Fluid:
        """Constants of the blood."""
        return self._require_assembly().fluid

    def _require_assembly(self) -> Assembly:
        if self._assembly is None:
            raise LookupError("this simulation was made of parts: it has no scene and no vessel")
        return self._assembly

    def _require_runtime(self) -> None:
        require_runtime(self._runtime)

    # What is read out

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.blood.time

    @time.setter
    def time(self, time: float) -> None:
        self.blood.time = time

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Body force per mass g [m/s^2]."""
        return self.blood.gravity

    @gravity.setter
    def gravity(self, gravity: tuple[float, float, float]) -> None:
        finite_numbers("gravity [m/s^2]", gravity, (3,))
        self.blood.gravity = gravity

    @property
    def fallback_share(self) -> float:
        """Part of the simulated time in which the model fell back to the physics."""
        return self.fallback_time / self.time if self.time else 0.0

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of the box that blood may be in [m]."""
        grid = self.neighbors.grid
        low = np.array(grid.lower)
        return low, low + np.array(grid.cell) * np.array(grid.shape)

    def positions(self) -> np.ndarray:
        """Positions of the live blood [m], shape (n, 3), in order of identity."""
        return self.particles.in_order(self.particles.position)

    def velocities(self) -> np.ndarray:
        """Velocities of the live blood [m/s], shape (n, 3), in order of identity."""
        return self.particles.in_order(self.particles.velocity)

    def positions_and_velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """Both in one pass: [m] and [m/s], (n, 3), in order of identity."""
        identity, position, velocity = self.particles.live()
        order = np.argsort(identity)
        return position[order], velocity[order]

    def pressures(self) -> np.ndarray:
        """Pressures of the live blood in the last step [Pa], (n,), in order of identity.

        Raises:
            LookupError: the model knows none.
        """
        coefficients = self.model.pair_coefficients
        if coefficients is None:
            raise LookupError(f"{self.model.name} gives accelerations and no pressure")
        density = self.particles.in_order(self.particles.density).astype(float)
        above = self.particles.in_order(coefficients[1]).astype(float) * density**2
        return np.asarray(above + self.blood.datum.at(self.positions().astype(float)))

    def identities(self) -> np.ndarray:
        """Identities of the live blood, ascending, shape (n,)."""
        return self.particles.identities()

    def diagnostics(self) -> Diagnostics:
        """Figures of the present state; leaks are counted against the surface itself."""
        self._require_runtime()
        return diagnose_vessel(self)
