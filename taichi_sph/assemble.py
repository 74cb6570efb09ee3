"""Assembly: the parts of a simulation from a scene and its vessel."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from taichi_sph.boundary.boundary import BloodFlow, Boundary
from taichi_sph.boundary.datum import PressureDatum
from taichi_sph.boundary.flow_extension import buffer_sites, flow_extension
from taichi_sph.boundary.inflow import (
    HYSTERESIS,
    BufferZones,
    DrivenOpening,
    buffer_blood,
    buffer_capacity,
    buffer_layers,
    buffer_regions,
)
from taichi_sph.boundary.outlets import Outlets
from taichi_sph.boundary.suction import Suction
from taichi_sph.boundary.tool import Tool
from taichi_sph.boundary.tool_surface import ToolSurface, read_tool_surface
from taichi_sph.boundary.tracer import AGE, DYE, Tracer
from taichi_sph.boundary.wall_motion import MovingWall, WallMotion, read_wall_motion
from taichi_sph.boundary.wounds import MOST_WOUNDS, Wounds
from taichi_sph.derived import Derived, derive
from taichi_sph.errors import InputError
from taichi_sph.fluid.calibration import Calibration, calibrate
from taichi_sph.fluid.equation_of_state import Tait
from taichi_sph.fluid.model import Fluid
from taichi_sph.fluid.rheology import make_rheology
from taichi_sph.geometry.filling import clear_of_proxies
from taichi_sph.geometry.findings import BEYOND
from taichi_sph.geometry.mesh import Booleans, Floats
from taichi_sph.geometry.vessel import Vessel
from taichi_sph.geometry.wall_sampling import WallSample
from taichi_sph.particles.grid import cells_within, make_grid
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import LOCAL_DATUM, Particles
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Wall
from taichi_sph.scene import Scene
from taichi_sph.settling import Plane, settle
from taichi_sph.waveform import read_waveform

SKIN = 0.1
"""Skin of the neighbour lists over the support radius: a wider one is built less often and holds
more candidates; from 0.12 on (2.24 d) it holds the lattice's next shell.  Of 0.02 to 0.3, PcNet
runs A fastest with 0.1 and the physics, whose steps are short, is 7 % faster with 0.05 to 0.08."""

OPENING_REACH = BEYOND
"""Blood beyond an opening's plane has left by it within this many radii of its centre, or nearer
where another branch passes."""

FILLING_ROUNDS = 8
"""Most lattices that are tried to fill a lumen."""
PACKING = 1.1
"""Blood that flows in may pack the vessel closer than the lattice at the start by this factor."""


@dataclass(frozen=True, eq=False)
class Assembly:
    """What a simulation of a scene is made of."""

    scene: Scene
    vessel: Vessel
    derived: Derived
    fluid: Fluid
    initial_blood: Floats
    """Positions at the start [m], (n, 3)."""
    blood: BloodFlow
    boundaries: tuple[Boundary, ...]
    """In the order in which they are asked."""


@dataclass(frozen=True, eq=False)
class _Plan:
    """What a scene's parts are made from, before there are any fields."""

    scene: Scene
    vessel: Vessel
    kernel: WendlandC2
    calibration: Calibration
    motion: WallMotion | None
    driven: list[DrivenOpening]
    tool: ToolSurface | None
    tool_position: Floats
    """[m]"""

    @property
    def spacing(self) -> float:
        """Of the blood [m]."""
        return self.scene.discretization.spacing

    @property
    def wall_spacing(self) -> float:
        """Of the proxies [m]."""
        return self.scene.discretization.wall_spacing_ratio * self.spacing

    @property
    def layers(self) -> int:
        """Layers of a buffer."""
        return buffer_layers(self.spacing, self.kernel.support_radius)

    @property
    def buffer_depth(self) -> float:
        """Length of the flow extensions [m]."""
        return buffer_regions(self.driven, self.spacing, self.kernel.support_radius).depth


@dataclass(frozen=True, eq=False)
class InitialState:
    """Blood and proxies of a scene at the start, before there are any fields."""

    blood: Floats
    """Positions [m], (n, 3)."""
    in_lumen: int
    """Of them in the lumen, the first; those of buffers follow."""
    left_out: int
    """Sites that hold no blood, for they are too near to a proxy."""
    wall: WallSample
    """Proxies of the vessel's wall."""
    setback: float
    """Of the proxies behind the lumen's surface [m]."""
    proxies: Floats
    """Those of the wall and of the flow extensions [m], (m, 3)."""
    normals: Floats
    """Unit normals out of the lumen, (m, 3)."""
    amplitudes: Floats
    """How far each moves with the wall [m], (m,)."""


def initial_state(scene: Scene, vessel: Vessel, seed: int = 0) -> InitialState:
    """Sample the wall and fill the column: what a simulation begins with.

    Raises:
        InputError: the column does not fit the vessel, or something that the scene names cannot be
            used.
    """
    return _initial_state(_make_plan(scene, vessel), seed)


def assemble(scene: Scene, vessel: Vessel, seed: int = 0) -> Assembly:
    """Sample the wall, fill the column and make all fields but those of a model.

    Raises:
        InputError: the column does not fit the vessel, or something that the scene names cannot be
            used.
    """
    plan = _make_plan(scene, vessel)
    start = _initial_state(plan, seed)
    initial = start.blood
    derived = derive(scene, vessel, len(initial), len(start.proxies))
    fluid = _make_fluid(plan, derived)
    particles = Particles.from_numpy(
        initial, mass=scene.blood.density * plan.spacing**3, room=_room(plan, len(initial)),
        more=(DYE, AGE, *(() if derived.quiet_speed is None else (LOCAL_DATUM,))),
    )  # fmt: skip
    wall = Wall.from_numpy(
        start.proxies, start.normals, plan.kernel, start.setback, plan.wall_spacing,
        tool=0 if plan.tool is None else len(plan.tool.position), amplitude=start.amplitudes,
    )  # fmt: skip
    neighbors = _make_neighbors(plan, particles.capacity, wall)
    blood = BloodFlow(particles, wall, neighbors, scene.gravity)
    boundaries = _make_boundaries(plan, blood, derived)
    inflow = next(b for b in boundaries if isinstance(b, BufferZones))
    top = None if scene.column.full else _opening_plane(plan)
    initial = settle(blood, fluid, inflow, start.in_lumen, top)
    derived = replace(derived, blood_particles=len(initial))
    inflow.reset()  # identities go on after those that are left
    return Assembly(scene, vessel, derived, fluid, initial, blood, boundaries)


def _make_plan(scene: Scene, vessel: Vessel) -> _Plan:
    discretization = scene.discretization
    spacing = discretization.spacing
    kernel = WendlandC2(discretization.support_ratio * spacing)
    wall_spacing = discretization.wall_spacing_ratio * spacing
    calibration = calibrate(kernel, spacing, wall_spacing, scene.blood.density)
    driven = make_driven_openings(scene, vessel)
    motion = read_wall_motion(scene, vessel)
    if scene.tool is None:
        # A mere tip, just inside the column's opening.
        opening = vessel.opening(scene.column.opening)
        surface, position = None, opening.centre - opening.radius * opening.normal
    else:
        surface = read_tool_surface(
            scene.tool, Path(scene.folder), wall_spacing, calibration.setback, kernel
        )
        position = np.array(scene.tool.position)
    return _Plan(scene, vessel, kernel, calibration, motion, driven, surface, position)


def make_driven_openings(scene: Scene, vessel: Vessel) -> list[DrivenOpening]:
    """What drives the openings of a scene.

    Raises:
        InputError: a waveform that cannot be read, an opening too narrow for one particle.
    """
    driven = []
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
            driven.append(DrivenOpening(opening, table.flow, table.pressure, waveform, sites))
    return driven


def _initial_state(plan: _Plan, seed: int) -> InitialState:
    setback = plan.calibration.setback
    sample = plan.vessel.sample_wall(plan.wall_spacing, setback, seed)
    proxies, normals, amplitudes = _proxies(plan, sample)
    column = _column(plan, proxies)
    buffers = buffer_blood(plan.driven, column, plan.spacing, plan.layers)
    clear = clear_of_proxies(buffers, proxies, plan.spacing, setback)
    blood = np.concatenate([column, buffers[clear]])
    left_out = int((~clear).sum())
    return InitialState(blood, len(column), left_out, sample, setback, proxies, normals, amplitudes)


def _proxies(plan: _Plan, sample: WallSample) -> tuple[Floats, Floats, Floats]:
    """Proxies of wall and flow extensions: positions, normals, amplitudes, (m, 3), (m, 3), (m,).

    Raises:
        InputError: a flow extension runs into the lumen.
    """
    vessel, setback = plan.vessel, plan.calibration.setback
    positions, normals = [sample.positions], [sample.normals]
    amplitudes = [np.zeros(len(sample.positions))]
    if plan.motion is not None:
        feet = sample.positions - setback * sample.normals
        amplitudes = [plan.motion.amplitude_at(vessel, feet)]
    for driven in plan.driven:
        rim = vessel.rim(vessel.openings.index(driven.opening))
        position, normal = flow_extension(
            rim, driven.opening, plan.wall_spacing, setback, plan.buffer_depth
        )
        if vessel.contains(position).any():
            raise InputError(
                f"openings.{driven.opening.name}: another part of the lumen lies where blood is "
                f"driven in, within {plan.buffer_depth:.3g} m beyond it; cut that end farther back"
            )
        positions.append(position)
        normals.append(normal)
        amplitudes.append(np.zeros(len(position)))
    return np.concatenate(positions), np.concatenate(normals), np.concatenate(amplitudes)


def _clear(plan: _Plan, proxies: Floats, places: Floats, spacing: float) -> Floats:
    """A lattice (n, 3) [m] of a spacing, less what the proxies and the tool take."""
    places = places[_beside_tool(plan, places, 0.5 * spacing)]
    return places[clear_of_proxies(places, proxies, spacing, plan.calibration.setback)]


def _beside_tool(plan: _Plan, places: Floats, clear: float) -> Booleans:
    """Which places (n, 3) [m] lie outside the tool, farther from it than `clear` [m], (n,)."""
    if plan.tool is None or len(places) == 0:
        return np.ones(len(places), bool)
    apart = places - plan.tool_position
    return (plan.tool.distance(apart) > clear) & plan.tool.outside(apart)


def _column(plan: _Plan, proxies: Floats) -> Floats:
    """As many particles as the column has room for (n, 3) [m]: places of a finer lattice.

    A lattice of the blood's own spacing leaves a void at the wall, and at every spacing another
    one.  These are too close to each other, until `taichi_sph.settling` lets them go.

    Raises:
        InputError: the column does not fit, or the proxies take all of its places.
    """
    spacing, column, vessel = plan.spacing, plan.scene.column, plan.vessel
    lattice = vessel.fill_column(column, spacing)
    places = _clear(plan, proxies, lattice, spacing)
    if len(places) == 0:
        raise InputError(
            f"column: no place at {column.opening!r} is far enough from the wall at "
            f"spacing {spacing:g} m; choose a finer spacing"
        )
    room = vessel.column_room(column, spacing)
    if column.particles is not None:
        # As deep, whatever the lattice's spacing; as many particles may be less than a layer.
        column = msgspec.structs.replace(column, height=max(room.height, spacing), particles=None)
        lattice = vessel.fill_column(column, spacing)
        places = _clear(plan, proxies, lattice, spacing)
    taken = int((~_beside_tool(plan, lattice, 0.0)).sum())
    wanted = round(room.volume / spacing**3 - taken)
    for _ in range(FILLING_ROUNDS - 1):
        if len(places) >= wanted:
            break
        # A little finer than in proportion, for what is cut off at the wall does not shrink alike.
        spacing *= 0.999 * (max(1, len(places)) / wanted) ** (1.0 / 3.0)
        places = _clear(plan, proxies, vessel.fill_column(column, spacing), spacing)
    kept = np.random.default_rng(0).permutation(len(places))[:wanted]
    return places[np.sort(kept)]


def _opening_plane(plan: _Plan) -> Plane:
    """Half a spacing below the opening that the column stands at: above it blood would leave."""
    opening = plan.vessel.opening(plan.scene.column.opening)
    return Plane(opening.centre - 0.5 * plan.spacing * opening.normal, opening.normal)


def _room(plan: _Plan, count: int) -> int:
    """Rows for blood that flows in: it may fill the vessel at its widest, and pack it closer."""
    if not plan.driven:
        return 0
    widest = plan.vessel.volume
    if plan.motion is not None:
        widest += plan.vessel.wall_area * plan.motion.amplitude
    full = widest / plan.spacing**3 + buffer_capacity(plan.driven, plan.layers)
    return max(0, math.ceil(PACKING * full) - count)


def _make_fluid(plan: _Plan, derived: Derived) -> Fluid:
    scene = plan.scene
    return Fluid(
        kernel=plan.kernel,
        equation_of_state=Tait(scene.blood.density, derived.sound_speed),
        rheology=make_rheology(scene.blood.rheology),
        calibration=plan.calibration,
        spacing=plan.spacing,
        artificial_viscosity=scene.blood.artificial_viscosity,
        courant_number=scene.discretization.courant_number,
        nested=scene.discretization.viscous_form == "nested",
    )


def _make_neighbors(plan: _Plan, capacity: int, wall: Wall) -> Neighbors:
    """Lists over the cells that blood can be in."""
    radius, vessel = plan.kernel.support_radius, plan.vessel
    skin = SKIN * radius
    # The wall's proxies, and blood that leaves through an opening, are within this.
    margin = 2.0 * (radius + skin) + wall.largest_amplitude
    margin += plan.buffer_depth if plan.driven else 0.0
    lower, upper = vessel.vertices.min(axis=0) - margin, vessel.vertices.max(axis=0) + margin
    grid = make_grid(lower, upper, radius + skin + 0.5 * wall.largest_amplitude)
    used = cells_within(grid, vessel.signed_distance, margin)
    return Neighbors.allocate(grid, radius, skin, capacity, plan.spacing, wall, used)


def _make_boundaries(plan: _Plan, blood: BloodFlow, derived: Derived) -> tuple[Boundary, ...]:
    """All boundaries of a scene, in the order in which they are asked.

    What has left is marked first, so that suction finds only what is still there, and blood that is
    added is not taken before it has moved.  Suction asks how far the tool has moved, after it has.
    Reservoirs drive with what their pressure is over the datum.
    """
    scene, vessel, spacing = plan.scene, plan.vessel, plan.spacing
    outlets = Outlets(blood, len(vessel.openings) + MOST_WOUNDS)
    far_end = (plan.layers + HYSTERESIS) * spacing
    for k, opening in enumerate(vessel.openings):
        if opening.is_open:
            beyond = far_end if scene.openings[opening.name].driven else 0.0
            end = opening.centre + beyond * opening.normal
            reach = vessel.clear_beyond(k, OPENING_REACH, beyond)
            outlets.open(k, end, end, opening.normal, reach)
    tool = Tool(blood, plan.tool, plan.tool_position)
    inflow = BufferZones(
        blood, plan.driven, spacing, plan.kernel.support_radius, scene.blood.density
    )
    wounds = Wounds(blood, vessel, outlets, len(vessel.openings), plan.kernel, spacing)
    boundaries: list[Boundary] = [
        outlets,
        tool,
        Suction(blood, outlets, tool, spacing),
        PressureDatum(
            blood, plan.driven, wounds, scene.blood.density, derived.sound_speed,
            scene.discretization.sound_speed_ratio, derived.quiet_speed,
        ),
        inflow,
        Tracer(blood, inflow, outlets),
        wounds,
    ]  # fmt: skip
    if plan.motion is not None:
        boundaries.append(MovingWall(blood, plan.motion))
    return tuple(boundaries)
