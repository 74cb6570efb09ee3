"""Wounds: holes in the vessel's wall that are opened and closed while blood flows."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from taichi_sph.boundary.boundary import BloodFlow, Boundary, finite_numbers
from taichi_sph.boundary.outlets import Outlets
from taichi_sph.errors import InputError
from taichi_sph.geometry.mesh import Booleans, Floats, plane_axes
from taichi_sph.geometry.vessel import Vessel
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Proxies, refreshed_volumes

MOST_WOUNDS = 16
"""Wounds of a session, closed ones too: each keeps its account."""

LEAST_RADIUS = 1.5
"""No particle passes a smaller hole [spacings]."""

OUTSIDE = 1.0
"""Blood has left by a wound when it is this far beyond the wall [spacings]."""

SEATED_DISTANCE = 0.6
"""Where a wound is closed, blood nearer to the wall than this has left [spacings]: at rest it keeps
half a spacing, and what a proxy comes down upon is thrown out."""

RIM_CLEARANCE = 3.0
"""Blood has left by a wound no farther from its rim than this [spacings]: that is the jet."""


@dataclass
class Wound:
    """A hole in the wall: a puncture, or a cut from begin to end."""

    begin: Floats
    """On the lumen's surface [m], (3,)."""
    end: Floats
    """The same for a puncture."""
    normal: Floats
    """Unit normal out of the lumen."""
    radius: float
    """Of the puncture, half the width of the cut [m]."""
    lift: float = 0.0
    """Blood has left by it when it is so far beyond its plane [m] ..."""
    reach: float = 0.0
    """... and no farther from its line than this [m]."""
    is_open: bool = True

    def distance(self, points: Floats) -> Floats:
        """Distance of points (n, 3) to the line from begin to end [m], (n,)."""
        line = self.end - self.begin
        apart = points - self.begin
        share = np.clip(apart @ line / max(float(line @ line), 1e-20), 0.0, 1.0)
        return np.asarray(np.linalg.norm(apart - share[:, None] * line, axis=1))

    def rim(self) -> Floats:
        """Closed line round the hole, on its plane [m], (n, 3)."""
        turn = np.linspace(0.0, 2.0 * np.pi, 33)
        line = self.end - self.begin
        length = float(np.linalg.norm(line))
        first = line / length if length else plane_axes(self.normal)[0]
        second = np.cross(self.normal, first)
        centre = np.where((np.cos(turn) > 0.0)[:, None], self.end, self.begin)
        return np.asarray(
            centre + self.radius * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
        )

    @property
    def area(self) -> float:
        """Of the hole [m^2]."""
        length = float(np.linalg.norm(self.end - self.begin))
        return float(np.pi) * self.radius**2 + 2.0 * self.radius * length


class Wounds(Boundary):
    """The wounds of one simulation, in the order in which they were opened."""

    name = "wounds"

    def __init__(
        self, blood: BloodFlow, vessel: Vessel, outlets: Outlets, first_outlet: int,
        kernel: WendlandC2, spacing: float,
    ):  # fmt: skip
        """None at first.

        Args:
            blood: flows in the vessel.
            vessel: whose wall it is.
            outlets: blood leaves by them.
            first_outlet: it and the MOST_WOUNDS - 1 after it are the wounds'.
            kernel: of the blood.
            spacing: of the blood [m].
        """
        self.blood = blood
        self.vessel = vessel
        self.outlets = outlets
        self.first_outlet = first_outlet
        self.kernel = kernel
        self.spacing = spacing
        self._wounds: list[Wound] = []
        self._intact = blood.wall.given

    def __len__(self) -> int:
        """Number of wounds, closed ones too."""
        return len(self._wounds)

    def __iter__(self) -> Iterator[Wound]:
        """All wounds, closed ones too."""
        return iter(self._wounds)

    def open(self, centre: Floats, radius: float, end: Floats | None = None) -> Wound:
        """Open the wall.

        Args:
            centre: near the wall [m], (3,); the nearest place on it is taken.
            radius: of the puncture, or half the width of a cut [m].
            end: the other end of a cut, likewise [m].

        Raises:
            InputError: not at the wall, too small to bleed, one wound too many, or no number.
        """
        finite_numbers("wound: radius [m]", radius)
        for name, point in (("centre", centre), ("end", centre if end is None else end)):
            finite_numbers(f"wound: {name} [m]", point, (3,))
        if len(self._wounds) >= MOST_WOUNDS:
            raise InputError(f"wound: a session has at most {MOST_WOUNDS}")
        least = LEAST_RADIUS * self.spacing
        low, high = self.vessel.bounds
        most = 0.5 * float((high - low).min())
        if radius > most:
            raise InputError(f"wound: a radius of {radius:.3g} m is no wound; at most {most:.3g} m")
        if radius < least:
            raise InputError(
                f"wound: a radius of {radius:.3g} m is less than {LEAST_RADIUS:g} spacings of the "
                f"blood, so that none would pass; allowed: {least:.3g} m or more"
            )
        ends = np.array([centre, centre if end is None else end], float)
        away, triangle, places, normals = self.vessel.nearest_wall(ends)
        if away.max() > radius + 2.0 * self.spacing:
            raise InputError(
                f"wound: the wall is {away.max():.3g} m away; allowed: a point no farther from it "
                f"than {radius + 2.0 * self.spacing:.3g} m"
            )
        caps = {self.vessel.openings[k].name for k in self.vessel.face_opening[triangle] if k >= 0}
        if caps:
            raise InputError(f"wound: that is opening {caps.pop()!r}, not the wall")
        line = places[1] - places[0]
        normal = normals.sum(axis=0)
        normal -= line * float(normal @ line) / max(float(line @ line), 1e-20)
        wound = Wound(places[0], places[1], normal / np.linalg.norm(normal), radius)
        self._choose_outflow_plane(wound)
        self._wounds.append(wound)
        self._open_outlet(len(self._wounds) - 1)
        self._make_wall()
        return wound

    def _choose_outflow_plane(self, wound: Wound) -> None:
        """Choose where blood has left by a wound: outside, and nowhere that the lumen is too.

        Raises:
            InputError: branches lie too close to each other there.
        """
        d = self.spacing
        first, second = plane_axes(wound.normal)
        line = wound.end - wound.begin
        widest = wound.radius + RIM_CLEARANCE * d
        # Where the wall moves, outside is beyond its widest.
        outside = self.blood.wall.largest_amplitude + OUTSIDE * d
        for lift in (outside, outside + 0.5 * d, outside + d):
            across = np.arange(-widest, widest + 0.5 * d, 0.5 * d)
            up = np.arange(lift, widest, 0.5 * d)
            a, b, c = (x.ravel() for x in np.meshgrid(across, across, up, indexing="ij"))
            apart = a[:, None] * first + b[:, None] * second + c[:, None] * wound.normal
            places = (wound.begin + apart, wound.begin + 0.5 * line + apart, wound.end + apart)
            points = np.concatenate(places if line.any() else places[:1])
            away = wound.distance(points - lift * wound.normal)
            inside = away[self.vessel.contains(points)]
            reach = min(widest, float(inside.min(initial=np.inf)) - 0.5 * d)
            if reach >= wound.radius:
                wound.lift, wound.reach = lift, reach
                return
        raise InputError(
            "wound: another part of the lumen lies right outside the wall there, so that blood "
            "would not get out; choose another place"
        )

    def _open_outlet(self, number: int) -> None:
        """Let blood leave by a wound."""
        wound = self._wounds[number]
        lift = wound.lift * wound.normal
        self.outlets.open(
            self.first_outlet + number, wound.begin + lift, wound.end + lift, wound.normal,
            wound.reach, track_droplets=True,
        )  # fmt: skip

    def close(self, number: int | None = None) -> None:
        """Close a wound, or all; blood that is in the hole has left by it.

        Raises:
            InputError: there is no such wound.
        """
        count = len(self._wounds)
        if number is not None and not 0 <= number < count:
            has = f"0 to {count - 1}" if count else "none yet"
            raise InputError(f"clamp: there is no wound {number}; there are {has}")
        for k in range(count) if number is None else [number]:
            if self._wounds[k].is_open:
                self._close(self._wounds[k], self.first_outlet + k)
        # Also where all were closed before: a replay of the command then sums in the same order.
        self.blood.neighbors.stale = True

    def _close(self, wound: Wound, k: int) -> None:
        """Close an open wound, which is outlet k."""
        particles, wall = self.blood.particles, self.blood.wall
        self.outlets.mark_outflow()
        self.outlets.close(k)
        intact = self._intact
        comes_back = self._hole(wound)
        wound.is_open = False
        for other in self._wounds:
            if other.is_open:
                comes_back &= ~self._hole(other)
        if comes_back.any():
            live = particles.position.to_numpy()[: particles.count[None]].astype(float)
            feet = intact.at(wall.displacement_factor) - wall.setback * intact.normal
            away, nearest = cKDTree(feet).query(live)
            height = ((live - feet[nearest]) * intact.normal[nearest]).sum(axis=1)
            # Blood before wall that stayed is seated as it is.
            under = comes_back[nearest] & (height > -SEATED_DISTANCE * self.spacing)
            self.outlets.remove_rows(under & (away < RIM_CLEARANCE * self.spacing), k)
        self._make_wall()

    def _hole(self, wound: Wound) -> Booleans:
        """Which proxies of the whole wall a wound takes away, (m,)."""
        wall, position, normal = self.blood.wall, self._intact.position, self._intact.normal
        away = wound.distance(position - wall.setback * normal)
        # Each proxy is the wall for half a spacing round it; across a thin vessel they stay.
        hole = away < wound.radius + 0.5 * wall.spacing
        return np.asarray(hole & (normal @ wound.normal > 0.0))

    def _make_wall(self) -> None:
        """The wall without the proxies of open wounds (paper, Eq. 3: the rim's volumes anew)."""
        whole, wall = self._intact, self.blood.wall
        position, amplitude = whole.position, wall.largest_amplitude
        if len(position) == 0:
            return
        gone = np.zeros(len(position), bool)
        for wound in self._wounds:
            if wound.is_open:
                gone |= self._hole(wound)
        near = np.zeros(len(position), bool)
        if gone.any():
            reach = self.kernel.support_radius + 2.0 * amplitude
            near = cKDTree(position[gone]).query(position)[0] < reach
        left = Proxies(*(rows[~gone] for rows in whole))
        near = near[~gone]
        volume = wide_volume = refreshed_volumes(left.position, left.volume, self.kernel, near)
        if amplitude:
            wide_volume = refreshed_volumes(left.at(1.0), left.wide_volume, self.kernel, near)
        wall.given = left._replace(volume=volume, wide_volume=wide_volume)
        self.blood.neighbors.sort_wall(wall)

    def reset(self) -> None:
        """No wound has ever been."""
        had = len(self._wounds)
        self._wounds = []
        for number in range(had):
            self.outlets.close(self.first_outlet + number)
        if had:
            self._make_wall()

    def save_state(self) -> dict[str, Any]:
        """A row of numbers for each wound."""
        return {
            "wounds": [
                [*map(float, (*w.begin, *w.end, *w.normal, w.radius, w.lift, w.reach)), w.is_open]
                for w in self._wounds
            ]
        }

    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self._wounds = [
            Wound(
                np.array(row[0:3]), np.array(row[3:6]), np.array(row[6:9]), radius=row[9],
                lift=row[10], reach=row[11], is_open=bool(row[12]),
            )
            for row in saved["wounds"]
        ]  # fmt: skip
        for number in range(MOST_WOUNDS):
            self.outlets.close(self.first_outlet + number)
        for number, wound in enumerate(self._wounds):
            if wound.is_open:
                self._open_outlet(number)
        self._make_wall()
