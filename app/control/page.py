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
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from app.control.commands import Command, as_dict
from app.control.page_controls import ML, ML_MIN, Panel, add_controls
from app.control.page_scene import PageScene
from app.control.ports import is_loopback
from app.view.appearance import COLOURINGS, Colouring, colouring
from taichi_sph.errors import InputError

if TYPE_CHECKING:
    from app.control.session import Session, ViewFrame

_PERIOD = 0.05
"""Time between two updates [s]."""
_SHARE = 0.01
"""Part of a processor's time that the page's own thread spends on frames, at most."""
_STATUS_PERIOD = 0.2
"""Time between two updates of the status [s]: faster nobody reads."""
_SHOWN = 8.0
"""How long a refusal stays on the page [s]."""
_ACCENT = (92, 124, 158)
"""Colour of the controls: red is the blood's."""
_WIDTH = 340.0
"""Width of the panel [pixels]."""
NO_VISER = "page: viser is not installed; pip install 'vesselflow[control]'"
_OURS = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Pages that may command: this one, through whatever port an SSH tunnel has here."""


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


def status_table(status: dict[str, Any]) -> str:
    """Status of a session as HTML."""
    force = 1e3 * float(np.linalg.norm(status["tool_force"]))
    rows = {
        "simulated time": f"{status['time']:.3f} s",
        "real-time factor": "held" if status["paused"] else f"{status['real_time_factor']:.2f}",
        "model": html.escape(str(status["model"])),
        "taken over by the physics": f"{100.0 * status['guard_share']:.1f} %",
        "particles": f"{status['particles']}",
        "flow out": f"{ML_MIN * status['flow_out']:.0f} ml/min",
        "bleeding": f"{ML_MIN * status['bleeding']:.1f} ml/min",
        "lost blood": f"{ML * status['lost']:.2f} ml",
        "sucked away": f"{ML * status['suctioned']:.2f} ml",
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


def colour_bar(colour: Colouring) -> str:
    """What colours mean, as HTML."""
    colours = ",".join(f"rgb{anchor}" for anchor in colour.anchors)
    return (
        f"<div style='margin:.4em .9em;height:.7em;background:linear-gradient(90deg,{colours})'>"
        "</div><div style='display:flex;justify-content:space-between;margin:0 .9em;"
        f"font-size:.75em;opacity:.75'><span>{colour.at_zero}</span>"
        f"<span>{colour.full_scale:.2g} {colour.unit} and above</span></div>"
    )


class _Pending(NamedTuple):
    """A command that a control has asked for."""

    control: object
    command: Command
    number: int
    """How many had been asked for with it."""


class ControlPage:
    """A server on loopback that browsers connect to, come and go.

    It asks for no password, and viser cannot: from other machines it is reached through SSH.
    """

    def __init__(self, session: "Session", listener: socket):
        """Show a session.

        Args:
            session: gets the commands.
            listener: a socket that listens, on loopback.

        Raises:
            InputError: the socket is not of loopback, or viser is not installed.
        """
        if importlib.util.find_spec("viser") is None:
            listener.close()
            raise InputError(NO_VISER)
        self.host, self.port = listener.getsockname()[:2]
        if not is_loopback(listener):
            listener.close()
            raise InputError(
                f"page {self.host}: the page has no password, so it is served at 127.0.0.1 only; "
                f"from another machine, `ssh -L {self.port}:127.0.0.1:{self.port} HOST` brings it "
                "there"
            )
        self.url = f"http://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"
        self._session = session
        self._pending: queue.SimpleQueue[_Pending] = queue.SimpleQueue()
        self._refusals: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._closing, self._recolour = threading.Event(), threading.Event()
        self.frames_shown = 0
        self._shown: ViewFrame | None = None
        self._dragged: set[int] = set()
        """Visitors who are dragging the tool's handle."""
        self._tool_wishes = self._tool_settled = 0
        """Number of the last command that the handle has asked for, and of the last applied."""
        self._server = start_server(listener)
        self._scene = PageScene(self._server, session)
        self._add_panel()
        self._thread = threading.Thread(target=self._run, daemon=True, name="page")
        self._thread.start()

    @property
    def tool_handle(self) -> Any:
        """What the tool is dragged by: its `position` [m] and `wxyz`."""
        return self._scene.tool_handle

    @property
    def wound_marker(self) -> Any:
        """Where a wound will be: its `position` [m]."""
        return self._scene.wound_marker

    @property
    def right(self) -> np.ndarray:
        """Unit vector to the right of who looks, as long as the camera stands as at the start."""
        return self._scene.right

    @property
    def visitors(self) -> int:
        """How many browsers are connected."""
        return len(self._server.get_clients())

    @property
    def is_dragged(self) -> bool:
        """Whether a visitor is dragging the tool's handle."""
        # Who leaves in the middle of it drags no more.
        return bool(self._dragged & self._server.get_clients().keys())

    def close(self) -> None:
        """End the server; browsers keep what they show."""
        self._closing.set()
        self._thread.join()
        self._server.stop()

    def tell(self, text: str) -> None:
        """Show a sentence to everybody, from any thread: why something was refused."""
        self._refusals.put(text)

    def _add_panel(self) -> None:
        """Colours, status and all that can be done."""
        gui = self._server.gui
        gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=_ACCENT
        )
        gui.set_panel_label(self._session.simulation.scene.title)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_WIDTH)
        self._add_colours(gui)
        self._status = gui.add_html("")
        add_controls(Panel(gui, self._session, self._scene, self._wish))

    def _add_colours(self, gui: Any) -> None:
        """Choice of what colours mean, for all who look on; the run does not know of it."""
        simulation = self._session.simulation
        bar = gui.add_html(colour_bar(self._scene.colouring))
        choice = gui.add_dropdown("colour", COLOURINGS)

        @choice.on_update
        async def _(event: Any) -> None:
            chosen = colouring(choice.value, simulation)
            self._scene.colouring, bar.content = chosen, colour_bar(chosen)
            # The next frame may be long in coming.
            self._recolour.set()

    def _wish(self, control: Any, command: Callable[[], Command]) -> None:
        """Have a control ask for a command."""

        # On viser's own thread, in order: its pool might overtake itself.
        async def wish(event: Any) -> None:
            if event.client is None:
                return  # set by this program
            number = 0
            if control is self.tool_handle:
                if event.phase == "start":
                    self._dragged.add(event.client.client_id)
                elif event.phase == "end":
                    self._dragged.discard(event.client.client_id)
                if event.phase != "update":
                    return
                number = self._tool_wishes = self._tool_wishes + 1
            self._pending.put(_Pending(control, command(), number))

        (control.on_click if hasattr(control, "on_click") else control.on_update)(wish)

    def _run(self) -> None:
        next_frame = next_status = 0.0
        while not self._closing.wait(_PERIOD):
            self._submit_pending()
            now = time.monotonic()
            if not self._server.get_clients():
                continue
            if not self.is_dragged and self._tool_settled == self._tool_wishes:
                self._scene.follow_tool()
            if now >= next_status:
                next_status = now + _STATUS_PERIOD
                status = self._session.status()
                if "time" in status:
                    self._status.content = status_table(status)
            if now < next_frame - _PERIOD:
                continue
            # Asked for before it is due.
            frame = self._session.latest_frame(self._shown)
            if frame is not None and now >= next_frame:
                began = time.thread_time()
                self._show(frame)
                next_frame = now + (time.thread_time() - began) / _SHARE

    def _submit_pending(self) -> None:
        """Submit what was asked for since the last time, and say what was refused.

        Of a control that is dragged, the last command counts.
        """
        latest: dict[int, _Pending] = {}
        for _ in range(self._pending.qsize()):
            pending = self._pending.get()
            latest.pop(id(pending.control), None)
            latest[id(pending.control)] = pending
        for pending in latest.values():
            try:
                self._session.submit(as_dict(pending.command), "page", self._settling(pending))
            except InputError as error:
                self.tell(str(error))
                self._settling(pending)({})
        texts = {self._refusals.get() for _ in range(self._refusals.qsize())}
        for client in self._server.get_clients().values():
            for text in texts:
                client.add_notification("Refused", text, auto_close_seconds=_SHOWN, color="red")

    def _settling(self, pending: _Pending) -> Callable[[dict[str, Any]], None]:
        """What notes that a command has been applied or refused."""

        def settle(result: dict[str, Any]) -> None:
            self._tool_settled = max(self._tool_settled, pending.number)

        return settle

    def _show(self, frame: "ViewFrame") -> None:
        if frame is not self._shown or self._recolour.is_set():
            self._recolour.clear()
            self._shown = frame
            self.frames_shown += 1
            with self._server.atomic():
                self._scene.show_blood(frame)
        self._scene.show_tool_and_wounds()
