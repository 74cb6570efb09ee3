"""Blood round a tool, a ball, in the round vessel."""

from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from builders import (
    CAPACITY,
    KERNEL,
    SKIN,
    SPHERE,
    WALL_SPACING,
    D,
    R,
    Setup,
    ball,
    calibration,
    sphere,
)
from taichi_sph.boundary.tool import Tool
from taichi_sph.boundary.tool_surface import ToolSurface, read_tool_surface
from taichi_sph.particles.grid import make_grid
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.wall import Wall
from taichi_sph.scene import ToolTable

ROUNDING = {"f64": 1e-12, "f32": 1e-5}
"""Pairs this near to the radius, relatively, may be told either way."""
FACET = 0.02
"""Of the radius: triangles of a sphere of 642 corners lie below it by a hundredth."""


BALL = 2.0 * D
"""Radius of the tool, a ball whose lowest point is its origin [m]."""
AT = np.array([0.6, -0.5, -1.7]) * D
TURN = Rotation.from_rotvec([0.5, -0.8, 0.3])


def globe() -> trimesh.Trimesh:
    """The ball's surface [m], its origin the lowest point."""
    surface = trimesh.creation.icosphere(subdivisions=3, radius=BALL)
    surface.apply_translation([0.0, 0.0, BALL])
    return surface


def sample_surface(folder: Path, surface: trimesh.Trimesh, scale: float = 1.0) -> ToolSurface:
    surface.export(folder / "tool.ply")
    table = ToolTable(surface="tool.ply", position=(0.0, 0.0, 0.0), scale=scale)
    return read_tool_surface(table, folder, WALL_SPACING, calibration().setback, KERNEL)


@cache
def _stage(count: int) -> Setup:
    """The round vessel once more, with room for the proxies of a tool."""
    vessel, edge = sphere(), 9.1 * D
    y, n = vessel.wall_position, vessel.wall_normal
    wall = Wall.from_numpy(y, n, KERNEL, calibration().setback, WALL_SPACING, tool=count)
    grid = make_grid(np.full(3, -edge), np.full(3, edge), R + SKIN)
    neighbors = Neighbors.allocate(grid, R, SKIN, CAPACITY, D, wall)
    neighbors.sort_wall(wall)
    return Setup(vessel.particles, wall, neighbors, y, n)


def tool_stage(surface: ToolSurface) -> Setup:
    """Blood round the ball in the round vessel, the ball in the middle and at rest."""
    stage = _stage(len(surface.position))
    stage.wall.velocity.fill(0.0)
    hold(stage, surface)
    generator = np.random.default_rng(0)
    x = ball(generator, SPHERE - 0.2 * D)
    x = x[np.linalg.norm(x - middle(AT), axis=1) > BALL + 0.2 * D]
    stage.put(x, np.roll(50.0 * x, 1, axis=1) + 0.03 * generator.normal(size=x.shape))
    return stage


def middle(at: np.ndarray, turn: Rotation = TURN) -> np.ndarray:
    """Centre of the ball at a place [m], (3,)."""
    return at + turn.apply([0.0, 0.0, BALL])


def hold(stage: Setup, surface: ToolSurface, at: np.ndarray = AT, turn: Rotation = TURN,
         velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
         spin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tool:  # fmt: skip
    """Put the tool somewhere, in motion."""
    tool = Tool(stage.blood(), surface, at)
    tool.rotation = turn
    tool.velocity, tool.spin = np.array(velocity), np.array(spin)
    tool.write_proxies()
    return tool


def proxies(stage: Setup, field: str = "position") -> np.ndarray:
    """Rows of the wall, those of the tool last."""
    return getattr(stage.wall, field).to_numpy().astype(float)
