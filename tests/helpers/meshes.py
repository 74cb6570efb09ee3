"""Small meshes and scenes for the tests of surfaces."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from app.scenes.centreline import Tube, make_surface
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Floats, Integers
from taichi_sph.geometry.vessel import Vessel, build_vessel
from taichi_sph.scene import OpeningTable, Scene, parse_scene

RADIUS, LENGTH = 5e-3, 30e-3
TOP, BOTTOM = (0.0, 0.0, 0.5 * LENGTH), (0.0, 0.0, -0.5 * LENGTH)


def cylinder(capped: bool = True, segments: int = 48) -> tuple[Floats, Integers]:
    """Tube of radius 5 mm and length 30 mm along z, in metres."""
    vertices, faces = make_surface(
        Tube(name="tube", radius=RADIUS * 1e3, length=LENGTH * 1e3, segments=segments)
    )
    if not capped:
        flat = np.ptp(vertices[faces][:, :, 2], axis=1) < 1e-9
        vertices, faces = mesh.drop_unused(vertices, faces[~flat])
    return vertices, faces


def bent(turn: float = np.pi) -> tuple[Floats, Integers]:
    """The tube bent round the y axis; its ends stay flat."""
    vertices, faces = cylinder()
    middle = LENGTH * 1.5 / turn
    angle = vertices[:, 2] / LENGTH * turn
    distance = middle + vertices[:, 0]
    vertices = np.stack(
        [distance * np.sin(angle), vertices[:, 1], -distance * np.cos(angle)], axis=1
    )
    # sin, -cos: both ends of half a turn look up, the bend hangs below; x and z keep handedness.
    return vertices, faces if mesh.enclosed_volume(vertices, faces) > 0 else faces[:, ::-1]


def tables(scale: float = 1.0, **states: str) -> dict[str, OpeningTable]:
    """Openings top and bottom of the cylinder."""
    states = {"top": "open", "bottom": "open"} | states
    places = {"top": TOP, "bottom": BOTTOM}
    return {
        name: OpeningTable(
            centre=tuple(value / scale for value in places[name]),  # type: ignore[arg-type]
            state="open" if state == "open" else "capped",
        )
        for name, state in states.items()
    }


def pipe(**states: str) -> Vessel:
    """The cylinder as a vessel."""
    return build_vessel(*cylinder(), tables(1.0, **states), 1.0, "tube.ply")


def write_scene(
    folder: Path,
    lumen: tuple[Floats, Integers] | bytes | None,
    openings: Mapping[str, tuple[float, float, float]] | None = None,
    column: str = 'opening = "top"\nheight = 0.01',
    spacing: float = 1e-3,
    scale: float = 1.0,
) -> Scene:
    """A scene beside its surface file."""
    path = folder / "lumen.ply"
    if isinstance(lumen, bytes):
        path.write_bytes(lumen)
    elif lumen is not None:
        mesh.write_ply(path, *lumen)
    places = {"top": TOP, "bottom": BOTTOM} if openings is None else openings
    text = "\n".join(
        [
            'title = "test"',
            "duration = 0.1",
            "frame_interval = 0.01",
            "gravity = [0.0, 0.0, -9.81]",
            f'[vessel]\nsurface = "lumen.ply"\nscale = {scale}',
            *(f"[openings.{name}]\ncentre = {list(place)}" for name, place in places.items()),
            f"[column]\n{column}",
            f"[discretization]\nspacing = {spacing}",
        ]
    )
    return parse_scene(text, "scene.toml", folder, "test")
