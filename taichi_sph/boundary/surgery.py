"""Surgery: what is done to the vessel while blood flows: wounds, clamps, a tool, suction."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from taichi_sph.boundary.outlets import Outlets, suck
from taichi_sph.boundary.tool import Tool
from taichi_sph.errors import InputError
from taichi_sph.geometry.mesh import Booleans, Floats, plane_axes
from taichi_sph.geometry.vessel import Vessel
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Proxies, Wall, refreshed_volumes

MOST_WOUNDS = 16
"""Wounds of a session, closed ones too: each keeps its account."""

LEAST_RADIUS = 1.5
"""No particle passes a smaller hole [spacings]."""

OUTSIDE = 1.0
"""Blood has left by a wound when it is this far beyond the wall [spacings]."""

SEATED = 0.6
"""Where a wound is closed, blood nearer to the wall than this has left [spacings]: at rest it keeps
half a spacing, and what a proxy comes down upon is thrown out."""

ASIDE = 3.0
"""And no farther from the wound's rim than this [spacings]: nearer blood is of the jet."""


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


class Surgery:
    """Wounds, tool and suction of one simulation."""

    def __init__(
        self, vessel: Vessel, wall: Wall, neighbors: Neighbors, exits: Outlets, first_exit: int,
        kernel: WendlandC2, spacing: float, tool: Tool,
    ):  # fmt: skip
        """`first_exit` and the MOST_WOUNDS - 1 after it are the wounds'; `spacing` [m] of blood."""
        self.vessel = vessel
        self.wall = wall
        self.neighbors = neighbors
        self.exits = exits
        self.first_exit = first_exit
        self.kernel = kernel
        self.spacing = spacing
        self.tool = tool
        self.wounds: list[Wound] = []
        self.suction_rate = 0.0
        """[m^3/s]"""
        self.suction_radius = 2.0 * spacing
        """[m]"""
        self._owed = 0.0
        self._sucked_until = 0.0
        self._intact = wall.given
        tool.place(wall, neighbors)

    def wound(self, centre: Floats, radius: float, end: Floats | None = None) -> Wound:
        """Open the wall.

        Args:
            centre: near the wall [m], (3,); the nearest place on it is taken.
            radius: of the puncture, or half the width of a cut [m].
            end: the other end of a cut, likewise [m].

        Raises:
            InputError: not at the wall, too small to bleed, or one wound too many.
        """
        if len(self.wounds) >= MOST_WOUNDS:
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
        self._fit(wound)
        self.wounds.append(wound)
        self._cut(len(self.wounds) - 1)
        return wound

    def _fit(self, wound: Wound) -> None:
        """Choose where blood has left by a wound: outside, and nowhere that the lumen is too.

        Raises:
            InputError: branches lie too close to each other there.
        """
        d = self.spacing
        first, second = plane_axes(wound.normal)
        line = wound.end - wound.begin
        widest = wound.radius + ASIDE * d
        # Where the wall pulses, outside is beyond its widest.
        outside = self.wall.most_swing + OUTSIDE * d
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

    def _cut(self, number: int) -> None:
        """Let blood leave by a wound, and make the wall anew."""
        wound = self.wounds[number]
        lift = wound.lift * wound.normal
        self.exits.open(
            self.first_exit + number, wound.begin + lift, wound.end + lift, wound.normal,
            wound.reach, track_droplets=True,
        )  # fmt: skip
        self._make_wall()

    def clamp(self, number: int, particles: Particles, time: float) -> None:
        """Close a wound; blood that is in the hole at this time [s] has left by it.

        Raises:
            InputError: there is no such wound.
        """
        if not 0 <= number < len(self.wounds):
            has = f"0 to {len(self.wounds) - 1}" if self.wounds else "none yet"
            raise InputError(f"clamp: there is no wound {number}; there are {has}")
        wound, k = self.wounds[number], self.first_exit + number
        if not wound.is_open:
            return
        self.exits.mark(particles, self.neighbors.grid, time)
        self.exits.shut(k)
        intact = self._intact
        comes_back = self._hole(wound)
        wound.is_open = False
        for other in self.wounds:
            if other.is_open:
                comes_back &= ~self._hole(other)
        if comes_back.any():
            live = particles.position.to_numpy()[: particles.count[None]].astype(float)
            feet = intact.at(self.wall.level) - self.wall.setback * intact.normal
            away, nearest = cKDTree(feet).query(live)
            height = ((live - feet[nearest]) * intact.normal[nearest]).sum(axis=1)
            # Blood before wall that stayed is seated as it is.
            under = comes_back[nearest] & (height > -SEATED * self.spacing)
            self.exits.take(particles, under & (away < ASIDE * self.spacing), k)
        self._make_wall()

    def _hole(self, wound: Wound) -> Booleans:
        """Which proxies of the whole wall a wound takes away, (m,)."""
        position, normal = self._intact.position, self._intact.normal
        away = wound.distance(position - self.wall.setback * normal)
        # Each proxy is the wall for half a spacing round it; across a thin vessel they stay.
        hole = away < wound.radius + 0.5 * self.wall.spacing
        return np.asarray(hole & (normal @ wound.normal > 0.0))

    def _make_wall(self) -> None:
        """The wall without the proxies of open wounds (paper, Eq. 3: the rim's volumes anew)."""
        whole = self._intact
        position, swing = whole.position, self.wall.most_swing
        if len(position) == 0:
            return
        gone = np.zeros(len(position), bool)
        for wound in self.wounds:
            if wound.is_open:
                gone |= self._hole(wound)
        near = np.zeros(len(position), bool)
        if gone.any():
            reach = self.kernel.support_radius + 2.0 * swing
            near = cKDTree(position[gone]).query(position)[0] < reach
        left = Proxies(*(rows[~gone] for rows in whole))
        near = near[~gone]
        volume = wide_volume = refreshed_volumes(left.position, left.volume, self.kernel, near)
        if swing:
            wide_volume = refreshed_volumes(left.at(1.0), left.wide_volume, self.kernel, near)
        self.wall.given = left._replace(volume=volume, wide_volume=wide_volume)
        self.neighbors.sort_wall(self.wall)

    def compile_kernels(self, particles: Particles) -> None:
        """Have the kernel of the suction compiled."""
        suck(particles, self.exits, 0.0, 0.0, 0.0, 0.0, 0)

    def before_build(self, particles: Particles, time: float) -> None:
        """Mark the blood that suction takes until a time [s]."""
        if self.suction_rate > 0.0:
            self._owed += self.suction_rate * (time - self._sucked_until) / self.spacing**3
            taken = 0
            if self._owed >= 1.0:
                tip = map(float, self.tool.position)
                taken = suck(particles, self.exits, *tip, self.suction_radius, int(self._owed))
            # What is not there to be taken is not owed.
            self._owed = min(self._owed - taken, 1.0)
        self._sucked_until = time

    def before_drift(self, dt: float) -> float:
        """Move the tool by a step of dt [s]; returns how far the lists have to reach for it [m]."""
        if self.tool.settled:
            return 0.0
        if self.tool.shape is None:
            way = self.tool.jump()
            # Suction takes blood when the lists are built.
            return way if self.suction_rate > 0.0 else 0.0
        moved = not self.tool.at_rest
        self.tool.aim()
        if self.tool.at_rest and not moved:
            return 0.0
        way = self.tool.move(dt)
        self.tool.place(self.wall, self.neighbors)
        return way

    def start_again(self, time: float) -> None:
        """As at the start, at a time [s]."""
        tool, had = self.tool, len(self.wounds)
        self.wounds = []
        self.exits.drop_count[None] = 0
        for number in range(had):
            self.exits.shut(self.first_exit + number)
        if had:
            self._make_wall()
        self.suction_rate, self._owed, self._sucked_until = 0.0, 0.0, time
        tool.start_again()
        tool.place(self.wall, self.neighbors)

    def state(self) -> dict[str, Any]:
        """All of it as numbers, lists and names."""
        tool = self.tool
        return {
            "wounds": [
                [*map(float, (*w.begin, *w.end, *w.normal, w.radius, w.lift, w.reach)), w.is_open]
                for w in self.wounds
            ],
            "suction": [self.suction_rate, self.suction_radius, self._owed, self._sucked_until],
            "tool": [
                [float(x) for x in value]
                for value in (
                    tool.position, tool.rotation.as_quat(), tool.wanted_position,
                    tool.wanted_rotation.as_quat(), tool.velocity, tool.spin,
                )
            ],
        }  # fmt: skip

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        self.wounds = [
            Wound(
                np.array(row[0:3]),
                np.array(row[3:6]),
                np.array(row[6:9]),
                radius=row[9],
                lift=row[10],
                reach=row[11],
                is_open=bool(row[12]),
            )
            for row in state["wounds"]
        ]
        for number in range(MOST_WOUNDS):
            self.exits.shut(self.first_exit + number)
        for number, wound in enumerate(self.wounds):
            if wound.is_open:
                self._cut(number)
        self._make_wall()
        self.suction_rate, self.suction_radius, self._owed, self._sucked_until = state["suction"]
        tool, rows = self.tool, [np.array(row) for row in state["tool"]]
        tool.position, tool.wanted_position, tool.velocity, tool.spin = (
            rows[0], rows[2], rows[4], rows[5]
        )  # fmt: skip
        tool.rotation, tool.wanted_rotation = map(Rotation.from_quat, (rows[1], rows[3]))
        tool.place(self.wall, self.neighbors)
