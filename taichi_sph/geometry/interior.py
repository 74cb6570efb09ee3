"""Interior: boxes that lie wholly within a closed surface, found as points come into them.

Whether a point is inside takes a surface's whole tree of triangles; most blood is far from the wall
and stays in boxes that were asked about before.
"""

import math
from collections.abc import Callable

import numpy as np

from taichi_sph.geometry.mesh import Booleans, Floats

MOST_BOXES = 20_000_000
"""Of the whole lattice, a byte each: a thin vessel fills little of its bounds."""
BOXES = 30_000
"""That fill the lumen: smaller ones hold more of the blood, and more have to be asked about."""


class Interior:
    """What is known of each box of a lattice over a surface's bounds."""

    def __init__(
        self,
        low: Floats,
        high: Floats,
        volume: float,
        signed_distance: Callable[[Floats], Floats],
    ):
        """Nothing is known yet.

        Args:
            low: lowest corner of the bounds [m], (3,).
            high: highest [m], (3,).
            volume: of the lumen [m^3].
            signed_distance: of points (k, 3) to the surface [m], negative inside, (k,).
        """
        self._low, self._signed_distance = low, signed_distance
        bounds = float(np.prod(high - low))
        self.size = max(volume / BOXES, bounds / MOST_BOXES) ** (1.0 / 3.0)
        """Edge of a box [m]."""
        self._shape = np.ceil((high - low) / self.size).astype(int)
        self._known = np.zeros(self._shape.prod(), np.int8)

    def holds(self, points: Floats) -> Booleans:
        """Which points (k, 3) [m] lie in a box that is wholly inside; others may be anywhere."""
        place = np.floor((points - self._low) / self.size)
        within = ((place >= 0.0) & (place < self._shape)).all(axis=1)
        box = np.ravel_multi_index(tuple(place[within].astype(int).T), tuple(self._shape))
        new = np.unique(box[self._known[box] == 0])
        if len(new):
            middle = np.stack(np.unravel_index(new, tuple(self._shape)), axis=1) + 0.5
            depth = -self._signed_distance(self._low + middle * self.size)
            self._known[new] = np.where(depth > 0.5001 * math.sqrt(3.0) * self.size, 1, -1)
        within[within] = self._known[box] == 1
        return np.asarray(within)
