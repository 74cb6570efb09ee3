"""How a picture of the blood looks: colours of speed and where the eye stands."""

import math

import numpy as np
from numpy.typing import NDArray

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

WALL_COLOUR = (0xE0, 0x98, 0x90, 0x2A)
TOOL_COLOUR = (0xC8, 0xD2, 0xDC, 0xFF)
DROP_COLOUR = (0x96, 0x14, 0x14)
DYE_COLOUR = (0x1E, 0xC8, 0xF0)
"""Cyan: no speed has it."""
WOUND_COLOUR = (0xFF, 0xE0, 0x60, 0xFF)
"""Red, green, blue, opacity."""
BACKGROUND = (14, 16, 20)
FIELD_OF_VIEW = math.radians(55.0)
"""Rerun's vertical field of view."""
ASPECT = 1.1
"""Width over height that the vessel has to fit in: the 3-D part of an ordinary window."""
TILT = math.radians(12.0)
"""The eye looks down a little, which tells near from far."""


def _colour_table() -> NDArray[np.uint8]:
    """Colours of speed from rest to full scale: red, green, blue, shape (256, 3)."""
    anchors = np.array(SPEED_COLOURS, float)
    at = np.linspace(0.0, 1.0, 256)
    even = np.linspace(0.0, 1.0, len(anchors))
    bands = [np.rint(np.interp(at, even, anchors[:, k])) for k in range(3)]
    return np.stack(bands, axis=1).astype(np.uint8)


COLOURS = _colour_table()
PACKED_COLOURS = np.array([int.from_bytes([*colour, 0xFF], "big") for colour in COLOURS], np.uint32)
"""The same as 0xRRGGBBAA, (256,)."""


def speed_levels(velocities: NDArray[np.floating], full_scale: float) -> NDArray[np.uint8]:
    """Where in the table the speeds of velocities (n, 3) are; `full_scale` [m/s] is its end."""
    speed = np.sqrt(np.einsum("ij,ij->i", velocities, velocities))
    last = len(COLOURS) - 1
    # Not finite, it is shown as the fastest.
    return np.fmin(speed * (last / full_scale), last).astype(np.uint8)


def blood_colours(
    velocities: NDArray[np.floating], full_scale: float, dye: NDArray[np.floating]
) -> NDArray[np.uint8]:
    """Red, green, blue of blood, (n, 3): of its speed, and towards DYE_COLOUR as it is dyed.

    Args:
        velocities: [m/s], (n, 3).
        full_scale: speed of the brightest colour [m/s].
        dye: concentration, 0 to 1, (n,).
    """
    colours = COLOURS[speed_levels(velocities, full_scale)]
    if dye.any():
        part = np.clip(dye, 0.0, 1.0)[:, None]
        mixed = (1.0 - part) * colours + part * np.array(DYE_COLOUR, float)
        colours = np.rint(mixed).astype(np.uint8)
    return colours


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
