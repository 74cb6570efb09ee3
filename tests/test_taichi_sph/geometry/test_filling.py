"""Blood at the start, in a lumen that is given by its equations."""

from dataclasses import dataclass

import numpy as np
import pytest

from taichi_sph.geometry.filling import column_room, fill_column
from taichi_sph.geometry.openings import Opening
from taichi_sph.scene import Column

HALF, DEPTH, FOOT = 5.0, 10.0, 2.0
"""A box [spacings], |x| and |y| up to HALF, z down to -DEPTH; FOOT of it below a wall at x = 0."""


@dataclass
class Hairpin:
    """Two square legs with a wall of some thickness between them, joined at their foot."""

    thickness: float
    """Of the wall between the legs [spacings]."""

    @property
    def bounds(self):
        return np.array([-HALF, -HALF, -DEPTH]), np.array([HALF, HALF, 0.0])

    @property
    def vertices(self):
        low, high = self.bounds
        return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T

    @property
    def volume(self):
        return 4.0 * HALF**2 * DEPTH

    def _beyond_wall(self, points):
        """Distance to the wall between the legs; negative within it."""
        x, _, z = points.T
        aside, below = np.abs(x) - 0.5 * self.thickness, (FOOT - DEPTH) - z
        outside = np.hypot(np.maximum(aside, 0.0), np.maximum(below, 0.0))
        return np.where((aside < 0.0) & (below < 0.0), np.maximum(aside, below), outside)

    def contains(self, points):
        low, high = self.bounds
        return ((points > low) & (points < high)).all(axis=1) & (self._beyond_wall(points) > 0.0)

    def distance(self, points):
        low, high = self.bounds
        to_box = np.abs(np.concatenate([points - low, high - points], axis=1)).min(axis=1)
        return np.minimum(to_box, np.abs(self._beyond_wall(points)))


def leg(thickness: float) -> tuple[Opening, np.ndarray, float]:
    """The opening of the left leg, its rim and its area."""
    edge = -0.5 * thickness
    rim = np.array([[-HALF, -HALF, 0.0], [edge, -HALF, 0.0], [edge, HALF, 0.0], [-HALF, HALF, 0.0]])
    area = (HALF + edge) * 2.0 * HALF
    centre = np.array([0.5 * (edge - HALF), 0.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return Opening("leg", centre, up, np.sqrt(area / np.pi), area, True), rim, area


@pytest.mark.parametrize("thickness", [1e-3, 0.1, 1.0])
def test_a_column_stays_in_its_leg_however_thin_the_wall_beside_it_is(thickness: float) -> None:
    opening, rim, _ = leg(thickness)
    edge = -0.5 * thickness
    blood = fill_column(Hairpin(thickness), opening, rim, Column(opening="leg", height=5.0), 1.0)
    assert (blood[:, 0] < edge).all()
    # 5 layers of 10 by 5 places, or by 4 where the wall takes one.
    assert len(blood) == 5 * 10 * (5 if thickness < 0.01 else 4)
    whole = fill_column(Hairpin(thickness), opening, rim, Column(opening="leg", full=True), 1.0)
    assert (whole[:, 0] > -edge).any(), "round the foot it goes"


@pytest.mark.parametrize("thickness", [0.1, 1.0])
@pytest.mark.parametrize("height", [3.7, 5.0])
def test_a_columns_room_reaches_to_the_wall_and_down_to_its_height(
    thickness: float, height: float
) -> None:
    opening, rim, area = leg(thickness)
    room = column_room(Hairpin(thickness), opening, rim, Column(opening="leg", height=height), 1.0)
    assert room.height == height
    # Where a cube holds an edge, its distance tells the part within to some tenths.
    assert room.volume == pytest.approx(area * height, rel=0.02)


def test_as_many_particles_as_there_are_take_as_many_spacings_cubed() -> None:
    opening, rim, area = leg(1.0)
    lumen, spacing = Hairpin(1.0), 0.2
    wanted = round(0.5 * area * (DEPTH - FOOT) / spacing**3)
    room = column_room(lumen, opening, rim, Column(opening="leg", particles=wanted), spacing)
    assert room.volume == pytest.approx(wanted * spacing**3, rel=1e-12)
    assert room.height == pytest.approx(0.5 * (DEPTH - FOOT), rel=0.01)


def test_more_particles_than_fit_have_the_room_that_there_is() -> None:
    opening, rim, _ = leg(1.0)
    lumen = Hairpin(1.0)
    room = column_room(lumen, opening, rim, Column(opening="leg", particles=10_000), 1.0)
    # Both legs and what joins them, less the wall between the legs.
    assert room.volume == pytest.approx(lumen.volume - 2.0 * HALF * (DEPTH - FOOT), rel=0.05)
