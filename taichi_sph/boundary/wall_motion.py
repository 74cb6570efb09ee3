"""Wall motion: the vessel's wall moves out along its normals and back, as an artery's does.

The motion is prescribed: blood feels it and does not act on it.  The displacement factor, 0 narrow
to 1 wide, is a waveform brought to that range; it rises from 0, the surface of the file, within
`RAMP_TIME`.  The wall is held at the vessel's openings.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from taichi_sph.boundary.boundary import BloodFlow, Boundary
from taichi_sph.errors import InputError
from taichi_sph.fluid.model import AccelerationModel
from taichi_sph.geometry.mesh import Floats
from taichi_sph.geometry.vessel import Vessel
from taichi_sph.particles.wall import move_wall
from taichi_sph.scene import Scene
from taichi_sph.waveform import RAMP_TIME, Waveform, read_waveform

VELOCITY_WINDOW = 1e-3
"""The wall's velocity is its mean over this time [s]: a waveform has kinks."""

LARGEST_AMPLITUDE = 0.25
"""A wall moves no farther than this [radii of the narrowest place]; an artery's some 0.1."""


@dataclass(frozen=True, eq=False)
class WallMotion:
    """How far and when the wall moves."""

    amplitude: float
    """From narrow to wide, far from openings [m]."""
    waveform: Waveform

    @cached_property
    def _range(self) -> tuple[float, float]:
        return float(self.waveform.factor.min()), float(self.waveform.factor.max())

    def displacement_factor(self, time: float) -> float:
        """0 narrow to 1 wide, at a time [s]."""
        low, high = self._range
        risen = min(1.0, max(0.0, time / RAMP_TIME))
        return risen * (self.waveform(time) - low) / (high - low)

    def rate(self, time: float) -> float:
        """Mean rate of the displacement factor over the last VELOCITY_WINDOW [1/s]."""
        before = self.displacement_factor(time - VELOCITY_WINDOW)
        return (self.displacement_factor(time) - before) / VELOCITY_WINDOW

    @property
    def peak_rate(self) -> float:
        """The highest rate, out or in [1/s]."""
        until = RAMP_TIME + float(self.waveform.time[-1])
        count = round(until / VELOCITY_WINDOW) + 2
        return max(abs(self.rate(VELOCITY_WINDOW * k)) for k in range(count))

    def amplitude_at(self, vessel: Vessel, points: Floats) -> Floats:
        """How far points (n, 3) [m] at a vessel's wall move [m], (n,).

        Nothing at an opening, open or capped; all of it a radius away.
        """
        amplitude = np.full(len(points), self.amplitude)
        for opening in (*vessel.openings, *vessel.unnamed):
            apart = points - opening.centre
            along = apart @ opening.normal
            aside = np.sqrt(np.maximum((apart**2).sum(axis=1) - along**2, 0.0))
            away = np.hypot(along, np.maximum(aside - opening.radius, 0.0)) / opening.radius
            near = np.clip(away, 0.0, 1.0)
            amplitude *= near * near * (3.0 - 2.0 * near)
        return amplitude


class MovingWall(Boundary):
    """The wall of a flow, moved as a `WallMotion` says."""

    name = "wall_motion"

    def __init__(self, blood: BloodFlow, motion: WallMotion):
        """The wall stands where its fields have it until the first step."""
        self.blood = blood
        self.motion = motion

    def before_drift(self, dt: float, model: AccelerationModel) -> float:
        """Put the wall where it is at the end of the step."""
        return self._move_to(self.blood.time + dt)

    def _move_to(self, time: float) -> float:
        """Put the wall where it is at a time [s]; returns how far it has moved [m]."""
        wall, before = self.blood.wall, self.blood.wall.displacement_factor
        factor, rate = self.motion.displacement_factor(time), self.motion.rate(time)
        move_wall(wall, self.blood.neighbors.proxies, factor, rate)
        return wall.largest_amplitude * abs(wall.displacement_factor - before)

    def reset(self) -> None:
        """Put the wall where it is at the flow's time."""
        self._move_to(self.blood.time)

    def save_state(self) -> dict[str, Any]:
        """Where the wall is and how fast it moves."""
        wall = self.blood.wall
        return {"displacement_factor": wall.displacement_factor, "rate": wall.rate}

    def load_state(self, saved: dict[str, Any]) -> None:
        """Put the wall back."""
        wall, proxies = self.blood.wall, self.blood.neighbors.proxies
        move_wall(wall, proxies, saved["displacement_factor"], saved["rate"])


def read_wall_motion(scene: Scene, vessel: Vessel) -> WallMotion | None:
    """The wall motion of a scene; None where its wall stands still.

    Raises:
        InputError: the waveform cannot be read or is steady, or the wall would move too far.
    """
    if scene.wall is None:
        return None
    waveform = read_waveform(scene.wall.waveform, Path(scene.folder))
    if np.ptp(waveform.factor) == 0.0:
        raise InputError(
            f"wall.waveform: {scene.wall.waveform!r} is the same at all times; allowed: one that "
            "rises and falls"
        )
    most = LARGEST_AMPLITUDE * 0.5 * vessel.narrowest
    if scene.wall.pulse > most:
        raise InputError(
            f"wall.pulse: {scene.wall.pulse:g} m is too far for the narrowest place of "
            f"{vessel.label} ({vessel.narrowest:.3g} m across); allowed: at most {most:.3g} m"
        )
    return WallMotion(scene.wall.pulse, waveform)
