"""Flows without a vessel, for `vesselflow validate` and the tests: tubes, boxes, slabs, tanks.

Each is a `Simulation`, as users' scenes are, without boundaries: only the wall and the blood are
laid out by hand.
Periodic axes are eight spacings long or more, the least that the neighbour lists allow.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from taichi_sph.boundary.boundary import BloodFlow
from taichi_sph.boundary.datum import LEAST_PRESSURE
from taichi_sph.derived import is_closed
from taichi_sph.fluid.calibration import calibrate
from taichi_sph.fluid.equation_of_state import Tait
from taichi_sph.fluid.local_datum import LOCAL_SHARE
from taichi_sph.fluid.model import Fluid
from taichi_sph.fluid.rheology import Casson, Newtonian, make_rheology
from taichi_sph.fluid.wcsph import SphAcceleration
from taichi_sph.particles.grid import make_grid
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import LOCAL_DATUM, Particles
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Wall
from taichi_sph.runtime import float_dtype
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation

DENSITY = 1060.0
"""rho_0 of blood, as scenes have it [kg/m^3]."""

VISCOSITY = 3.5e-3
"""Of Newtonian blood [Pa s]."""

GRAVITY = 9.81
"""[m/s^2]."""

MACH = 10.0
"""Sound speed over the largest speed, the scenes' default."""

BACKGROUND = 2.0
"""Background pressure of flows without a free surface [rho U^2]: the least that keeps the pressure
above zero everywhere.  Particles under pressure resist shear like grains, so it must be small."""

DISORDER = 0.5
"""Random displacement of disordered blood before it settles [spacings]: after a tenth particles
find their lattice again."""

RESISTING = "particles under pressure resist shear (docs/physics.md)"
"""Why sheared blood is known to be more viscous than its law says."""

SLAB = 8
"""Spacings along a periodic axis on which nothing depends."""

FAR = 1e6
"""A time that no step reaches [s]: `Simulation.step(FAR)` takes the longest stable step."""

NO_WAY = 1e-12
"""Amplitude of a wall that slides [m]."""

SKIN = 0.2
"""Skin of the lists over the support radius."""


@dataclass(frozen=True)
class Liquid:
    """What a flow is made of and how finely."""

    rheology: Newtonian | Casson
    sound_speed: float
    """c [m/s]."""
    spacing: float
    """d [m]."""
    support_ratio: float = 2.0
    wall_spacing_ratio: float = 1.0
    background_pressure: float = 0.0
    """[Pa], for flows without a free surface."""
    local_datum: bool = False
    """Whether pressure has one (`taichi_sph.fluid.local_datum`), as in a closed scene."""
    artificial_viscosity: float = 0.0
    """Monaghan's alpha [-]."""
    nested: bool = False
    courant_number: float = 0.4
    sound_damping: float = Fluid.sound_damping
    shifting: float = Fluid.shifting

    @classmethod
    def of_scene(cls, scene: Scene, sound_speed: float) -> "Liquid":
        """The blood of a scene, as it is poured at a sound speed [m/s]."""
        grid, blood = scene.discretization, scene.blood
        return cls(
            make_rheology(blood.rheology), sound_speed, grid.spacing, grid.support_ratio,
            grid.wall_spacing_ratio, artificial_viscosity=blood.artificial_viscosity,
            nested=grid.viscous_form == "nested", courant_number=grid.courant_number,
            local_datum=is_closed(scene),
        )  # fmt: skip

    @classmethod
    def closed(cls, speed: float, spacing: float) -> "Liquid":
        """Newtonian blood at a closed scene's sound speed and pressure, of its largest speed [m/s].

        `spacing` is d [m].
        """
        return cls(
            Newtonian(VISCOSITY), MACH * speed, spacing,
            background_pressure=LEAST_PRESSURE * DENSITY * speed**2, local_datum=True,
        )  # fmt: skip

    @property
    def kernel(self) -> WendlandC2:
        """The kernel of its support radius."""
        return WendlandC2(self.support_ratio * self.spacing)

    @property
    def wall_spacing(self) -> float:
        """Spacing of the proxies [m]."""
        return self.wall_spacing_ratio * self.spacing

    def fluid(self) -> Fluid:
        """The constants of the sums."""
        return Fluid(
            kernel=self.kernel,
            equation_of_state=Tait(DENSITY, self.sound_speed, self.background_pressure),
            rheology=self.rheology,
            calibration=calibrate(self.kernel, self.spacing, self.wall_spacing, DENSITY),
            spacing=self.spacing,
            artificial_viscosity=self.artificial_viscosity,
            nested=self.nested,
            courant_number=self.courant_number,
            sound_damping=self.sound_damping,
            shifting=self.shifting,
        )


@dataclass(frozen=True)
class State:
    """Live blood in order of identity, double precision."""

    position: np.ndarray
    """[m], shape (n, 3)."""
    velocity: np.ndarray
    """[m/s], shape (n, 3)."""
    density: np.ndarray
    """[kg/m^3], shape (n,)."""


def state_of(simulation: Simulation) -> State:
    """The state that the fields hold."""
    p = simulation.particles
    return State(*(p.in_order(f).astype(float) for f in (p.position, p.velocity, p.density)))


def make_simulation(
    liquid: Liquid,
    position: np.ndarray,
    velocity: np.ndarray | None,
    wall_position: np.ndarray,
    wall_normal: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
    period: np.ndarray,
    body_force: tuple[float, float, float] = (0.0, 0.0, 0.0),
    wall_velocity: np.ndarray | None = None,
) -> Simulation:
    """Blood and wall in a box (lower, upper) [m]; body force per mass [m/s^2].

    Proxies with a velocity [m/s], (m, 3), slide: they stay where they are.
    """
    fluid = liquid.fluid()
    kernel, skin = fluid.kernel, SKIN * fluid.kernel.support_radius
    reach = kernel.support_radius + skin
    wall = Wall.from_numpy(
        wall_position,
        wall_normal,
        kernel,
        fluid.calibration.setback,
        liquid.wall_spacing,
        period if period.any() else None,
        # What moves has a velocity; so little moves nothing.
        amplitude=None if wall_velocity is None else np.full(len(wall_position), NO_WAY),
    )
    neighbors = Neighbors.allocate(
        make_grid(*box, reach, period),
        kernel.support_radius,
        skin,
        len(position),
        liquid.spacing,
        wall,
    )
    more = (LOCAL_DATUM,) if liquid.local_datum else ()
    particles = Particles.from_numpy(position, velocity, DENSITY * liquid.spacing**3, more=more)
    share = LOCAL_SHARE if liquid.local_datum else 0.0
    blood = BloodFlow(particles, wall, neighbors, body_force, local_share=share)
    if wall_velocity is not None:
        rows = cKDTree(wall_position).query(wall.position.to_numpy()[: wall.count])[1]
        wall.velocity.from_numpy(wall_velocity[rows].astype(float_dtype()))
    return Simulation(
        blood,
        SphAcceleration(fluid, len(position)),
        speed_limit=liquid.sound_speed,
    )


def lattice(counts: tuple[int, int, int], spacing: float) -> np.ndarray:
    """Cell centres of a cubic lattice that starts at the origin [m], shape (n, 3)."""
    axes = [(np.arange(n) + 0.5) * spacing for n in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


NO_WALL = np.zeros((0, 3))


def box(
    liquid: Liquid,
    counts: tuple[int, int, int],
    velocity: Callable[[np.ndarray], np.ndarray],
    jitter: float = 0.0,
    seed: int = 0,
) -> Simulation:
    """A periodic box of blood with a velocity that depends on position.

    Args:
        liquid: the blood.
        counts: particles along each axis.
        velocity: velocity [m/s] at positions (n, 3) [m].
        jitter: random displacement, normal [spacings]; the particles then settle at rest first.
        seed: of the displacement.
    """
    x = lattice(counts, liquid.spacing)
    size = np.asarray(counts) * liquid.spacing
    if jitter:
        noise = np.random.default_rng(seed).normal(size=x.shape)
        x = (x + jitter * liquid.spacing * noise) % size
    simulation = periodic(liquid, x, size)
    if jitter:
        settle(simulation)
    set_velocity(simulation, velocity)
    return simulation


def periodic(liquid: Liquid, position: np.ndarray, size: np.ndarray) -> Simulation:
    """Blood at rest at positions [m], (n, 3), in a periodic box of a size [m], (3,)."""
    return make_simulation(liquid, position, None, NO_WALL, NO_WALL, (0.0 * size, size), size)


def rings(radius: float, spacing: float, length: float) -> np.ndarray:
    """Concentric rings that fill a tube about z; the outermost d/2 inside it [m], (n, 3)."""
    layers = round(length / spacing)
    count = round(radius / spacing)
    points = []
    for ring in range(count):
        r = (ring + 0.5) * radius / count
        m = max(1, round(2.0 * math.pi * r / spacing))
        for layer in range(layers):
            # Every ring and every other layer turned, so that columns of particles do not line up.
            angle = 2.0 * math.pi * (np.arange(m) + 0.5 * (layer % 2) + 0.37 * ring) / m
            height = np.full(m, (layer + 0.5) * length / layers)
            points.append(np.column_stack([r * np.cos(angle), r * np.sin(angle), height]))
    return np.concatenate(points)


def scattered(
    radius: float, spacing: float, length: float, count: int, seed: int = 0
) -> np.ndarray:
    """A cubic lattice cut by a tube about z, with `count` points in all [m], shape (n, 3).

    The gaps that the cut leaves at the wall are filled at random: no order is left there.
    """
    layers, half = round(length / spacing), math.ceil(radius / spacing)
    x = lattice((2 * half, 2 * half, layers), spacing) - [half * spacing, half * spacing, 0.0]
    x = x[np.hypot(x[:, 0], x[:, 1]) <= radius - 0.5 * spacing * (1.0 - 1e-9)]
    generator = np.random.default_rng(seed)
    missing = max(0, count - len(x))
    # Uniform over the ring between the lattice's edge and the wall.
    r = np.sqrt(generator.uniform((radius - 1.5 * spacing) ** 2,
                                  (radius - 0.5 * spacing) ** 2, missing))  # fmt: skip
    angle = generator.uniform(0.0, 2.0 * math.pi, missing)
    height = generator.uniform(0.0, length, missing)
    return np.concatenate([x, np.column_stack([r * np.cos(angle), r * np.sin(angle), height])])


def tube_wall(
    radius: float, spacing: float, bottom: float, top: float, periodic: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Proxies on a cylinder about z and their normals, every other row turned."""
    around = round(2.0 * math.pi * radius / spacing)
    rows = round((top - bottom) / spacing)
    rows += rows % 2 if periodic else 0
    height = bottom + (np.arange(rows) + 0.5) * (top - bottom) / rows
    angle = 2.0 * math.pi * np.arange(around) / around
    angle, height = np.meshgrid(angle, height, indexing="ij")
    angle = (angle + (np.arange(rows) % 2) * math.pi / around).ravel()
    normal = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    return radius * normal + np.column_stack([0.0 * normal[:, :2], height.ravel()]), normal


def tube(
    liquid: Liquid, radius: float, drive: float, ordered: bool = True, layers: int = SLAB
) -> Simulation:
    """A periodic tube full of blood at rest, about to be driven along z by rho g = `drive` [Pa/m].

    One particle for every d^3 of the tube, which gives the density sum rho_0 on a lattice.  The
    particles settle first, for no arrangement fits a circle.
    """
    d = liquid.spacing
    length = layers * d
    count = round(math.pi * radius**2 * layers / d**2)
    x = rings(radius, d, length) if ordered else scattered(radius, d, length, count)
    setback = liquid.fluid().calibration.setback
    surface, normal = tube_wall(radius, liquid.wall_spacing, 0.0, length, True)
    wall = surface + setback * normal
    edge = radius + setback + liquid.kernel.support_radius
    simulation = make_simulation(
        liquid, x, None, wall, normal,
        (np.array([-edge, -edge, 0.0]), np.array([edge, edge, length])),
        np.array([0.0, 0.0, length]),
        (0.0, 0.0, drive / DENSITY),
    )  # fmt: skip
    settle(simulation)
    return simulation


def plane_proxies(width: float, depth: float, spacing: float) -> np.ndarray:
    """Points over a periodic rectangle at z = 0, nine to eight spacings [m], shape (n, 3).

    A particle then stands above the proxies in as many ways as the calibration averages over.
    """
    nx, ny = (round(9.0 / 8.0 * side / spacing) for side in (width, depth))
    x, y = np.meshgrid((np.arange(nx) + 0.5) * width / nx, (np.arange(ny) + 0.5) * depth / ny)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def matched(liquid: Liquid) -> Liquid:
    """The liquid with the wall spacing that `plane_proxies` has."""
    return replace(liquid, wall_spacing_ratio=8.0 / 9.0)


def column(liquid: Liquid, layers: int, gravity: float) -> Simulation:
    """A column on a floor at z = 0, periodic to the sides, `layers` spacings high, at rest."""
    liquid = matched(liquid)
    d, side = liquid.spacing, SLAB * liquid.spacing
    floor = plane_proxies(side, side, d)
    floor[:, 2] = -liquid.fluid().calibration.setback
    reach = 2.0 * liquid.kernel.support_radius
    return make_simulation(
        liquid, lattice((SLAB, SLAB, layers), d), None,
        floor, np.tile([0.0, 0.0, -1.0], (len(floor), 1)),
        (np.array([0.0, 0.0, -reach]), np.array([side, side, layers * d + reach])),
        np.array([side, side, 0.0]), (0.0, 0.0, -gravity),
    )  # fmt: skip


def channel(liquid: Liquid, across: int, drive: float) -> Simulation:
    """Blood between plates at z = 0 and z = across d, driven along x by `drive` [Pa/m]."""
    liquid = matched(liquid)
    d, side = liquid.spacing, SLAB * liquid.spacing
    setback = liquid.fluid().calibration.setback
    plate = plane_proxies(side, side, d)
    wall = np.concatenate([plate - [0.0, 0.0, setback], plate + [0.0, 0.0, across * d + setback]])
    normal = np.repeat([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], len(plate), axis=0)
    reach = 2.0 * liquid.kernel.support_radius
    return make_simulation(
        liquid, lattice((SLAB, SLAB, across), d), None, wall, normal,
        (np.array([0.0, 0.0, -reach]), np.array([side, side, across * d + reach])),
        np.array([side, side, 0.0]), (drive / DENSITY, 0.0, 0.0),
    )  # fmt: skip


def dam(liquid: Liquid, across: int, run: float, gravity: float) -> Simulation:
    """A column `across` spacings wide and twice as high against a wall at x = 0, free to fall.

    The floor reaches `run` column widths; the flow is plane, periodic along y.
    """
    liquid = matched(liquid)
    d, side = liquid.spacing, SLAB * liquid.spacing
    width = across * d
    setback = liquid.fluid().calibration.setback
    ratio = liquid.wall_spacing_ratio
    floor = plane_proxies(round(run * across / SLAB) * side, side, d)
    floor = np.concatenate([floor[floor[:, 0] < d] - [d, 0.0, 0.0], floor])
    floor[:, 2] = -setback
    heights = ratio * d * (np.arange(round(2.5 * across / ratio)) + 0.5)
    y = np.unique(floor[:, 1])
    back = np.stack(np.meshgrid([-setback], y, heights, indexing="ij"), -1).reshape(-1, 3)
    normal = np.concatenate(
        [np.tile([0.0, 0.0, -1.0], (len(floor), 1)), np.tile([-1.0, 0.0, 0.0], (len(back), 1))]
    )
    reach = 2.0 * liquid.kernel.support_radius
    return make_simulation(
        liquid, lattice((across, SLAB, 2 * across), d), None, np.concatenate([floor, back]), normal,
        (np.array([-reach, 0.0, -reach]), np.array([run * width, side, 2.5 * width])),
        np.array([0.0, side, 0.0]), (0.0, 0.0, -gravity),
    )  # fmt: skip


def settle(simulation: Simulation, steps: int = 500) -> None:
    """Let particles find their places without a body force, then put the clock back to zero.

    Velocities are set to zero at every step at first (overlaps push hard), then at every fifth.
    """
    blood = simulation.blood
    force, limit, share = simulation.gravity, simulation.speed_limit, blood.local_share
    simulation.gravity, simulation.speed_limit, blood.local_share = (0.0, 0.0, 0.0), math.inf, 0.0
    for k in range(steps):
        simulation.step(FAR)
        if k < steps // 5 or k % 5 == 4:
            simulation.particles.velocity.fill(0.0)
    simulation.particles.velocity.fill(0.0)
    simulation.gravity, simulation.speed_limit, blood.local_share = force, limit, share
    simulation.time, simulation.steps, simulation.wall_corrections = 0.0, 0, 0


def set_velocity(simulation: Simulation, velocity: Callable[[np.ndarray], np.ndarray]) -> None:
    """Give every particle the velocity of its place."""
    p = simulation.particles
    rows = np.zeros(p.velocity.shape + (3,))
    live = p.count[None]
    rows[:live] = velocity(p.position.to_numpy()[:live].astype(float))
    p.velocity.from_numpy(rows)
