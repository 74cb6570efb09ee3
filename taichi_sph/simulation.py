"""Simulation: the blood of a scene in its vessel."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from taichi_sph.boundary.inflow import (
    LEAST_APART,
    BufferZones,
    DrivenOpening,
    add_blood,
    buffer_sites,
    flow_extension,
)
from taichi_sph.boundary.outlets import OUT_OF_BOX, SUCTION, Outlets
from taichi_sph.boundary.surgery import MOST_WOUNDS, Surgery, Wound
from taichi_sph.boundary.tool import Tool, read_shape
from taichi_sph.boundary.wall_motion import read_wall_motion
from taichi_sph.derived import Derived, derive
from taichi_sph.diagnostics import Diagnostics, diagnose
from taichi_sph.errors import InputError, RunError
from taichi_sph.fluid.calibration import calibrate
from taichi_sph.fluid.equation_of_state import Tait
from taichi_sph.fluid.rheology import make_rheology
from taichi_sph.fluid.wcsph import AccelerationModel, Fluid, SphAcceleration, force_on_tool
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.motion import Motion
from taichi_sph.particles.neighbors import Neighbors, cells_within, make_grid
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Wall
from taichi_sph.runtime import float_dtype
from taichi_sph.scene import Scene
from taichi_sph.waveform import read_waveform

ModelFactory = Callable[[Fluid, int], AccelerationModel]
"""Makes a model for a fluid and a number of particles."""

SKIN = 0.1
"""Skin of the neighbour lists over the support radius: a wider one is built less often and holds
more candidates; from 0.12 on (2.24 d) it holds the lattice's next shell.  Of 0.02 to 0.3, PcNet
pours A fastest with 0.1 and the physics, whose steps are short, is 7 % faster with 0.05 to 0.08."""

OPENING_REACH = 2.5
"""Blood beyond an opening's plane has left by it within this many radii of its centre."""

DROP_TIME = 0.3
"""Drops that have left through a wound are shown for this long [s]: they fall 0.4 m."""


@dataclass(frozen=True)
class State:
    """All that changes from step to step; rows in the order of the grid."""

    time: float
    """[s]"""
    last_step: float
    """[s]"""
    fallback_time: float
    """[s]"""
    steps: int
    wall_corrections: int
    controls: dict[str, Any]
    """What was done to the run: gravity, wounds, tool, pistons; numbers, lists and names only."""
    removed: np.ndarray
    """Particles that have left by each place of the account, see `taichi_sph.boundary.outlets`."""
    identity: np.ndarray
    """(n,)"""
    position: np.ndarray
    """[m], (n, 3)."""
    velocity: np.ndarray
    """[m/s], (n, 3)."""
    acceleration: np.ndarray
    """[m/s^2], (n, 3)."""
    density: np.ndarray
    """[kg/m^3], (n,)."""


class Simulation(Motion):
    """Blood of a scene in its vessel."""

    def __init__(
        self,
        scene: Scene,
        vessel: Vessel,
        make_model: ModelFactory = SphAcceleration,
        seed: int = 0,
    ):
        """Sample the wall, fill the column and set up the model (the physics by default).

        Raises:
            InputError: the column does not fit the vessel.
        """
        grid = scene.discretization
        kernel = WendlandC2(grid.support_ratio * grid.spacing)
        wall_spacing = grid.wall_spacing_ratio * grid.spacing
        calibration = calibrate(kernel, grid.spacing, wall_spacing, scene.blood.density)
        setback = calibration.setback
        self.scene = scene
        self.vessel = vessel
        plugs = BufferZones(
            make_pistons(scene, vessel), grid.spacing, kernel.support_radius, scene.blood.density
        )
        self.pulse = read_wall_motion(scene, vessel)
        sample = vessel.sample_wall(wall_spacing, setback, seed)
        proxies, normals = [sample.positions], [sample.normals]
        swings = [np.zeros(len(sample.positions))]
        if self.pulse is not None:
            swings = [self.pulse.reach(vessel, sample.positions - setback * sample.normals)]
        for piston in plugs.each:
            rim = vessel.rim(vessel.openings.index(piston.opening))
            tube = flow_extension(rim, piston.opening, wall_spacing, setback, plugs.gates.depth)
            proxies.append(tube[0])
            normals.append(tube[1])
            swings.append(np.zeros(len(tube[0])))
        tool = make_tool(scene, vessel, wall_spacing, setback, kernel)
        column = vessel.fill_column(scene.column, grid.spacing)
        if tool.shape is not None and len(column):
            about = column - tool.position
            clear = tool.shape.distance(about) > 0.5 * grid.spacing
            column = column[clear & tool.shape.clear_of(about)]
        blood = np.concatenate([column, plugs.initial_blood(column)])
        # What flows in may fill the vessel, at its widest, and pack it closer than the lattice did.
        room = 0
        if plugs.each:
            widest = vessel.volume
            if self.pulse is not None:
                widest += vessel.wall_area * self.pulse.swing
            full = widest / grid.spacing**3 + plugs.capacity
            room = max(0, math.ceil(1.1 * full) - len(blood))
        self._initial = blood
        self.derived: Derived = derive(scene, vessel, len(blood), sum(map(len, proxies)))
        self.fluid = Fluid(
            kernel=kernel,
            equation_of_state=Tait(scene.blood.density, self.derived.sound_speed),
            rheology=make_rheology(scene.blood.rheology),
            calibration=calibration,
            artificial_viscosity=scene.blood.artificial_viscosity,
            courant_number=grid.courant_number,
            nested=grid.viscous_form == "nested",
        )
        particles = Particles.from_numpy(
            blood, mass=scene.blood.density * grid.spacing**3, room=room
        )
        wall = Wall.from_numpy(
            np.concatenate(proxies), np.concatenate(normals), kernel, setback, wall_spacing,
            tool=tool.count, swing=np.concatenate(swings),
        )  # fmt: skip
        skin = SKIN * kernel.support_radius
        margin = 2.0 * (kernel.support_radius + skin) + wall.most_swing
        margin += plugs.gates.depth if plugs.each else 0.0
        lower, upper = vessel.vertices.min(axis=0) - margin, vessel.vertices.max(axis=0) + margin
        cells = make_grid(lower, upper, kernel.support_radius + skin + 0.5 * wall.most_swing)
        neighbors = Neighbors.allocate(
            cells,
            kernel.support_radius,
            skin,
            particles.capacity,
            grid.spacing,
            wall,
            # The wall's proxies, and blood that leaves through an opening, are within this.
            cells_within(cells, vessel.signed_distance, margin),
        )
        super().__init__(
            particles,
            wall,
            neighbors,
            make_model(self.fluid, particles.capacity),
            scene.gravity,
            # Faster than sound the equation of state means nothing.
            speed_limit=self.derived.sound_speed,
            integrator=grid.integrator,
        )
        if plugs.each:
            self.plugs = plugs
        self._pistons = plugs
        self.exits = Outlets(len(vessel.openings) + MOST_WOUNDS)
        for k, opening in enumerate(vessel.openings):
            if opening.is_open:
                driven = scene.openings[opening.name].driven
                beyond = (plugs.far_end if driven else 0.0) * opening.normal
                self.exits.open(
                    k, opening.centre + beyond, opening.centre + beyond, opening.normal,
                    OPENING_REACH * opening.radius,
                )  # fmt: skip
        self.surgery = Surgery(
            vessel, wall, neighbors, self.exits, len(vessel.openings), kernel, grid.spacing, tool
        )
        self.added = 0
        """Particles that pistons have added."""
        self._next_identity = len(blood)
        self._impulse = np.zeros(3)
        self._impulse_time = 0.0

    @classmethod
    def from_scene(
        cls, scene: Scene, make_model: ModelFactory = SphAcceleration, seed: int = 0
    ) -> "Simulation":
        """Read the vessel of a scene and set everything up.

        Raises:
            InputError: the surface cannot be used, or the column does not fit.
        """
        return cls(scene, read_vessel(scene), make_model, seed)

    def place(self, position: np.ndarray, velocity: np.ndarray) -> None:
        """Begin again, at time zero, with other blood.

        Args:
            position: [m], (n, 3); row k gets identity k; n at most what the column had.
            velocity: [m/s], (n, 3).

        Raises:
            InputError: there is no room for so many.
        """
        if len(position) > self.particles.capacity:
            raise InputError(
                f"{len(position)} particles: there is room for {self.particles.capacity}, those of "
                "the scene's column"
            )
        self.time = self.last_step = self.fallback_time = 0.0
        self.steps = self.wall_corrections = 0
        self._start_again(position, velocity)

    def reset(self) -> None:
        """Blood, pistons, wounds, tool and gravity as at the start; clock and steps go on."""
        self.gravity = self.scene.gravity
        self._start_again(self._initial, np.zeros_like(self._initial))

    def _start_again(self, position: np.ndarray, velocity: np.ndarray) -> None:
        """All but gravity as at the start, with such blood, whatever the clock says."""
        self.put(np.arange(len(position)), position, velocity)
        self.particles.acceleration.fill(0.0)
        self.exits.removed.fill(0)
        self.added, self._next_identity = 0, len(position)
        for piston in self.pistons:
            piston.start_again()
        self.surgery.start_again(self.time)
        self._pulse_until(self.time)

    def put(self, identity: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> None:
        """Replace the blood: identities (n,), positions [m] and velocities [m/s], (n, 3)."""
        self.particles.replace(identity=identity, position=position, velocity=velocity)
        self._stale = True

    def save_state(self) -> State:
        """A copy of the state; the lists are built anew at the next step.

        A simulation that goes on from the copy builds them too: both then add up in the same order
        and stay bitwise alike on the CPU.
        """
        p, n = self.particles, self.particles.count[None]
        self._stale = True
        controls = {
            "model": self.model.name,
            "gravity": list(self.gravity),
            "added": self.added,
            "next_identity": self._next_identity,
            "pistons": [piston.state() for piston in self._pistons.each],
            "wall": [self.wall.level, self.wall.rate],
            **self.surgery.state(),
        }
        return State(
            self.time, self.last_step, self.fallback_time, self.steps, self.wall_corrections,
            controls, self.exits.account(),
            *(
                field.to_numpy()[:n]
                for field in (p.identity, p.position, p.velocity, p.acceleration, p.density)
            ),
        )  # fmt: skip

    def load_state(self, state: State) -> None:
        """Go on from a state of the same scene, under the model that it names.

        Raises:
            InputError: it is of another number of openings, or there is no room for so many.
        """
        n, p = len(state.identity), self.particles
        if n > p.capacity or state.removed.shape != self.exits.account().shape:
            raise InputError(
                f"a state of {n} particles and an account of {len(state.removed)} places: the "
                f"scene has {p.capacity} and {len(self.exits.account())}"
            )
        p.replace(
            identity=state.identity,
            position=state.position,
            velocity=state.velocity,
            acceleration=state.acceleration,
            density=state.density,
        )
        self.exits.removed.from_numpy(state.removed)
        self.time, self.last_step, self.fallback_time = (
            state.time, state.last_step, state.fallback_time
        )  # fmt: skip
        self.steps, self.wall_corrections = state.steps, state.wall_corrections
        controls = state.controls
        x, y, z = controls["gravity"]
        self.gravity = (x, y, z)
        self.added, self._next_identity = controls["added"], controls["next_identity"]
        for piston, row in zip(self._pistons.each, controls["pistons"], strict=True):
            piston.load_state(row)
        self.surgery.load_state(controls)
        self.neighbors.move_wall(self.wall, *controls["wall"])
        self._stale = True

    def use_model(self, model: AccelerationModel) -> None:
        """Let another model, made by `make_model`, compute accelerations from now on."""
        self.model = model

    def make_model(self, make_model: ModelFactory) -> AccelerationModel:
        """A model for this simulation; its fields stay in memory for good."""
        return make_model(self.fluid, self.particles.capacity)

    def compile_kernels(self, models: list[AccelerationModel]) -> None:
        """Have models compile what they need, before anybody waits for it; nothing moves."""
        self.neighbors.build(self.particles, self.wall)
        for model in models:
            acceleration = self.particles.acceleration.to_numpy()
            model.accelerate(self.particles, self.wall, self.neighbors, self.gravity)
            self.particles.acceleration.from_numpy(acceleration)
            if self.wall.tool and model.pair_coefficients is not None:
                force_on_tool(self.particles, self.wall, self.neighbors, *model.pair_coefficients)
        self.surgery.compile_kernels(self.particles)
        self._stale = True

    @property
    def pistons(self) -> list[DrivenOpening]:
        """What drives the openings."""
        return self._pistons.each

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of the box that blood may be in [m]."""
        grid = self.neighbors.grid
        low = np.array(grid.lower)
        return low, low + np.array(grid.cell) * np.array(grid.shape)

    def drive(self, factor: float, opening: str | None = None) -> None:
        """Multiply what drives an opening, or all, by a factor; it takes 0.05 s to get there.

        Raises:
            InputError: nothing drives that opening.
        """
        chosen = [p for p in self._pistons.each if opening in (None, p.opening.name)]
        if not chosen:
            names = ", ".join(p.opening.name for p in self._pistons.each) or "none"
            raise InputError(f"inflow: nothing drives {opening or 'this scene'}; driven: {names}")
        for piston in chosen:
            piston.asked = factor

    def wound(self, centre: np.ndarray, radius: float, end: np.ndarray | None = None) -> Wound:
        """Open the wall: see `Surgery.wound`."""
        self._stale = True
        return self.surgery.wound(centre, radius, end)

    def clamp(self, number: int | None = None) -> None:
        """Close a wound, or all: see `Surgery.clamp`."""
        self._stale = True
        numbers = range(len(self.surgery.wounds)) if number is None else [number]
        for each in numbers:
            self.surgery.clamp(each, self.particles, self.time)

    def suck(self, rate: float, radius: float | None = None) -> None:
        """Suck away at most `rate` [m^3/s] of the blood within a radius [m] of the tool's tip."""
        self.surgery.suction_rate = rate
        self.surgery.suction_radius = radius or 2.0 * self.scene.discretization.spacing

    def move_tool(self, position: np.ndarray, rotation: np.ndarray | None = None) -> None:
        """Say where the tool is wanted: position [m], rotation as a quaternion w, x, y, z."""
        tool = self.surgery.tool
        tool.wanted_position = np.asarray(position, float)
        if rotation is not None:
            tool.wanted_rotation = Rotation.from_quat(np.roll(rotation, -1))

    def take_force(self) -> np.ndarray:
        """Force of the blood on the tool, mean since this was last asked [N], (3,)."""
        force = self._impulse / self._impulse_time if self._impulse_time else np.zeros(3)
        self._impulse, self._impulse_time = np.zeros(3), 0.0
        return force

    def before_build(self) -> None:
        """Add what pistons bring and mark what has left: by exits, by suction, out of the box.

        Raises:
            RunError: there is no room for so much blood.
        """
        self.exits.mark(self.particles, self.neighbors.grid, self.time)
        self.surgery.before_build(self.particles, self.time)
        position, velocity = self._pistons.new_blood()
        if len(position):
            room = self.particles.capacity - self.particles.count[None]
            if room < len(position):
                raise RunError(
                    f"the run diverged: at t = {self.time:.6g} s the vessel is over-full, "
                    f"{self.particles.capacity} particles; likely cause: more is driven in than "
                    "can leave, or the pressure is too high for the sound speed"
                )
            added = add_blood(
                self.particles, self._pistons.gates,
                *(np.ascontiguousarray(a, float_dtype()) for a in (position, velocity)),
                np.zeros(len(position), np.int32), self._next_identity,
                (LEAST_APART * self.scene.discretization.spacing) ** 2,
            )  # fmt: skip
            self.added += added
            self._next_identity += added

    def before_drift(self, dt: float) -> None:
        """Move plugs, tool and wall by a step of dt [s]."""
        if self._pistons.each:
            self._pistons.advance(self.particles, self.time, dt, self.gravity)
        if self.wall.tool and self.model.pair_coefficients is not None:
            force = force_on_tool(
                self.particles, self.wall, self.neighbors, *self.model.pair_coefficients
            )
            self._impulse += dt * np.array([force[0], force[1], force[2]])
            self._impulse_time += dt
        self._wall_moved += self.surgery.before_drift(dt) + self._pulse_until(self.time + dt)

    def _pulse_until(self, time: float) -> float:
        """Put the wall where its pulse wants it at a time [s]; returns how far it has moved [m]."""
        if self.pulse is None:
            return 0.0
        before = self.wall.level
        self.neighbors.move_wall(self.wall, self.pulse.level(time), self.pulse.rate(time))
        return self.wall.most_swing * abs(self.wall.level - before)

    def positions(self) -> np.ndarray:
        """Positions of the live blood [m], shape (n, 3), in order of identity."""
        return self.particles.in_order(self.particles.position)

    def velocities(self) -> np.ndarray:
        """Velocities of the live blood [m/s], shape (n, 3), in order of identity."""
        return self.particles.in_order(self.particles.velocity)

    def positions_and_velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """Both in one pass: [m] and [m/s], (n, 3), in order of identity."""
        identity, position, velocity = self.particles.live()
        order = np.argsort(identity)
        return position[order], velocity[order]

    def identities(self) -> np.ndarray:
        """Identities of the live blood, ascending, shape (n,)."""
        return self.particles.identities()

    def drops(self) -> np.ndarray:
        """Blood that has lately left through wounds, as it falls [m], (n, 3)."""
        return self.exits.drops(self.time, np.asarray(self.gravity), DROP_TIME)

    def diagnostics(self) -> Diagnostics:
        """Figures of the present state; leaks are counted against the surface itself."""
        account = self.exits.account()
        names = [o.name for o in self.vessel.openings]
        exits = account[2:]
        drained = {name: int(n) for name, n in zip(names, exits, strict=False)}
        density = self.particles.in_order(self.particles.density)
        x = self.positions()
        held = np.ones(len(x), bool)
        for wound in self.surgery.wounds:
            # Blood in the hole has not leaked.
            held &= wound.distance(x) > wound.radius + 3.0 * self.scene.discretization.spacing
        swung = self.wall.level * self.wall.most_swing
        leaks = self.vessel.count_leaks(x[held], swung) + int(account[OUT_OF_BOX])
        return diagnose(
            self, density, drained, leaks,
            added=self.added, bled=int(exits[len(names) :].sum()), sucked=int(account[SUCTION]),
        )  # fmt: skip


def make_pistons(scene: Scene, vessel: Vessel) -> list[DrivenOpening]:
    """What drives the openings of a scene.

    Raises:
        InputError: a waveform that cannot be read, an opening too narrow for one particle.
    """
    pistons = []
    for k, opening in enumerate(vessel.openings):
        table = scene.openings[opening.name]
        if table.driven:
            sites = buffer_sites(vessel.rim(k), opening, scene.discretization.spacing)
            if len(sites) == 0:
                raise InputError(
                    f"openings.{opening.name}: too narrow to be driven at spacing "
                    f"{scene.discretization.spacing:g} m"
                )
            waveform = read_waveform(table.waveform, Path(scene.folder))
            pistons.append(DrivenOpening(opening, table.flow, table.pressure, waveform, sites))
    return pistons


def make_tool(
    scene: Scene, vessel: Vessel, spacing: float, setback: float, kernel: WendlandC2
) -> Tool:
    """The scene's tool or, without one, a point just inside the column's opening.

    Raises:
        InputError: its surface cannot be used.
    """
    if scene.tool is None:
        opening = vessel.opening(scene.column.opening)
        return Tool(None, opening.centre - opening.radius * opening.normal)
    shape = read_shape(scene.tool, Path(scene.folder), spacing, setback, kernel)
    return Tool(shape, np.array(scene.tool.position))
