"""PageScene: what the page shows of vessel, blood, tool and wounds, and the handles there."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import igl
import numpy as np

from app.view.appearance import (
    BACKGROUND,
    FIELD_OF_VIEW,
    SPEED_COLOURS,
    TOOL_COLOUR,
    WALL_COLOUR,
    WOUND_COLOUR,
    colouring,
    eye,
    upward,
)
from taichi_sph.geometry.mesh import Floats, Integers

if TYPE_CHECKING:
    from app.control.session import Session, ViewFrame
    from taichi_sph.boundary.wounds import Wound

_MILLIMETRES = 1e3


def first_hit(start: Floats, way: Floats, vertices: Floats, faces: Integers) -> Floats | None:
    """Where a ray first meets a surface [m], (3,); none where it does not."""
    # In millimetres: triangles of some 1e-6 (in whatever unit) are nothing to libigl.  All hits:
    # where there is none, libigl 2.6 gives rubbish as the first one.
    scaled = (_MILLIMETRES * values for values in (start, way, vertices))
    hits = igl.ray_mesh_intersect(*scaled, faces, first=False)
    distances = [hit[1] for hit in hits if np.isfinite(hit[1]) and hit[1] > 0.0]
    return np.asarray(start + min(distances) * way) if distances else None


def nearest_place(point: Floats, vertices: Floats, faces: Integers) -> Floats:
    """The place of a surface that is nearest to a point [m], (3,)."""
    points = np.array([point])
    # In millimetres, as above.
    *_, places = igl.point_mesh_squared_distance(
        _MILLIMETRES * points, _MILLIMETRES * vertices, faces
    )
    return np.asarray(places[0] / _MILLIMETRES)


class PageScene:
    """The three-dimensional part of the page."""

    def __init__(self, server: Any, session: "Session"):
        """Put everything where it is at the start."""
        self._scene, simulation = server.scene, session.simulation
        self._simulation = simulation
        self._tool = simulation.tool
        self._spacing = simulation.scene.discretization.spacing
        self.colouring = colouring("speed", simulation)
        """What the colour of blood means."""
        self._wounds: dict[int, Wound] = {}
        self._rims: list[Any] = []
        self.on_wounds: Callable[[list[int]], None] = lambda numbers: None
        """Called with the numbers of the open wounds when they change."""

        vessel, up = simulation.vessel, upward(simulation.scene.gravity)
        vertices = np.asarray(vessel.vertices, float)
        size = float(np.ptp(vertices, axis=0).max())
        position, target = eye(vertices, up)
        self._add_light_and_camera(server.initial_camera, up, position, target, size)
        right = np.cross(up, position - target)
        self.right = right / np.linalg.norm(right)
        """Unit vector to the right of who looks."""
        self.back = np.cross(self.right, up)
        """Unit vector, level, towards who looks."""
        faces = self._add_vessel(vertices)
        self._blood, self._droplets = (
            self._scene.add_point_cloud(
                name, np.zeros((0, 3)), colour, point_size=self._spacing, point_shape="circle",
                precision="float32",
            )
            for name, colour in (("/blood", SPEED_COLOURS[0]), ("/drops", SPEED_COLOURS[2]))
        )  # fmt: skip
        self._add_tool(0.15 * size)
        self._wall = vertices, np.asarray(vessel.faces[vessel.face_opening < 0], np.int64)
        near = first_hit(position, target - position, vertices, faces)
        self._add_wound_marker(0.08 * size, target if near is None else near, faces)

    def _add_light_and_camera(
        self, camera: Any, up: Floats, position: Floats, target: Floats, size: float
    ) -> None:
        self._scene.set_up_direction(up)
        # Shadows and reflections cost a weak machine most of its frames.
        self._scene.configure_default_lights(cast_shadow=False)
        self._scene.configure_environment_map(None)
        self._scene.set_background_image(np.full((2, 2, 3), BACKGROUND, np.uint8), format="png")
        camera.position, camera.look_at, camera.up = position, target, up
        camera.fov, camera.near, camera.far = FIELD_OF_VIEW, 0.01 * size, 100.0 * size

    def _add_vessel(self, vertices: Floats) -> Integers:
        """Show the wall, open where blood may pass, and name the openings; the faces shown."""
        vessel = self._simulation.vessel
        is_open = np.array([opening.is_open for opening in vessel.openings] + [False])
        faces = np.asarray(vessel.faces[~is_open[vessel.face_opening]], np.int64)
        self._scene.add_mesh_simple(
            "/vessel", vertices, faces, color=WALL_COLOUR[:3], opacity=1.5 * WALL_COLOUR[3] / 255.0,
            side="double",
        )  # fmt: skip
        for opening in vessel.openings:
            at = opening.centre + 0.4 * opening.radius * opening.normal
            self._scene.add_label(
                f"/openings/{opening.name}", opening.name, position=at, anchor="center-center"
            )
        return faces

    def _add_tool(self, length: float) -> None:
        surface, style = self._tool.surface, {"color": TOOL_COLOUR[:3]}
        self._body = (
            self._scene.add_icosphere("/tool", radius=self._spacing, **style)
            if surface is None
            else self._scene.add_mesh_simple("/tool", surface.vertices, surface.faces, **style)
        )
        self.tool_handle = self._add_handle(
            "/grip", length, self._tool.target_position, turns=surface is not None
        )
        """What the tool is dragged by."""

    def _add_wound_marker(self, length: float, place: Floats, faces: Integers) -> None:
        vertices = self._wall[0]
        self.wound_marker = self._add_handle("/mark", length, place)
        """Where a wound will be."""
        self.put_marker_on_wall()
        self._scene.add_icosphere("/mark/spot", radius=0.8 * self._spacing, color=WOUND_COLOUR[:3])

        # Not the vessel's own clicks: those it would take from the handles behind it.
        @self._scene.on_click()
        async def _(event: Any) -> None:
            start, way = np.array(event.ray_origin), np.array(event.ray_direction)
            place = first_hit(start, way, vertices, faces)
            if place is not None:
                self.wound_marker.position = place

        @self.wound_marker.on_update
        async def _(event: Any) -> None:
            if event.phase == "end":
                self.put_marker_on_wall()

    def _add_handle(self, name: str, length: float, place: Floats, turns: bool = False) -> Any:
        return self._scene.add_transform_controls(
            name, length, position=place, disable_rotations=not turns, disable_sliders=True,
            depth_test=False,
        )  # fmt: skip

    def put_marker_on_wall(self) -> None:
        """Bring the wound marker to the nearest place of the wall, wherever it is."""
        at = np.asarray(self.wound_marker.position, float)
        if len(self._wall[1]) and np.isfinite(at).all():
            self.wound_marker.position = nearest_place(at, *self._wall)

    def follow_tool(self) -> None:
        """Bring the handle to where the tool is wanted: a script or a channel may have moved it."""
        wanted = self._tool.target_position
        if not np.array_equal(self.tool_handle.position, wanted):
            self.tool_handle.position = wanted
        if self._tool.surface is not None:
            turn = np.roll(self._tool.target_rotation.as_quat(), 1)
            # A rotation and its negative are the same.
            if abs(float(np.dot(self.tool_handle.wxyz, turn))) < 1.0 - 1e-9:
                self.tool_handle.wxyz = turn

    def show_blood(self, frame: "ViewFrame") -> None:
        """Show another frame."""
        colours = self.colouring.colours(frame.velocities, frame.age, frame.dye)
        self._blood.points, self._blood.colors = frame.positions, colours
        if len(frame.droplets) or len(self._droplets.points):
            self._droplets.points = frame.droplets

    def show_tool_and_wounds(self) -> None:
        """Show the tool where it is, and the rims and numbers of open wounds."""
        self._body.position = self._tool.position
        self._body.wxyz = np.roll(self._tool.rotation.as_quat(), 1)
        wounds = {k: w for k, w in enumerate(self._simulation.wounds) if w.is_open}
        if list(map(id, wounds.values())) == list(map(id, self._wounds.values())):
            return
        self._wounds = wounds
        while self._rims:
            self._rims.pop().remove()
        for k, wound in wounds.items():
            rim = wound.rim()
            lines = np.stack([rim[:-1], rim[1:]], axis=1)
            self._rims += [
                self._scene.add_line_segments(
                    f"/wounds/{k}", lines, WOUND_COLOUR[:3], thickness=0.3 * self._spacing
                ),
                self._scene.add_label(f"/numbers/{k}", str(k), position=wound.begin),
            ]
        self.on_wounds(list(wounds))
