"""Diagnostics: what a frame says about the state of the blood, and why a run had to stop."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taichi_sph.boundary.outlets import OUT_OF_BOX, SUCTION
from taichi_sph.boundary.tracer import Tracer
from taichi_sph.fluid.model import AccelerationModel

FEW = 0.2
"""Part of the blood below which its centre of mass says little."""


@dataclass(frozen=True)
class Diagnostics:
    """Diagnostics of one frame."""

    time: float
    """Simulated time [s]."""
    step: float
    """Last time step [s]."""
    particles: int
    """Live blood particles."""
    drained: dict[str, int]
    """Particles that have left, by opening."""
    drained_volume: float
    """Volume that has left through openings [m^3]."""
    leaks: int
    """Particles outside the lumen that no opening explains, with those lost for good."""
    wall_corrections: int
    """How often blood was kept from passing the wall since the start, see `kick_drift`."""
    compression_p99: float
    """99th percentile of max(rho/rho_0 - 1, 0)."""
    compression_max: float
    """Largest of the same."""
    kinetic_energy: float
    """Sum of m v^2/2 [J]."""
    max_speed: float
    """Largest speed [m/s]."""
    fallback_share: float
    """Part of the simulated time in which the model fell back to the physics."""
    viscosity_bounded: float = 0.0
    """Part of the blood whose viscosity the model held at its bound in the last step."""
    added_volume: float = 0.0
    """Volume that was driven in [m^3]."""
    bled_volume: float = 0.0
    """Volume that has left through wounds [m^3]."""
    sucked_volume: float = 0.0
    """Volume that was aspirated [m^3]."""
    mean_age: dict[str, float] = field(default_factory=dict)
    """Mean age of all that has left [s], by opening that something has left by."""


def compression(density: np.ndarray, rest_density: float) -> tuple[float, float]:
    """99th percentile and largest of max(rho/rho_0 - 1, 0)."""
    if not len(density):
        return 0.0, 0.0
    excess = np.maximum(density / rest_density - 1.0, 0.0)
    return float(np.percentile(excess, 99)), float(excess.max())


def viscosity_bounded(model: AccelerationModel, count: int) -> float:
    """Part of the first `count` rows whose viscosity a model held at its bound in the last step."""
    if model.pair_coefficients is None or count == 0 or math.isinf(model.largest_viscosity):
        return 0.0
    viscosity = model.pair_coefficients[2].to_numpy()[:count]
    return float((viscosity >= model.largest_viscosity * (1.0 - 1e-5)).mean())


def diagnose(
    simulation: Any,
    density: np.ndarray,
    drained: dict[str, int],
    leaks: int,
    added: int = 0,
    bled: int = 0,
    sucked: int = 0,
    mean_age: dict[str, float] | None = None,
    bounded: float = 0.0,
) -> Diagnostics:
    """Diagnostics of a simulation, ours or one that is read as ours is.

    Args:
        simulation: what moves the blood.
        density: of the live blood, rho [kg/m^3], (n,).
        drained: particles that have left, by opening.
        leaks: particles outside the lumen that no opening explains.
        added: particles that were driven in.
        bled: particles that have left through wounds.
        sucked: particles that were aspirated.
        mean_age: of what has left [s], by opening.
        bounded: part of the blood whose viscosity the model held at its bound.
    """
    volume = simulation.particles.mass / simulation.scene.blood.density
    rest_density = simulation.scene.blood.density
    velocity = simulation.velocities().astype(np.float64)
    p99, largest = compression(density, rest_density) if simulation.steps else (0.0, 0.0)
    speed2 = (velocity**2).sum(axis=1)
    return Diagnostics(
        time=simulation.time,
        step=simulation.last_step,
        particles=len(velocity),
        drained=drained,
        drained_volume=sum(drained.values()) * volume,
        added_volume=added * volume,
        bled_volume=bled * volume,
        sucked_volume=sucked * volume,
        leaks=leaks,
        wall_corrections=simulation.wall_corrections,
        compression_p99=p99,
        compression_max=largest,
        kinetic_energy=float(0.5 * simulation.particles.mass * speed2.sum()),
        max_speed=float(np.sqrt(speed2.max(initial=0.0))),
        fallback_share=simulation.fallback_share,
        viscosity_bounded=bounded,
        mean_age=mean_age or {},
    )


def diagnose_vessel(simulation: Any) -> Diagnostics:
    """Diagnostics of a simulation of a scene; leaks are counted against the surface itself."""
    counts = simulation.outlets.outflow_counts()
    names = [o.name for o in simulation.vessel.openings]
    left = counts[2:]
    drained = {name: int(n) for name, n in zip(names, left, strict=False)}
    ages = simulation.boundary(Tracer).mean_age()[2:]
    mean_age = {name: float(ages[k]) for k, name in enumerate(names) if left[k] > 0}
    density = simulation.particles.in_order(simulation.particles.density)
    x = simulation.positions()
    held = np.ones(len(x), bool)
    for wound in simulation.wounds:
        # Blood in the hole has not leaked.
        held &= wound.distance(x) > wound.radius + 3.0 * simulation.scene.discretization.spacing
    widened = simulation.wall.displacement_factor * simulation.wall.largest_amplitude
    leaks = simulation.vessel.count_leaks(x[held], widened) + int(counts[OUT_OF_BOX])
    return diagnose(
        simulation, density, drained, leaks, added=simulation.inflow.added,
        bled=int(left[len(names) :].sum()), sucked=int(counts[SUCTION]),
        mean_age=mean_age,
        bounded=viscosity_bounded(simulation.model, simulation.particles.count[None]),
    )  # fmt: skip


def describe_divergence(simulation: Any, broken: int) -> str:
    """One sentence on a run that has to stop: which particle, when, and why, as far as can be told.

    Args:
        simulation: whose blood is too fast or not finite.
        broken: particles that are not finite.
    """
    particles, neighbors = simulation.particles, simulation.neighbors
    rows = particles.rows()
    velocity, identity = rows["velocity"], rows["identity"]
    at = f"at t = {simulation.time:.6g} s, step {simulation.steps}"
    if broken:
        finite = [np.isfinite(a).all(axis=1) for a in (velocity, rows["acceleration"])]
        row = int(np.flatnonzero(~(finite[0] & finite[1]))[0])
        what = f"particle {identity[row]} is not finite ({broken} in all) {at}"
    else:
        speed = np.linalg.norm(velocity, axis=1)
        row = int(speed.argmax())
        what = (
            f"particle {identity[row]} moves at {speed[row]:.3g} m/s, above the limit of "
            f"{simulation.speed_limit:.3g} m/s, {at}"
        )
    place = ", ".join(f"{c:.4g}" for c in rows["position"][row])
    if simulation.as_printed:
        cause = "the printed integrator (Eq. 18) amplifies sound; use integrator = 'symplectic'"
    elif neighbors.blood_count[row] == 0 and neighbors.wall_count[row] == 0:
        cause = "it has no neighbours, so it was thrown out earlier: a smaller spacing may help"
    else:
        cause = "the sound speed is too low for these speeds, or particles began too close"
    return f"the run diverged: {what}, near ({place}) m; likely cause: {cause}"
