"""Stages: the few sets of Taichi fields that the tests of the core share.

Taichi frees no field and compiles every kernel anew for new fields or constants (seconds), so
tests put their own particles on one of three stages instead of allocating.
"""

import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import taichi as ti
from scipy.spatial import cKDTree

from reference import Blood
from taichi_sph.boundary.boundary import BloodFlow, Boundary
from taichi_sph.fluid.calibration import Calibration, calibrate
from taichi_sph.fluid.equation_of_state import Tait
from taichi_sph.fluid.model import Fluid
from taichi_sph.fluid.rheology import Newtonian
from taichi_sph.fluid.wcsph import SphAcceleration
from taichi_sph.particles.grid import make_grid
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.smoothing_kernel import WendlandC2
from taichi_sph.particles.wall import Proxies, Wall, proxy_volumes, wall_curvature
from taichi_sph.simulation import Simulation

D = 1e-3
"""Spacing of blood [m]."""
R = 2.0 * D
"""Support radius [m]."""
SKIN = 0.2 * R
WALL_SPACING = 8.0 / 9.0 * D
"""Nine proxies to eight particles: over a periodic layer a particle stands above the proxies in
the eight evenly spread ways that the calibration averages over."""
BOX = 8.0 * D
"""Period of the periodic stages [m]."""
DENSITY = 1060.0
CAPACITY = 640
SPHERE = 5.0 * D
"""Radius of the round vessel's lumen [m]."""
SEPTUM = (14.0 * D, 14.5 * D)
"""Heights of the septum's two faces above the plane wall [m]."""

KERNEL = WendlandC2(R)


@cache
def calibration() -> Calibration:
    """The factors that every stage uses."""
    return calibrate(KERNEL, D, WALL_SPACING, DENSITY)


def precision() -> str:
    """The precision that this session runs in: f64 or f32."""
    return "f64" if ti.lang.impl.get_runtime().default_fp == ti.f64 else "f32"


def float_dtype() -> np.dtype:
    """The numpy type of this session's precision."""
    return np.dtype("f8" if precision() == "f64" else "f4")


def make_fluid(
    sound_speed: float = 1.0,
    background: float = 0.0,
    rheology: Any = None,
    alpha: float = 0.0,
    nested: bool = False,
    damping: float = 0.0,
    thin: float = 0.0,
) -> Fluid:
    """A fluid of the stages; without a rheology its viscosity is zero."""
    return Fluid(
        KERNEL,
        Tait(DENSITY, sound_speed, background),
        rheology or Newtonian(0.0),
        calibration(),
        spacing=D,
        artificial_viscosity=alpha,
        nested=nested,
        sound_damping=damping,
        thin_viscosity=thin,
    )


@cache
def make_model(fluid: Fluid) -> SphAcceleration:
    """One model for equal fluids: its scratch is compiled into the kernels."""
    return SphAcceleration(fluid, CAPACITY)


@dataclass
class Prescribed:
    """An acceleration model that a test sets: a = law(positions), steps of one length."""

    law: Callable[[np.ndarray], np.ndarray]
    step: float
    shifting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of every particle [m/s]."""
    name: str = "prescribed"
    used_fallback: bool = False
    pair_coefficients: None = None
    sound_speed: float = 1.0
    largest_viscosity: float = math.inf

    def accelerate(self, particles, wall, neighbors, gravity) -> None:
        """Write the law's acceleration and the rest density."""
        live = particles.count[None]
        acceleration = np.zeros((CAPACITY, 3), float_dtype())
        acceleration[:live] = self.law(particles.position.to_numpy()[:live].astype(float))
        particles.acceleration.from_numpy(acceleration)
        particles.density.fill(DENSITY)
        particles.shifting.fill(self.shifting)

    def stable_step(self, largest_speed: float, largest_acceleration: float) -> float:
        """The step that the test chose [s]."""
        return self.step


@dataclass
class Setup:
    """Particles, a wall and lists, with the wall's own arrays to put it back."""

    particles: Particles
    wall: Wall
    neighbors: Neighbors
    wall_position: np.ndarray
    wall_normal: np.ndarray

    @property
    def period(self) -> np.ndarray:
        """Period of each axis [m], zero where there is none."""
        return np.array(self.neighbors.grid.period)

    def put(
        self,
        position: np.ndarray,
        velocity: np.ndarray | None = None,
        identity: np.ndarray | None = None,
    ) -> None:
        """Replace the blood; row k gets identity k unless told otherwise."""
        n = len(position)
        self.particles.replace(
            {
                "identity": np.arange(n) if identity is None else identity,
                "position": position,
                "velocity": np.zeros((n, 3)) if velocity is None else velocity,
            }
        )

    def put_wall(self, position: np.ndarray, normal: np.ndarray) -> None:
        """Replace the proxies (as many) and sort them."""
        volume = proxy_volumes(position, KERNEL, self.period)
        curvature = wall_curvature(position, normal, KERNEL, self.wall.setback, self.period)
        still = np.zeros(len(position))
        self.wall.given = Proxies(position, normal, volume, still, volume, curvature)
        self.neighbors.sort_wall(self.wall)

    def build(self) -> None:
        """Sort the blood and build the lists."""
        self.neighbors.build(self.particles, self.wall)

    def accelerate(self, fluid: Fluid, gravity=(0.0, 0.0, 0.0)) -> np.ndarray:
        """Build the lists and return the accelerations in order of identity [m/s^2]."""
        self.build()
        make_model(fluid).accelerate(self.particles, self.wall, self.neighbors, gravity)
        return self.in_order(self.particles.acceleration)

    def in_order(self, field: ti.Field) -> np.ndarray:
        """Live rows of a field in order of identity, double precision."""
        return self.particles.in_order(field).astype(float)

    def blood(self, gravity=(0.0, 0.0, 0.0)) -> BloodFlow:
        """What boundaries act upon."""
        return BloodFlow(self.particles, self.wall, self.neighbors, gravity)

    def simulation(
        self, model, gravity=(0.0, 0.0, 0.0), speed_limit=1e9, integrator="symplectic",
        boundaries: tuple[Boundary, ...] = (),
    ) -> Simulation:  # fmt: skip
        """A simulation of what is on the stage."""
        return Simulation(
            self.blood(gravity), model, boundaries, speed_limit=speed_limit, integrator=integrator
        )

    def reference(self, fluid: Fluid) -> Blood:
        """The state as it is in the fields (rounded, if f32), for brute force."""
        rheology, c = fluid.rheology, fluid.calibration
        return Blood(
            x=self.in_order(self.particles.position),
            v=self.in_order(self.particles.velocity),
            y=self.wall.position.to_numpy()[: self.wall.count],
            spacing=D,
            support=R,
            rest_density=DENSITY,
            sound_speed=fluid.equation_of_state.sound_speed,
            background=fluid.equation_of_state.background_pressure,
            alpha=fluid.artificial_viscosity,
            damping=fluid.sound_damping,
            thin=fluid.thin_viscosity,
            eta=rheology.eta,
            tau_y=getattr(rheology, "tau_y", 0.0),
            n=getattr(rheology, "n", 0.0),
            factors=vars(c),
            period=self.period,
            curvature=self.curvature(),
        )

    def curvature(self) -> np.ndarray:
        """Of the wall at each proxy, in the order of the grid, times h_s."""
        given, m = self.wall.given, self.wall.count
        if m == 0:
            return np.zeros(0)
        rows = cKDTree(given.position).query(self.wall.position.to_numpy()[:m])[1]
        return given.curvature[rows]


@cache
def _particles() -> Particles:
    return Particles(CAPACITY, calibration().mass)


def _stage(lower, upper, period, reach, position, normal) -> Setup:
    """A stage on the shared particles."""
    wall = Wall.from_numpy(position, normal, KERNEL, calibration().setback, WALL_SPACING, period)
    neighbors = Neighbors.allocate(
        make_grid(np.array(lower), np.array(upper), R + SKIN, np.array(period), reach),
        R, SKIN, CAPACITY, D, wall,
    )  # fmt: skip
    neighbors.sort_wall(wall)
    return Setup(_particles(), wall, neighbors, position, normal)


@cache
def periodic() -> Setup:
    """A cube that repeats along every axis, no wall, cells as wide as the lists reach."""
    return _stage(
        (0, 0, 0), (BOX, BOX, BOX), (BOX, BOX, BOX), (1, 1, 1), np.zeros((0, 3)), np.zeros((0, 3))
    )


@cache
def plane() -> Setup:
    """A plane wall at z = 0 with blood above it, and a septum far above; x and y repeat."""
    axis = np.arange(9) * WALL_SPACING
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    setback = calibration().setback
    position, normal = [], []
    for height, up in ((0.0, -1.0), (SEPTUM[0], 1.0), (SEPTUM[1], -1.0)):
        position.append(np.column_stack([grid, np.full(len(grid), height + up * setback)]))
        normal.append(np.tile([0.0, 0.0, up], (len(grid), 1)))
    return _stage(
        (0, 0, -2 * R), (BOX, BOX, 20 * D), (BOX, BOX, 0.0), (2, 2, 2),
        np.concatenate(position), np.concatenate(normal),
    )  # fmt: skip


@cache
def sphere() -> Setup:
    """A round vessel about the origin, in a box without periods."""
    radius = SPHERE + calibration().setback
    m = round(4 * np.pi * radius**2 / WALL_SPACING**2)
    k = np.arange(m) + 0.5
    polar, turn = np.arccos(1 - 2 * k / m), np.pi * (1 + 5**0.5) * k
    normal = np.column_stack(
        [np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)]
    )
    edge = 9.1 * D
    return _stage((-edge,) * 3, (edge,) * 3, (0.0,) * 3, (1, 1, 2), radius * normal, normal)


def cubic_lattice(*counts: int) -> np.ndarray:
    """Centres of a cubic lattice of spacing D from the origin on, (n, 3) [m]."""
    axes = [(np.arange(n) + 0.5) * D for n in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def jittered_lattice(generator: np.random.Generator, amplitude: float = 0.3) -> np.ndarray:
    """A lattice that fills the periodic stage, each particle moved at random, (512, 3) [m]."""
    x = cubic_lattice(8, 8, 8)
    return x + amplitude * D * generator.uniform(-1, 1, x.shape)


def ball(generator: np.random.Generator, radius: float, amplitude: float = 0.3) -> np.ndarray:
    """Jittered lattice within a radius of the origin, (n, 3) [m]."""
    x = cubic_lattice(12, 12, 12) - 6.0 * D
    x = x[np.linalg.norm(x, axis=1) < radius - amplitude * D]
    return x + amplitude * D * generator.uniform(-0.577, 0.577, x.shape)


def vesselflow(*arguments: object) -> str:
    """Standard output of the command, which must succeed."""
    command = [sys.executable, "-m", "app", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
