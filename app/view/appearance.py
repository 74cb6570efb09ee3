"""How a picture of the blood looks: colours of speed, age and dye, and where the eye stands."""

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from taichi_sph.simulation import Simulation

Floats = NDArray[np.float64]

SPEED_COLOURS = (
    (0x6B, 0x0F, 0x1A),
    (0x8F, 0x12, 0x1B),
    (0xB5, 0x16, 0x19),
    (0xD6, 0x2B, 0x16),
    (0xEE, 0x55, 0x1B),
    (0xFA, 0x80, 0x2E),
    (0xFF, 0xAA, 0x4D),
    (0xFF, 0xD0, 0x7A),
    (0xFF, 0xF2, 0xC2),
)
"""Dark red at rest to pale yellow, (red, green, blue) at even steps; a test holds that the CIE
lightness rises evenly, so that equal differences of speed look equal."""

AGE_COLOURS = (
    (0x44, 0x01, 0x54),
    (0x47, 0x2D, 0x7B),
    (0x3B, 0x52, 0x8B),
    (0x2C, 0x72, 0x8E),
    (0x21, 0x91, 0x8C),
    (0x28, 0xAE, 0x80),
    (0x5E, 0xC9, 0x62),
    (0xAD, 0xDC, 0x30),
    (0xFD, 0xE7, 0x25),
)
"""Violet when it comes in to yellow: viridis, by Smith and van der Walt 2015 (CC0)."""

WALL_COLOUR = (0xE0, 0x98, 0x90, 0x2A)
TOOL_COLOUR = (0xC8, 0xD2, 0xDC, 0xFF)
DROP_COLOUR = (0x96, 0x14, 0x14)
DYE_COLOUR = (0x1E, 0xC8, 0xF0)
"""Cyan: no speed and no age has it."""
WOUND_COLOUR = (0xFF, 0xE0, 0x60, 0xFF)
"""Red, green, blue, opacity."""
BACKGROUND = (14, 16, 20)
FIELD_OF_VIEW = math.radians(55.0)
"""Rerun's vertical field of view."""
ASPECT = 1.1
"""Width over height that the vessel has to fit in: the 3-D part of an ordinary window."""
TILT = math.radians(12.0)
"""The eye looks down a little, which tells near from far."""


@dataclass(frozen=True)
class Colouring:
    """What the colour of blood means."""

    of: str
    """The quantity, one of COLOURINGS."""
    anchors: tuple[tuple[int, int, int], ...]
    """Colours from zero to full scale at even steps: red, green, blue."""
    full_scale: float
    """Value of the last colour, in SI units."""
    unit: str
    at_zero: str
    """What blood of the first colour is."""

    def colours(
        self, velocities: NDArray[np.floating], age: NDArray[np.floating],
        dye: NDArray[np.floating],
    ) -> NDArray[np.uint8]:  # fmt: skip
        """Red, green, blue of blood, (n, 3): of its speed or age, towards DYE_COLOUR as it is dyed.

        Args:
            velocities: [m/s], (n, 3).
            age: [s], (n,).
            dye: concentration, 0 to 1, (n,).
        """
        values = age if self.of == "age" else np.sqrt(np.einsum("ij,ij->i", velocities, velocities))
        colours = colour_table(self.anchors)[levels(values, self.full_scale)]
        if dye.any():
            part = np.clip(dye, 0.0, 1.0)[:, None]
            mixed = (1.0 - part) * colours + part * np.array(DYE_COLOUR, float)
            colours = np.rint(mixed).astype(np.uint8)
        return colours


COLOURINGS = ("speed", "age")
"""What blood may be coloured by."""


def colouring(of: str, simulation: "Simulation") -> Colouring:
    """The colouring of a simulation's blood by one of COLOURINGS."""
    if of == "age":
        return Colouring(of, AGE_COLOURS, _largest_age(simulation), "s", "new")
    # Free fall over the whole height, or what drives: little is faster, but a jet out of a wound.
    derived = simulation.derived
    fastest = derived.quiet_speed or derived.expected_speed or 1.0
    return Colouring(of, SPEED_COLOURS, fastest, "m/s", "at rest")


def _largest_age(simulation: "Simulation") -> float:
    """An age that little blood outlives [s]: twice V/Q of what is pumped in, or the duration."""
    duration = simulation.scene.duration
    flows = [o.flow * o.waveform.mean for o in simulation.inflow.openings if o.flow is not None]
    pumped = sum(flow for flow in flows if flow > 0.0)
    return min(duration, 2.0 * simulation.vessel.volume / pumped) if pumped else duration


@functools.cache
def colour_table(anchors: tuple[tuple[int, int, int], ...]) -> NDArray[np.uint8]:
    """Colours from zero to full scale: red, green, blue, shape (256, 3)."""
    points = np.array(anchors, float)
    at = np.linspace(0.0, 1.0, 256)
    even = np.linspace(0.0, 1.0, len(points))
    bands = [np.rint(np.interp(at, even, points[:, k])) for k in range(3)]
    return np.stack(bands, axis=1).astype(np.uint8)


def levels(values: NDArray[np.floating], full_scale: float) -> NDArray[np.uint8]:
    """Where in a table values (n,) are, (n,); `full_scale` is its end."""
    # Not finite, it is shown as the last.
    return np.fmin(values * (255.0 / full_scale), 255.0).astype(np.uint8)


def upward(gravity: tuple[float, float, float]) -> Floats:
    """Unit vector against gravity; +z without gravity."""
    g = np.asarray(gravity, float)
    size = float(np.linalg.norm(g))
    return -g / size if size > 0.0 else np.array([0.0, 0.0, 1.0])


def eye(vertices: Floats, up: Floats) -> tuple[Floats, Floats]:
    """Position of the eye and the point that it looks at [m], so that all vertices are in view.

    It looks across the vessel's broad side: along the horizontal in which the vessel is thinnest,
    from slightly above.
    """
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    around = vertices - middle
    # Any two horizontals, then the principal directions of the vessel's shadow on them.
    first = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    shadow = around @ np.column_stack([first, second])
    _, directions = np.linalg.eigh(np.cov(shadow.T))
    thin = directions[0, 0] * first + directions[1, 0] * second
    # The sign of an eigenvector is arbitrary: towards the positive side of its largest part.
    thin *= math.copysign(1.0, float(thin[np.abs(thin).argmax()]))
    back = math.cos(TILT) * thin + math.sin(TILT) * up
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    above = np.cross(back, right)
    x, y, z = around @ right, around @ above, around @ back
    # Off the bounding box's middle a long thin shape would sit beside the picture's.
    shift = 0.5 * (x.min() + x.max()) * right + 0.5 * (y.min() + y.max()) * above
    x, y = x - 0.5 * (x.min() + x.max()), y - 0.5 * (y.min() + y.max())
    slope = math.tan(0.5 * FIELD_OF_VIEW)
    distance = max(
        float((np.abs(y) / slope + z).max()), float((np.abs(x) / (slope * ASPECT) + z).max())
    )
    target = middle + shift
    return target + 1.1 * distance * back, target
