"""ControlPage: a page in the browser to watch and command a running session; only here is viser.

A thread of its own shows the latest frame and hands on what the controls ask for; the simulation
never waits for it, and a browser that cannot keep up misses frames.
"""

import html
import importlib.util
import logging
import queue
import re
import threading
import time
from collections.abc import Callable
from socket import socket
from typing import TYPE_CHECKING, Any

import igl
import numpy as np
from scipy.spatial.transform import Rotation

from app.control.channel import is_loopback, listen
from app.view.appearance import (
    BACKGROUND,
    COLOURS,
    FIELD_OF_VIEW,
    SPEED_COLOURS,
    TOOL_COLOUR,
    WALL_COLOUR,
    WOUND_COLOUR,
    eye,
    speed_levels,
    upward,
)
from taichi_sph.boundary.wounds import LEAST_RADIUS
from taichi_sph.errors import InputError
from taichi_sph.geometry.mesh import Floats, Integers

if TYPE_CHECKING:
    from app.control.session import Picture, Session
    from taichi_sph.boundary.wounds import Wound

_PERIOD = 0.05
"""Between two updates [s]."""
_SHARE = 0.01
"""Of a processor's time, the page's own thread spends no more than this on frames."""
_FIGURES_PERIOD = 0.2
"""Between two updates of the figures [s]: faster nobody reads."""
_SHOWN = 8.0
"""How long a refusal stays on the page [s]."""
_LARGEST_FACTOR = 2.0
"""Of the sliders for speed and inflow."""
_ACCENT = (92, 124, 158)
"""Colour of the controls: red is the blood's."""
_WIDTH = 340.0
"""Of the panel [pixels]."""
_OURS = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Pages that may command: this one, through whatever port an SSH tunnel has here."""

_MM, _ML, _ML_MIN = 1e3, 1e6, 6e7
"""To the units of the page, from SI."""

Command = dict[str, Any]

_RUN: dict[str, Command] = {
    "hold": {"command": "pause", "on": True},
    "go on": {"command": "pause", "on": False},
    "one step": {"command": "step"},
    "reset": {"command": "reset"},
}


def require_viser(option: str) -> None:
    """Refuse an option that shows a page where nothing can."""
    if importlib.util.find_spec("viser") is None:
        raise InputError(f"{option}: viser is not installed; pip install 'vesselflow[control]'")


def start_server(listener: socket) -> Any:
    """A viser server at a socket, that is quiet and that other web pages cannot command.

    Viser itself tries the ports that follow where one is taken, prints, and takes WebSockets that
    any page in the browser opens.  What it hands to `serve` is therefore seen through.

    Raises:
        InputError: this viser does not let that be done.
    """
    import rich
    import viser
    from websockets.asyncio import server as sockets

    rich.get_console().quiet = True  # all that viser prints goes there
    logger = logging.getLogger("vesselflow.page")
    logger.disabled = True
    serve = sockets.serve

    def guarded(handler: Any, host: str, port: int, **options: Any) -> Any:
        return serve(handler, sock=listener, origins=[_OURS, None], logger=logger, **options)

    port = listener.getsockname()[1]
    sockets.serve = guarded  # type: ignore[assignment,misc]
    try:
        server = viser.ViserServer("127.0.0.1", port, verbose=False)
    finally:
        sockets.serve = serve  # type: ignore[misc]
    # Anyone who has the page could ask for a public address for it.
    server.request_share_url = lambda verbose=True: None
    if server.get_port() != port:
        server.stop()
        listener.close()
        raise InputError(
            f"page: viser {viser.__version__} cannot be used; pip install viser==1.1.1"
        )
    return server


def tilted(gravity: Floats, right: Floats, back: Floats, turns: tuple[float, float]) -> Floats:
    """Gravity [m/s^2] that pulls to the right by the first angle [deg], to the eye by the second.

    Args:
        gravity: upright [m/s^2].
        right: unit vector, to the right of who looks.
        back: unit vector, level, towards who looks.
        turns: the angles [deg].
    """
    sideways, towards = np.radians(turns)
    turn = Rotation.from_rotvec(sideways * back) * Rotation.from_rotvec(-towards * right)
    return np.asarray(turn.apply(gravity))


def first_hit(start: Floats, way: Floats, vertices: Floats, faces: Integers) -> Floats | None:
    """Where a ray first meets a surface [m], (3,); none where it does not."""
    # In millimetres: triangles of some 1e-6 (in whatever unit) are nothing to libigl.
    hits = igl.ray_mesh_intersect(_MM * start, _MM * way, _MM * vertices, faces, first=True)
    return np.asarray(start + hits[0][1] * way) if hits else None


def figures_table(figures: dict[str, Any]) -> str:
    """Figures of a session as HTML."""
    force = 1e3 * float(np.linalg.norm(figures["tool_force"]))
    rows = {
        "simulated time": f"{figures['time']:.3f} s",
        "real-time factor": "held" if figures["paused"] else f"{figures['real_time_factor']:.2f}",
        "model": html.escape(str(figures["model"])),
        "taken over by the physics": f"{100.0 * figures['guard_share']:.1f} %",
        "particles": f"{figures['particles']}",
        "flow out": f"{_ML_MIN * figures['flow_out']:.0f} ml/min",
        "bleeding": f"{_ML_MIN * figures['bleeding']:.1f} ml/min",
        "lost blood": f"{_ML * figures['lost']:.2f} ml",
        "sucked away": f"{_ML * figures['suctioned']:.2f} ml",
        "force on the tool": f"{force:.2f} mN",
    }
    return (
        "<table style='width:100%;font-size:.85em;padding:.2em .9em'>"
        + "".join(
            f"<tr><td style='opacity:.75'>{name}</td><td style='text-align:right'>{value}</td></tr>"
            for name, value in rows.items()
        )
        + "</table>"
    )


def colour_bar(full_scale: float) -> str:
    """What colours mean, as HTML; `full_scale` [m/s] is brightest."""
    colours = ",".join(f"rgb{colour}" for colour in SPEED_COLOURS)
    return (
        f"<div style='margin:.4em .9em;height:.7em;background:linear-gradient(90deg,{colours})'>"
        "</div><div style='display:flex;justify-content:space-between;margin:0 .9em;"
        f"font-size:.75em;opacity:.75'><span>at rest</span><span>{full_scale:.2g} m/s and above"
        "</span></div>"
    )


class ControlPage:
    """A server on loopback that browsers connect to, come and go.

    It asks for no password, and viser cannot: from other machines it is reached through SSH.
    """

    def __init__(self, session: "Session", host: str = "127.0.0.1", port: int = 8080):
        """Show a session.

        Args:
            session: gets the commands.
            host: an address of loopback.
            port: 0 is any free one.

        Raises:
            InputError: the port is taken, the host is not loopback, or viser is not installed.
        """
        require_viser("page")
        listener = listen(host, port, "page")
        if not is_loopback(listener):
            listener.close()
            raise InputError(
                f"page {host}: the page has no password, so it is served at 127.0.0.1 only; from "
                f"another machine, `ssh -L {port}:127.0.0.1:{port} HOST` brings it there"
            )
        self.host, self.port = listener.getsockname()[:2]
        self.url = f"http://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"
        self._session = session
        self._simulation = session.simulation
        self._tool = session.simulation.tool
        self._spacing = session.simulation.scene.discretization.spacing
        self._full_scale = session.simulation.derived.expected_speed or 1.0
        self._wishes: queue.SimpleQueue[tuple[object, Command]] = queue.SimpleQueue()
        self._refusals: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._closing = threading.Event()
        self.pictures = 0
        """Shown so far."""
        self._shown: Picture | None = None
        self._wounds: dict[int, Wound] = {}
        self._rims: list[Any] = []
        self._server = start_server(listener)
        self._add_scene()
        self._add_controls()
        self._thread = threading.Thread(target=self._run, daemon=True, name="page")
        self._thread.start()

    def close(self) -> None:
        """End the server; browsers keep what they show."""
        self._closing.set()
        self._thread.join()
        self._server.stop()

    def tell(self, text: str) -> None:
        """Show a sentence to everybody, from any thread: why something was refused."""
        self._refusals.put(text)

    def _add_scene(self) -> None:
        """All that is seen."""
        scene, simulation = self._server.scene, self._simulation
        vessel, up = simulation.vessel, upward(simulation.scene.gravity)
        vertices = np.asarray(vessel.vertices, float)
        size = float(np.ptp(vertices, axis=0).max())
        scene.set_up_direction(up)
        # Shadows and reflections cost a weak machine most of its frames.
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(None)
        scene.set_background_image(np.full((2, 2, 3), BACKGROUND, np.uint8), format="png")
        camera, (position, target) = self._server.initial_camera, eye(vertices, up)
        camera.position, camera.look_at, camera.up = position, target, up
        camera.fov, camera.near, camera.far = FIELD_OF_VIEW, 0.01 * size, 100.0 * size
        self._right = np.cross(up, position - target)
        self._right /= np.linalg.norm(self._right)
        self._back = np.cross(self._right, up)

        is_open = np.array([opening.is_open for opening in vessel.openings] + [False])
        faces = np.asarray(vessel.faces[~is_open[vessel.face_opening]], np.int64)
        scene.add_mesh_simple(
            "/vessel", vertices, faces, color=WALL_COLOUR[:3], opacity=1.5 * WALL_COLOUR[3] / 255.0,
            side="double",
        )  # fmt: skip
        for opening in vessel.openings:
            at = opening.centre + 0.4 * opening.radius * opening.normal
            scene.add_label(
                f"/openings/{opening.name}", opening.name, position=at, anchor="center-center"
            )
        self._blood, self._drops = (
            scene.add_point_cloud(
                name, np.zeros((0, 3)), colour, point_size=self._spacing, point_shape="circle",
                precision="float32",
            )
            for name, colour in (("/blood", SPEED_COLOURS[0]), ("/drops", SPEED_COLOURS[2]))
        )  # fmt: skip

        shape, self._start = self._tool.surface, self._tool.position
        look = {"color": TOOL_COLOUR[:3]}
        self._body = (
            scene.add_icosphere("/tool", radius=self._spacing, **look)
            if shape is None
            else scene.add_mesh_simple("/tool", shape.vertices, shape.faces, **look)
        )
        self._grip = self._add_gizmo("/grip", 0.15 * size, self._start, turns=shape is not None)
        near = first_hit(position, target - position, vertices, faces)
        self._marker = self._add_gizmo("/mark", 0.08 * size, vertices[0] if near is None else near)
        scene.add_icosphere("/mark/spot", radius=0.8 * self._spacing, color=WOUND_COLOUR[:3])

        # Not the vessel's own clicks: those it would take from the gizmos behind it.
        @scene.on_click()
        async def _(event: Any) -> None:
            start, way = np.array(event.ray_origin), np.array(event.ray_direction)
            place = first_hit(start, way, vertices, faces)
            if place is not None:
                self._marker.position = place

    def _add_gizmo(self, name: str, length: float, place: Floats, turns: bool = False) -> Any:
        return self._server.scene.add_transform_controls(
            name, length, position=place, disable_rotations=not turns, disable_sliders=True,
            depth_test=False,
        )  # fmt: skip

    def _add_controls(self) -> None:
        """All that can be done."""
        gui, session, scene = self._server.gui, self._session, self._simulation.scene
        gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=_ACCENT
        )
        gui.set_panel_label(scene.title)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_WIDTH)
        gui.add_html(colour_bar(self._full_scale))
        self._figures = gui.add_html("")

        with gui.add_folder("Run"):
            run = gui.add_button_group("blood", tuple(_RUN))
            self._on(run, lambda: self._steer(run.value))
            speed = gui.add_slider(
                "speed limit", 0.0, _LARGEST_FACTOR, 0.05, 0.0, hint="x real time; 0: no limit"
            )
            self._on(speed, lambda: {"command": "speed", "factor": speed.value or None})
            names = (*session.models, "auto")
            model = gui.add_dropdown("model", names, initial_value=self._simulation.model.name)
            self._on(model, lambda: {"command": "model", "name": model.value})
        if any(scene.gravity):
            with gui.add_folder("Gravity"):
                right, towards = (
                    gui.add_slider(name, -180.0, 180.0, 1.0, 0.0)
                    for name in ("right [deg]", "to you [deg]")
                )
                for slider in (right, towards):
                    self._on(slider, lambda: self._tilt((right.value, towards.value)))
        if session.driven:
            with gui.add_folder("Inflow [x the scene's]"):
                for name in session.driven:
                    self._add_inflow(name)
        with gui.add_folder("Tool and suction"):
            gui.add_markdown("Drag the larger gizmo: the tool follows.")
            self._on(self._grip, self._aim)
            rate = gui.add_number("rate [ml/min]", 200.0, min=0.0, step=10.0)
            sucks = gui.add_checkbox("suction", False)
            for control in (rate, sucks):
                self._on(
                    control,
                    lambda: {"command": "suction", "rate": sucks.value * rate.value / _ML_MIN},
                )
        with gui.add_folder("Wound"):
            gui.add_markdown("Click the vessel, or drag the smaller gizmo.")
            least = round(_MM * LEAST_RADIUS * self._spacing + 0.005, 2)
            radius = gui.add_number("radius [mm]", round(1.5 * least, 1), min=least, step=0.1)
            wound = gui.add_button("Wound here", color="red")
            self._on(wound, lambda: self._wound(radius.value / _MM))
            self._which = gui.add_dropdown("which", ("all",))
            self._on(gui.add_button("Clamp"), self._clamp)

    def _on(self, control: Any, command: Callable[[], Command]) -> None:
        """Have a control ask for a command."""

        # On viser's own thread, in order: its pool might overtake itself.
        async def wish(event: Any) -> None:
            if event.client is not None:  # not set by this program
                self._wishes.put((control, command()))

        (control.on_click if hasattr(control, "on_click") else control.on_update)(wish)

    def _add_inflow(self, name: str) -> None:
        factor = self._server.gui.add_slider(name, 0.0, _LARGEST_FACTOR, 0.05, 1.0)
        self._on(factor, lambda: {"command": "inflow", "opening": name, "factor": factor.value})

    def _steer(self, what: str) -> Command:
        if what == "reset":
            self._grip.position, self._grip.wxyz = self._start, (1.0, 0.0, 0.0, 0.0)
        return _RUN[what]

    def _tilt(self, turns: tuple[float, float]) -> Command:
        gravity = np.array(self._simulation.scene.gravity)
        vector = tilted(gravity, self._right, self._back, turns)
        return {"command": "gravity", "vector": vector.tolist()}

    def _aim(self) -> Command:
        aim = {"command": "tool", "position": self._grip.position.tolist()}
        return aim if self._tool.surface is None else aim | {"rotation": self._grip.wxyz.tolist()}

    def _wound(self, radius: float) -> Command:
        return {"command": "wound", "centre": self._marker.position.tolist(), "radius": radius}

    def _clamp(self) -> Command:
        which = self._which.value
        return {"command": "clamp"} | ({} if which == "all" else {"wound": int(which)})

    def _run(self) -> None:
        next_frame = next_figures = 0.0
        while not self._closing.wait(_PERIOD):
            self._hand_on()
            now = time.monotonic()
            if not self._server.get_clients():
                continue
            if now >= next_figures:
                next_figures = now + _FIGURES_PERIOD
                figures = self._session.figures()
                if "time" in figures:
                    self._figures.content = figures_table(figures)
            if now < next_frame - _PERIOD:
                continue
            # Asked for before it is due.
            picture = self._session.picture(self._shown)
            if picture is not None and now >= next_frame:
                began = time.thread_time()
                self._show(picture)
                next_frame = now + (time.thread_time() - began) / _SHARE

    def _hand_on(self) -> None:
        """Offer what was asked for since the last time, and say what was refused.

        Of a control that is dragged, the last command counts.
        """
        wishes: dict[int, Command] = {}
        for _ in range(self._wishes.qsize()):
            control, command = self._wishes.get()
            wishes.pop(id(control), None)
            wishes[id(control)] = command
        for command in wishes.values():
            try:
                self._session.offer(command, "page")
            except InputError as error:
                self.tell(str(error))
        texts = {self._refusals.get() for _ in range(self._refusals.qsize())}
        for client in self._server.get_clients().values():
            for text in texts:
                client.add_notification("Refused", text, auto_close_seconds=_SHOWN, color="red")

    def _show(self, picture: "Picture") -> None:
        if picture is not self._shown:
            self._shown = picture
            self.pictures += 1
            colours = COLOURS[speed_levels(picture.velocities, self._full_scale)]
            with self._server.atomic():
                self._blood.points, self._blood.colors = picture.positions, colours
                if len(picture.drops) or len(self._drops.points):
                    self._drops.points = picture.drops
        self._body.position = self._tool.position
        self._body.wxyz = np.roll(self._tool.rotation.as_quat(), 1)
        wounds = {k: w for k, w in enumerate(self._simulation.wounds) if w.is_open}
        if list(map(id, wounds.values())) != list(map(id, self._wounds.values())):
            self._wounds = wounds
            self._show_wounds()

    def _show_wounds(self) -> None:
        """Rims and numbers of those that are open."""
        scene = self._server.scene
        while self._rims:
            self._rims.pop().remove()
        for k, wound in self._wounds.items():
            rim = wound.rim()
            lines = np.stack([rim[:-1], rim[1:]], axis=1)
            self._rims += [
                scene.add_line_segments(
                    f"/wounds/{k}", lines, WOUND_COLOUR[:3], thickness=0.3 * self._spacing
                ),
                scene.add_label(f"/numbers/{k}", str(k), position=wound.begin),
            ]
        self._which.options = ("all", *map(str, self._wounds))
