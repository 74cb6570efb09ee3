"""Pulse: the vessel's wall moves out along its normals and back, as an artery's does.

The motion is prescribed: blood feels it and does not act on it.  The level, 0 narrow to 1 wide, is
a waveform brought to that range; it rises from 0, the surface of the file, within `RAMP_TIME`.  The
wall is held at the vessel's openings.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from taichi_sph.boundary.inflow import RAMP_TIME
from taichi_sph.errors import InputError
from taichi_sph.geometry.mesh import Floats
from taichi_sph.geometry.vessel import Vessel
from taichi_sph.scene import Scene
from taichi_sph.waveform import Waveform, read_waveform

LAG = 1e-3
"""The wall's velocity is its mean over this time [s]: a waveform has kinks."""

LARGEST = 0.25
"""A wall moves no farther than this [radii of the narrowest place]; an artery's some 0.1."""


@dataclass(frozen=True, eq=False)
class WallMotion:
    """How far and when the wall moves."""

    swing: float
    """From narrow to wide, far from openings [m]."""
    waveform: Waveform

    @cached_property
    def _range(self) -> tuple[float, float]:
        return float(self.waveform.factor.min()), float(self.waveform.factor.max())

    def level(self, time: float) -> float:
        """0 narrow to 1 wide, at a time [s]."""
        low, high = self._range
        risen = min(1.0, max(0.0, time / RAMP_TIME))
        return risen * (self.waveform(time) - low) / (high - low)

    def rate(self, time: float) -> float:
        """Its rate over the last moment [1/s]."""
        return (self.level(time) - self.level(time - LAG)) / LAG

    @property
    def fastest(self) -> float:
        """The highest rate, out or in [1/s]."""
        until = RAMP_TIME + float(self.waveform.time[-1])
        return max(abs(self.rate(LAG * k)) for k in range(round(until / LAG) + 2))

    def reach(self, vessel: Vessel, points: Floats) -> Floats:
        """How far points (n, 3) [m] at a vessel's wall move [m], (n,).

        Nothing at an opening, open or capped; all of it a radius away.
        """
        reach = np.full(len(points), self.swing)
        for opening in (*vessel.openings, *vessel.unnamed):
            apart = points - opening.centre
            along = apart @ opening.normal
            aside = np.sqrt(np.maximum((apart**2).sum(axis=1) - along**2, 0.0))
            away = np.hypot(along, np.maximum(aside - opening.radius, 0.0)) / opening.radius
            share = np.clip(away, 0.0, 1.0)
            reach *= share * share * (3.0 - 2.0 * share)
        return reach


def read_wall_motion(scene: Scene, vessel: Vessel) -> WallMotion | None:
    """The pulse of a scene; None where its wall stands still.

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
    most = LARGEST * 0.5 * vessel.narrowest
    if scene.wall.pulse > most:
        raise InputError(
            f"wall.pulse: {scene.wall.pulse:g} m is too far for the narrowest place of "
            f"{vessel.label} ({vessel.narrowest:.3g} m across); allowed: at most {most:.3g} m"
        )
    return WallMotion(scene.wall.pulse, waveform)
