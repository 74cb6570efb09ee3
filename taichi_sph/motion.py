"""Motion: particles, wall and lists in a box, and the step that every model shares."""

import math
from collections.abc import Callable

import numpy as np

from taichi_sph.boundary.inflow import BufferZones
from taichi_sph.errors import RunError
from taichi_sph.fluid.wcsph import AccelerationModel
from taichi_sph.integrator import NO_PLUGS, NoPlugs, kick_drift, largest_speed_and_acceleration
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.wall import Wall


class Motion:
    """Particles, wall and lists in a box, and the step that all models share.

    It knows no vessel: validation flows and tests use it as it is, `Simulation` adds the scene.
    """

    def __init__(
        self,
        particles: Particles,
        wall: Wall,
        neighbors: Neighbors,
        model: AccelerationModel,
        gravity: tuple[float, float, float],
        speed_limit: float,
        integrator: str = "symplectic",
    ):
        """Put the parts together; a speed above `speed_limit` [m/s] ends the run."""
        self.particles = particles
        self.wall = wall
        self.neighbors = neighbors
        self.model = model
        self.gravity = gravity
        self.speed_limit = speed_limit
        self.printed_integrator = integrator == "paper"
        self.time = 0.0
        self.steps = 0
        self.last_step = 0.0
        self.wall_corrections = 0
        self.fallback_time = 0.0
        """Simulated time for which the model fell back to the physics [s]."""
        self.step_limit = math.inf
        """Longest step allowed beside the model's own limit [s]."""
        self.plugs: BufferZones | NoPlugs = NO_PLUGS
        """What drives blood through openings."""
        self._wall_moved = 0.0
        """How far a proxy may have moved since the lists were built [m]."""
        self._stale = True
        neighbors.sort_wall(wall)

    def step(self, remaining: float) -> None:
        """Advance by one step of at most `remaining` seconds.

        Raises:
            RunError: a state that is not finite, too fast, or clumped.
        """
        if self._stale:
            self.before_build()
            self.neighbors.build(self.particles, self.wall)
            self._wall_moved = 0.0
        self.model.accelerate(self.particles, self.wall, self.neighbors, self.gravity)
        speed, acceleration, broken = largest_speed_and_acceleration(self.particles)
        if broken or speed > self.speed_limit:
            raise RunError(self._diagnosis(int(broken)))
        stable = min(self.model.stable_step(speed, acceleration), self.step_limit)
        # Equal steps to the end of the frame, so that none is a sliver.
        dt = remaining / max(1, math.ceil(remaining / stable * (1.0 - 1e-9)))
        self.before_drift(dt)
        moved2, corrected = kick_drift(
            self.particles, self.wall, self.neighbors, self.plugs, self.printed_integrator, dt
        )
        # Two particles, or one and a proxy, may have come nearer to each other by more.
        moved = math.sqrt(moved2)
        self._stale = moved + max(moved, self._wall_moved) > self.neighbors.skin
        self.wall_corrections += int(corrected)
        self.last_step = dt
        self.fallback_time += dt * self.model.used_fallback
        self.time += dt
        self.steps += 1

    @property
    def fallback_share(self) -> float:
        """Part of the simulated time in which the model fell back to the physics."""
        return self.fallback_time / self.time if self.time else 0.0

    def before_build(self) -> None:
        """Mark particles that are to be removed; nothing here."""

    def before_drift(self, dt: float) -> None:
        """Move what moves blood, by a step of dt [s]; nothing here."""

    def advance_to(self, time: float, before_step: Callable[[], None] | None = None) -> None:
        """Step until a simulated time [s]; `before_step` is called before each step.

        Raises:
            RunError: as `step`.
        """
        while self.time < time * (1.0 - 1e-12):
            if before_step is not None:
                before_step()
            if self.particles.count[None] == 0:
                break
            self.step(time - self.time)
        self.time = time

    def _diagnosis(self, broken: int) -> str:
        """One sentence: which particle, when, and why, as far as the state tells."""
        n = self.particles.count[None]
        velocity = self.particles.velocity.to_numpy()[:n]
        acceleration = self.particles.acceleration.to_numpy()[:n]
        identity = self.particles.identity.to_numpy()[:n]
        at = f"at t = {self.time:.6g} s, step {self.steps}"
        if broken:
            bad = ~np.isfinite(velocity).all(axis=1) | ~np.isfinite(acceleration).all(axis=1)
            row = int(np.flatnonzero(bad)[0])
            what = f"particle {identity[row]} is not finite ({broken} in all) {at}"
        else:
            speed = np.linalg.norm(velocity, axis=1)
            row = int(speed.argmax())
            what = (
                f"particle {identity[row]} moves at {speed[row]:.3g} m/s, above the limit of "
                f"{self.speed_limit:.3g} m/s, {at}"
            )
        place = ", ".join(f"{c:.4g}" for c in self.particles.position.to_numpy()[row])
        if self.printed_integrator:
            cause = "the printed integrator (Eq. 18) amplifies sound; use integrator = 'symplectic'"
        elif self.neighbors.blood_count[row] == 0 and self.neighbors.wall_count[row] == 0:
            cause = "it has no neighbours, so it was thrown out earlier: a smaller spacing may help"
        else:
            cause = "the sound speed is too low for these speeds, or particles began too close"
        return f"the run diverged: {what}, near ({place}) m; likely cause: {cause}"
