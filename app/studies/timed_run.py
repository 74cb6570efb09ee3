"""What is measured of a run, what is compared, and when a run has failed.

The rules were fixed before the first chart and the first stability run.  A run that breaks one has
failed from that frame on and is shown as such; none is left out.  They are of blood that falls and
leaves: gravity gives all its energy, and none comes in.
"""

import math
import time
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from app.studies.splishsplash import Peer
from taichi_sph.diagnostics import FEW, Diagnostics
from taichi_sph.errors import InputError, RunError
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation


@dataclass(frozen=True)
class Rules:
    """When a run has failed, checked at every frame."""

    leaked: float = 1e-3
    """Part of the blood outside the lumen."""
    compression: float = 0.1
    """99th percentile of max(rho/rho_0 - 1, 0)."""
    speed: float = 3.0
    """Largest speed over the scene's (a free fall through the whole lumen) or the start's."""
    energy: float = 1.1
    """Kinetic energy over what there was and what gravity has given."""
    clumped: float = 0.01
    """Part of the blood that has a neighbour within CLUMP spacings."""
    guarded: float = 0.2
    """Part of the time in which the physics stood in."""


CLUMP = 0.3
RULES = Rules()


def clumped_part(positions: np.ndarray, spacing: float) -> float:
    """Part of the particles (n, 3) [m] with another one within CLUMP spacings."""
    if len(positions) < 2:
        return 0.0
    nearest, _ = cKDTree(positions).query(positions, k=2)
    return float(np.mean(nearest[:, 1] < CLUMP * spacing))


def broken_rule(
    simulation: Simulation | Peer,
    figures: Diagnostics,
    blood: int,
    speed: float,
    energy_bound: float,
    rules: Rules = RULES,
) -> str:
    """The first rule that a state breaks, as a phrase with its figure; empty if none.

    Args:
        simulation: whose state it is.
        figures: of that state.
        blood: particles at the start.
        speed: the scene's, or that of the start if it is larger [m/s].
        energy_bound: kinetic energy that there may be [J].
        rules: the bounds.
    """
    positions = simulation.positions()
    numbers = (figures.kinetic_energy, figures.max_speed, figures.compression_p99)
    if not (np.isfinite(positions).all() and np.isfinite(numbers).all()):
        return "not finite"
    if figures.leaks > rules.leaked * blood:
        return f"{100 * figures.leaks / blood:.2g} % leaked"
    if figures.compression_p99 > rules.compression:
        return f"compressed by {100 * figures.compression_p99:.0f} %"
    if figures.max_speed > rules.speed * speed:
        return f"a speed of {figures.max_speed:.3g} m/s"
    if figures.kinetic_energy > rules.energy * energy_bound:
        return f"{figures.kinetic_energy / energy_bound:.2g} times the energy there can be"
    clumped = clumped_part(positions, simulation.scene.discretization.spacing)
    if clumped > rules.clumped:
        return f"{100 * clumped:.2g} % clumped"
    if figures.fallback_share > rules.guarded:
        return f"guarded for {100 * figures.fallback_share:.0f} % of the time"
    return ""


RESTING = 0.01
"""Speed over the scene's below which blood is at rest."""
FALLING = 0.9
"""Blood that has moved by this of the way of a free fall is falling, however short the way is."""
SETTLING = 0.1
"""Speed over the scene's that blood may gain where a start is not in balance."""


def energy_given(simulation: Simulation | Peer) -> float:
    """Kinetic energy of a start, what gravity can give to it in the lumen, and SETTLING's [J]."""
    scene = simulation.scene
    x, v = simulation.positions(), simulation.velocities()
    low = (simulation.vessel.vertices @ np.asarray(scene.gravity)).max()
    mass = simulation.particles.mass
    fall = np.maximum(low - x @ np.asarray(scene.gravity), 0.0).sum()
    settling = len(x) * (SETTLING * (simulation.derived.expected_speed or 1.0)) ** 2
    return float(mass * (fall + 0.5 * ((v.astype(float) ** 2).sum() + settling)))


@dataclass(frozen=True)
class Grid:
    """Coarse cells over a vessel, the same for every spacing."""

    lower: np.ndarray
    """[m], (3,)"""
    cell: float
    """[m]"""
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, lower: np.ndarray, upper: np.ndarray, cell: float) -> "Grid":
        """Cells of this width [m] over a box, with one to spare on every side."""
        count = np.ceil((np.asarray(upper) - lower) / cell).astype(int) + 3
        return cls(np.asarray(lower) - 1.5 * cell, cell, (count[0], count[1], count[2]))

    def share_out(self, positions: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Sums of values (n, 3) over the eight cells about each position, (cells, 3)."""
        place = (positions - self.lower) / self.cell - 0.5
        first = np.floor(place).astype(int)
        part = place - first
        total = np.zeros((math.prod(self.shape), 3))
        for corner in np.ndindex(2, 2, 2):
            index = np.clip(first + corner, 0, np.array(self.shape) - 1)
            weight = np.where(corner, part, 1.0 - part).prod(axis=1)
            flat = np.ravel_multi_index(tuple(index.T), self.shape)
            for a in range(3):
                total[:, a] += np.bincount(flat, weight * values[:, a], len(total))
        return total


def require_falling(scene: Scene, command: str) -> None:
    """Refuse a scene whose blood does more than fall and leave: no rule here would hold.

    Raises:
        InputError: a pump, a reservoir or the wall drives its blood.
    """
    if scene.driver:
        raise InputError(
            f"{command} {scene.name}: {scene.driver}; runs are judged by what blood does that only "
            "falls and leaves: take flow, pressure and pulse out of the scene"
        )


@dataclass
class Trace:
    """A run as it is measured, frame by frame; each frame's values are per blood at the start."""

    frame_interval: float
    """[s]"""
    spacing: float = 0.0
    """Between particles [m]; 0 where it was not kept."""
    gravity: float = 0.0
    """Size of gravity [m/s^2]; 0 where it was not kept."""
    drained: list[float] = field(default_factory=list)
    """Part that has left."""
    centre: list[np.ndarray] = field(default_factory=list)
    """Centre of mass [m]; NaN of an empty vessel."""
    energy: list[float] = field(default_factory=list)
    """Kinetic energy over the mass at the start [m^2/s^2]."""
    momentum: list[np.ndarray] = field(default_factory=list)
    """Momentum on the grid over the mass at the start [m/s]."""
    compression: list[float] = field(default_factory=list)
    """99th percentile."""
    leaked: list[float] = field(default_factory=list)
    """Part outside the lumen."""
    slow: list[float] = field(default_factory=list)
    """Part at rest, of what is there: slower than RESTING of the scene's speed."""

    @classmethod
    def of(cls, scene: Scene) -> "Trace":
        """An empty one, for a run of a scene."""
        gravity = float(np.linalg.norm(scene.gravity))
        return cls(scene.frame_interval, scene.discretization.spacing, gravity)

    def note(
        self, simulation: Simulation | Peer, figures: Diagnostics, blood: int, grid: Grid | None
    ) -> None:
        """Add a frame of a pour of so many particles."""
        x, v = simulation.positions(), simulation.velocities().astype(float)
        self.drained.append(1.0 - figures.particles / blood)
        self.centre.append(x.mean(axis=0) if len(x) else np.full(3, np.nan))
        self.energy.append(figures.kinetic_energy / (blood * simulation.particles.mass))
        self.compression.append(figures.compression_p99)
        self.leaked.append(figures.leaks / blood)
        resting = RESTING * (simulation.derived.expected_speed or 1.0)
        self.slow.append(float(np.mean(np.linalg.norm(v, axis=1) < resting)) if len(v) else 0.0)
        if grid is not None:
            self.momentum.append(grid.share_out(x, v / blood).astype(np.float32))


def is_at_rest(trace: Trace) -> bool:
    """Whether the blood of a run stays where it is, and did not merely begin to fall.

    Its centre moves by less than a spacing, and by less than FALLING of a free fall's way.  Then
    its path, its momentum and its kinetic energy are next to nothing, and so is the meaning of an
    error relative to them.
    """
    centre = np.array(trace.centre).reshape(-1, 3)
    centre = centre[np.isfinite(centre).all(axis=1)]
    if len(centre) == 0 or max(trace.drained, default=0.0) > FEW:
        return False
    moved = float(np.linalg.norm(centre - centre[0], axis=1).max())
    first, last = trace.frame_interval, trace.frame_interval * len(trace.centre)
    fall = 0.5 * trace.gravity * (last**2 - first**2)
    return moved < trace.spacing and (fall == 0.0 or moved < FALLING * fall)


@dataclass(frozen=True)
class Errors:
    """How far a run is from a reference; NaN what is relative to blood at rest."""

    path: float
    """Largest distance of the centres of mass over the length of the reference's path."""
    drained: float
    """Largest difference of the drained part."""
    energy: float
    """Largest difference of the kinetic energy over the reference's largest."""
    field: float
    """Mean over the frames of sum |p - p_ref| / sum |p_ref| over the coarse cells; NaN without."""
    compression: float
    """Largest 99th percentile, of the pour itself."""
    half_drained: float
    """When half of the blood had left [s]; NaN if it never had."""


def errors_of(trace: Trace, reference: Trace) -> Errors:
    """Compare the frames that both have."""
    frames = min(len(trace.drained), len(reference.drained))
    drained, wanted = np.array(trace.drained[:frames]), np.array(reference.drained[:frames])
    centre, path = (np.array(t.centre[:frames]).reshape(-1, 3) for t in (trace, reference))
    together = np.maximum(drained, wanted) < 1.0 - FEW
    length = np.linalg.norm(np.diff(path[together], axis=0), axis=1).sum()
    distance = np.linalg.norm(centre - path, axis=1)[together].max(initial=0.0)
    energy = np.abs(np.subtract(trace.energy[:frames], reference.energy[:frames]))
    cells = [
        np.abs(a - b).sum() / np.abs(b).sum()
        for a, b, both in zip(trace.momentum, reference.momentum, together, strict=False)
        if both and np.abs(b).sum() > 0.0
    ]
    rests = is_at_rest(reference)
    times = trace.frame_interval * np.arange(1, frames + 1)
    half = frames > 0 and drained[-1] > 0.5
    return Errors(
        path=math.nan if rests else float(distance / length) if length else 0.0,
        drained=float(np.abs(drained - wanted).max(initial=0.0)),
        energy=(
            math.nan
            if rests
            else float(energy.max(initial=0.0) / max(max(reference.energy, default=0.0), 1e-30))
        ),
        field=float(np.mean(cells)) if cells and not rests else math.nan,
        compression=max(trace.compression, default=0.0),
        half_drained=float(np.interp(0.5, drained, times)) if half else math.nan,
    )


@dataclass
class TimedRun:
    """A simulation that runs frame by frame, timed and judged; what has failed stays so."""

    name: str
    simulation: Simulation | Peer
    trace: Trace
    grid: Grid | None = None
    rules: Rules | None = None
    """None: only what diverges has failed."""
    seconds: list[float] = field(default_factory=list)
    """Wall time of each frame [s]."""
    compiled: int = 0
    """Steps of the first frame, which compiles and is not timed."""
    most_leaks: int = 0
    failure: str = ""
    """Why it ended early."""

    def __post_init__(self) -> None:
        self._blood = self.simulation.particles.count[None]
        if self.rules:
            fastest = np.linalg.norm(self.simulation.velocities(), axis=1).max(initial=0.0)
            self._speed = max(float(fastest), self.simulation.derived.expected_speed or 1.0)
            self._energy = energy_given(self.simulation)

    def frame(self, until: float) -> None:
        """Advance to a time [s] and note how the blood stands."""
        if self.failure:
            return
        before = time.perf_counter()
        try:
            self.simulation.advance_to(until)
        except RunError as error:
            self.failure = str(error)
            return
        self.seconds.append(time.perf_counter() - before)
        self.compiled = self.compiled or self.simulation.steps
        figures = self.simulation.diagnostics()
        if self.rules:
            self.failure = broken_rule(
                self.simulation, figures, self._blood, self._speed, self._energy, self.rules
            )
        self.most_leaks = max(self.most_leaks, figures.leaks)
        self.trace.note(self.simulation, figures, self._blood, self.grid)

    @property
    def empty(self) -> bool:
        """Whether all blood has left."""
        return bool(self.trace.drained) and self.trace.drained[-1] == 1.0

    @property
    def milliseconds_per_step(self) -> float:
        """Mean, without the first frame."""
        return 1e3 * sum(self.seconds[1:]) / max(1, self.simulation.steps - self.compiled)

    @property
    def wall_per_simulated(self) -> float:
        """Wall seconds for a simulated second, without the first frame; NaN if it is alone."""
        simulated = self.trace.frame_interval * (len(self.seconds) - 1)
        return sum(self.seconds[1:]) / simulated if simulated > 0.0 else math.nan
