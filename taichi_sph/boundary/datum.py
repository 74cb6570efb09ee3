"""Datum: what pressure is measured from in a vessel that is full and closed, and how fast sound is.

In a stiff vessel only differences of pressure move blood.  Where blood fills the lumen and every
opening that is not capped is driven, one of them at least by a pressure, it feels

    p' = p - D(x),   D(x) = D_0 + rho_0 g.x,   g' = 0

with D_0 such that the reservoir whose pressure is least, at rest, gives p' = m rho_0 U^2: a level
of pressure, and gravity, then compress nothing.  Each reservoir drives with its p_0 - D(x).
U is the scale of the speeds that there are now, the largest of

    the largest speed of blood,   sqrt(2 (max p' - min p')/rho_0) of the reservoirs,   U_q

and the sound speed is c = `sound_speed_ratio` U, so that blood is compressed by a per cent at most
and steps are as long as its flow allows.  U_q is what the drive gives at its peak while nothing is
wounded.

A wound feels the whole pressure: once one is open, D and the balance of gravity are taken back
within CHANGE_TIME, while c rises to what a jet out of the whole pressure asks for; and back when it
is closed.  In other scenes, also where the wall pulses and blood follows it by the
whole pressure, there is no datum and c is constant.

| symbol | here | meaning | unit |
|---|---|---|---|
| D_0, rho_0 g | Datum.value, Datum.gradient | at the origin, gradient | Pa, Pa/m |
| m | LEAST_PRESSURE | lowest p'/(rho_0 U^2): blood whose p' falls to 0 tears | 1 |
| U_q | quiet_speed | see `taichi_sph.derived` | m/s |
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from taichi_sph.boundary.boundary import BloodFlow, Boundary, Datum
from taichi_sph.boundary.inflow import DrivenOpening
from taichi_sph.boundary.wounds import Wound
from taichi_sph.fluid.local_datum import LOCAL_SHARE
from taichi_sph.fluid.model import AccelerationModel

LEAST_PRESSURE = 0.1
"""m: with 0.1, 0.2 and 0.3 the blood of `aorta_surgery` is compressed by at most 2.8, 3.9 and
5.0 %, and a level that blood has to be compressed to drives it in at the start.  (Behind a throat
pressure is some 0.15 rho U^2 below the outlet's, as measured in the FDA's nozzle: some tears.)"""
CHANGE_TIME = 0.01
"""Time in which D is taken back, or comes back [s]: sound crosses a vessel of 0.1 m meanwhile."""
RISE_TIME, FALL_TIME = 0.005, 0.05
"""Times in which c may rise or fall by a factor e [s]: a fast rise keeps up with a jet; a fall, or
a rise that a flow asks for, changes c by less than a per cent in the time that sound takes to cross
a support radius, and so makes no sound itself."""


class PressureDatum(Boundary):
    """The datum and the sound speed of a simulation; both are constant unless it is closed."""

    name = "datum"

    def __init__(
        self, blood: BloodFlow, driven: list[DrivenOpening], wounds: Iterable[Wound],
        density: float, sound_speed: float, ratio: float, quiet_speed: float | None,
    ):  # fmt: skip
        """Put them where they are at the start.

        Args:
            blood: that feels them.
            driven: the openings that drive it.
            wounds: while one is open, there is no datum.
            density: rho_0 [kg/m^3].
            sound_speed: c without a datum [m/s].
            ratio: the scene's `sound_speed_ratio`.
            quiet_speed: U_q [m/s]; None where the scene is not closed.
        """
        self.blood = blood
        self.driven = driven
        self.wounds = wounds
        self.density = density
        self.sound_speed = sound_speed
        self.ratio = ratio
        self.quiet_speed = quiet_speed
        self.reset()

    def before_drift(self, dt: float, model: AccelerationModel) -> float:
        """Follow the drive, the wounds and the blood; no proxy moves."""
        if self.quiet_speed is not None:
            most = dt / CHANGE_TIME
            share = self.blood.datum.share
            wanted = 0.0 if any(wound.is_open for wound in self.wounds) else 1.0
            heads = self._heads(dt)
            self._put(share + min(most, max(-most, wanted - share)), heads)
            self._follow(dt, heads, self.quiet_speed)
        return 0.0

    def _heads(self, dt: float) -> list[float]:
        """p_0 - rho_0 g.x of each reservoir a step of dt [s] from now [Pa]."""
        time, gradient = self.blood.time + dt, self._gradient
        return [
            opening.pressure_at(time, dt) - float(gradient @ opening.opening.centre)
            for opening in self.driven
            if opening.pressure is not None
        ]

    @property
    def _gradient(self) -> np.ndarray:
        """rho_0 g [Pa/m]."""
        return self.density * np.asarray(self.blood.gravity)

    def _put(self, share: float, heads: list[float]) -> None:
        """Put such a share of the datum there, of the reservoirs' heads [Pa]."""
        scale = self.blood.sound_speed / self.ratio
        lowest = min(heads) - LEAST_PRESSURE * self.density * scale**2
        x, y, z = (float(share * a) for a in self._gradient)
        self.blood.datum = Datum(share * lowest, (x, y, z), share)
        self.blood.local_share = share * LOCAL_SHARE

    def _follow(self, dt: float, heads: list[float], quiet_speed: float) -> None:
        """Let the sound speed follow the flow for a step of dt [s]."""
        wanted = self.sound_speed
        if self.blood.datum.share == 1.0:
            speed = max(
                self.blood.largest_speed,
                math.sqrt(2.0 * (max(heads) - min(heads)) / self.density),
                quiet_speed,
            )
            wanted = min(wanted, self.ratio * speed)
        change = math.log(wanted / self.blood.sound_speed)
        self.blood.sound_speed *= math.exp(min(dt / RISE_TIME, max(-dt / FALL_TIME, change)))

    def reset(self) -> None:
        """As for blood at rest in the whole vessel."""
        self.blood.sound_speed = self.sound_speed
        self.blood.datum = Datum()
        if self.quiet_speed is not None:
            self.blood.sound_speed = self.ratio * self.quiet_speed
            self._put(1.0, self._heads(0.0))

    def save_state(self) -> dict[str, Any]:
        """The datum and the sound speed."""
        datum = self.blood.datum
        return {
            "value": datum.value, "gradient": list(datum.gradient), "share": datum.share,
            "sound_speed": self.blood.sound_speed,
        }  # fmt: skip

    def load_state(self, saved: dict[str, Any]) -> None:
        """Put both back."""
        x, y, z = saved["gradient"]
        self.blood.datum = Datum(saved["value"], (x, y, z), saved["share"])
        self.blood.local_share = saved["share"] * LOCAL_SHARE
        self.blood.sound_speed = saved["sound_speed"]
