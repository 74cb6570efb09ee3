"""The boundary protocol: what moves the wall, brings blood in or takes it out.

`Simulation` asks each of its boundaries, in their order, at fixed moments:

    moment             when                                        what a boundary may do there
    before_lists       the neighbour lists are about to be built   add particles, mark some removed
    before_drift       every step, after the accelerations         move buffers, tool and wall
    reset              blood has been replaced, the clock is set   be as at the start
    save_state         between two steps                           nothing
    load_state         blood and clock are back, lists are stale   put itself and its wall back
    compile_kernels    before a session                            launch what changes nothing

A step is  (before_lists, build lists, if they are stale) -> accelerate -> before_drift -> drift.
What a user does to a boundary between two steps (its other methods) may change the wall and the
blood at once, and then leaves the lists stale.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taichi_sph.errors import InputError
from taichi_sph.fluid.model import AccelerationModel
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.wall import Wall


def finite_numbers(name: str, values: Any, shape: tuple[int, ...] = ()) -> np.ndarray:
    """What a user gave, as numbers of double precision.

    Args:
        name: of what was given, for the sentence.
        values: a number, or numbers.
        shape: that is wanted.

    Raises:
        InputError: they are no numbers, not finite, or of another shape.
    """
    try:
        numbers = np.asarray(values, float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: {values!r} is no number; allowed: finite numbers") from None
    if numbers.shape != shape:
        wanted = f"an array of shape {shape}" if shape else "one number"
        raise InputError(f"{name}: found an array of shape {numbers.shape}; allowed: {wanted}")
    if not np.isfinite(numbers).all():
        row = np.argwhere(~np.isfinite(numbers))[0]
        where = f" in row {row[0]}" if len(shape) > 1 else ""
        raise InputError(f"{name}: found {numbers[tuple(row)]}{where}; allowed: finite numbers")
    return numbers


@dataclass(frozen=True)
class Datum:
    """Pressure D(x) = value + gradient.x that others are measured from: see `PressureDatum`."""

    value: float = 0.0
    """At the origin [Pa]."""
    gradient: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[Pa/m]"""
    share: float = 0.0
    """Of gravity, that it balances."""

    def at(self, x: np.ndarray) -> np.ndarray:
        """D(x) [Pa] at positions [m], (..., 3)."""
        return np.asarray(self.value + x @ np.asarray(self.gradient))


@dataclass(eq=False)
class BloodFlow:
    """Blood, the wall about it and the lists between them, at a time: what boundaries act upon."""

    particles: Particles
    wall: Wall
    neighbors: Neighbors
    gravity: tuple[float, float, float]
    """Body force per mass g [m/s^2]."""
    time: float = 0.0
    """Simulated time [s]."""
    sound_speed: float = 0.0
    """Present sound speed c [m/s]; 0 where the model's own stays."""
    datum: Datum = field(default_factory=Datum)
    """What pressure is measured from now."""
    largest_speed: float = 0.0
    """Of blood in the last step [m/s]."""
    local_share: float = 0.0
    """Part of the pressure about a particle that its own is measured from, of particles that have a
    local datum (`taichi_sph.fluid.local_datum`)."""

    @property
    def felt_gravity(self) -> tuple[float, float, float]:
        """Gravity that the datum does not balance [m/s^2]."""
        x, y, z = self.gravity
        rest = 1.0 - self.datum.share
        return rest * x, rest * y, rest * z

    def __post_init__(self) -> None:
        """Bring the wall into the order of the lists."""
        self.neighbors.sort_wall(self.wall)


class Boundary(ABC):
    """One thing that moves the wall, brings blood in or takes it out."""

    name: str
    """Key of its part of a saved state."""

    def before_lists(self) -> None:
        """Add particles, and mark those that are to be removed with a negative identity."""
        return

    def before_drift(self, dt: float, model: AccelerationModel) -> float:
        """Move what moves by a step of dt [s], under the accelerations that `model` has written.

        Returns:
            how far a proxy, or a place that blood is looked up at, may have moved [m].
        """
        return 0.0

    def compile_kernels(self, model: AccelerationModel) -> None:
        """Launch the kernels that a user would otherwise wait for; nothing changes."""
        return

    @abstractmethod
    def reset(self) -> None:
        """Be as at the start, at the time that the flow has."""

    @abstractmethod
    def save_state(self) -> dict[str, Any]:
        """All that changes, by name: numbers, names, lists of them, and arrays."""

    @abstractmethod
    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from what `save_state` gave for the same scene."""
