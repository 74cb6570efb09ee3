import shutil
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.control import page as page_module
from app.control.page import ControlPage, status_table
from app.control.page_controls import tilted
from app.control.page_scene import first_hit
from app.control.ports import listen
from app.view.appearance import eye, upward
from browser import Browser, needs_viser
from fake_session import PATIENCE, FakeSession, wait_until
from meshes import cylinder
from taichi_sph.errors import InputError
from taichi_sph.geometry.mesh import NearestPoint


@pytest.fixture
def session() -> Any:
    return FakeSession(particles=300)


def serve(session: Any, host: str = "127.0.0.1", port: int = 0) -> ControlPage:
    return ControlPage(session, listen(host, port, "page"))


@pytest.fixture
def page(session: Any) -> Iterator[ControlPage]:
    page = serve(session)
    yield page
    page.close()


class Visitor:
    """What a browser is to viser: a WebSocket, and messages of viser's own kind."""

    def __init__(self, page: ControlPage, origin: str | None = None):
        import viser
        from websockets.sync.client import connect

        self.connection = connect(
            f"ws://{page.host}:{page.port}",
            origin=origin,  # type: ignore[arg-type]
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            compression=None,
            max_size=None,
        )
        self.waiting: list[dict[str, Any]] = []
        self.session: Any = page._session
        camera = {
            "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 1.0), "fov": 1.0, "near": 0.01,
            "far": 10.0, "image_height": 100, "image_width": 100, "look_at": (0.0, 0.0, 0.0),
            "up_direction": (0.0, 1.0, 0.0),
        }  # fmt: skip
        self.send("ViewerCameraMessage", **camera)

    def send(self, kind: str, **content: Any) -> None:
        self.connection.send(msgspec.msgpack.encode({"type": kind, **content}))

    def next(self, kind: str, **content: Any) -> dict[str, Any]:
        """The next message of a kind and with this content."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            while self.waiting:
                message = self.waiting.pop(0)
                if message["type"] == kind and message | content == message:
                    return message
            self._receive()
        raise AssertionError(f"no {kind}")

    def _receive(self) -> None:
        import zstandard

        frame = self.connection.recv(timeout=PATIENCE)
        assert isinstance(frame, bytes)
        _, size = struct.unpack("<QQ", frame[:16])
        content = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size])
        self.waiting += msgspec.msgpack.decode(content)["messages"]

    def control(self, label: str) -> str:
        """The name that viser gave to a control."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            while self.waiting:
                message = self.waiting.pop(0)
                if message.get("props", {}).get("label") == label:
                    return message["uuid"]
            self._receive()
        raise AssertionError(f"no control {label!r}")

    def settle(self) -> None:
        """Wait until the page has done all that was sent to it."""
        self.send("GuiUpdateMessage", uuid=self.control("speed limit"), updates={"value": 0.5})
        wait_until(lambda: self.session.of("speed"))

    def __enter__(self) -> "Visitor":
        return self

    def __exit__(self, *_: object) -> None:
        self.connection.close()


@needs_viser
def test_a_visitor_sees_frames_and_figures(page: ControlPage, session: Any) -> None:
    with Visitor(page) as visitor:
        visitor.next("PointCloudMessage", name="/blood")
        updates = visitor.next("SceneNodeUpdateMessage", name="/blood")["updates"]
        assert {"points", "colors"} & updates.keys()
        while "ml/min" not in str(visitor.next("GuiUpdateMessage")["updates"]):
            pass
    assert session.frames_asked_for
    wait_until(lambda: not page.visitors)
    time.sleep(2 * page_module._PERIOD)
    before = session.frames_asked_for
    time.sleep(4 * page_module._PERIOD)
    assert session.frames_asked_for == before, "nobody looks"


@needs_viser
def test_a_control_asks_the_session_and_hears_why_not(page: ControlPage, session: Any) -> None:
    with Visitor(page) as visitor:
        limit = visitor.control("speed limit")
        visitor.send("GuiUpdateMessage", uuid=limit, updates={"value": 0.5})
        wait_until(lambda: session.of("speed"))
        session.full = True
        visitor.send("GuiUpdateMessage", uuid=limit, updates={"value": 0.75})
        assert "queue is full" in visitor.next("NotificationShowMessage")["props"]["body"]
    assert session.of("speed") == [{"command": "speed", "factor": 0.5}]
    assert session.sources == {"page"}


@needs_viser
def test_of_a_dragged_control_the_last_value_counts(page: ControlPage, session: Any) -> None:
    values = np.linspace(0.1, 2.0, 500)
    with Visitor(page) as visitor:
        limit = visitor.control("speed limit")
        for value in values:
            visitor.send("GuiUpdateMessage", uuid=limit, updates={"value": float(value)})
        wait_until(lambda: session.of("speed") and session.of("speed")[-1]["factor"] == 2.0)
    factors = [command["factor"] for command in session.of("speed")]
    assert factors == sorted(factors), "in order"
    assert len(factors) < len(values) // 4


@needs_viser
def test_a_tool_with_a_shape_is_turned_too_and_stands_where_it_is() -> None:
    vertices, faces = cylinder()
    shape = SimpleNamespace(vertices=0.1 * vertices, faces=faces)
    session: Any = FakeSession(particles=10, shape=shape)
    session.tool.rotation = Rotation.from_quat([0.0, 0.0, 0.6, 0.8])
    page = serve(session)
    turned = {"position": (0.01, 0.02, 0.03), "wxyz": (0.8, 0.6, 0.0, 0.0)}
    with Visitor(page) as visitor:
        visitor.next("MeshMessage", name="/tool")
        visitor.next("SetOrientationMessage", name="/tool", wxyz=[0.8, 0.0, 0.0, 0.6])
        visitor.send("TransformControlsUpdateMessage", name="/grip", owner="", **turned)
        visitor.next("SetPositionMessage", name="/tool", position=[0.01, 0.02, 0.03])
    page.close()
    assert session.of("tool") == [
        {"command": "tool", "position": turned["position"], "rotation": turned["wxyz"]}
    ]


@needs_viser
def test_wounds_are_shown_until_they_are_clamped(page: ControlPage, session: Any) -> None:
    wound = {"command": "wound", "centre": (0.0, 0.0, 0.0), "radius": 2e-3}
    with Visitor(page) as visitor:
        for _ in range(2):
            session.submit(wound, "test")
        visitor.next("LineSegmentsMessage", name="/wounds/1")
        visitor.next("GuiUpdateMessage", updates={"options": ["all", "0", "1"]})
        session.submit({"command": "clamp", "wound": 0}, "test")
        visitor.next("RemoveSceneNodeMessage", name="/wounds/0")
        visitor.next("GuiUpdateMessage", updates={"options": ["all", "1"]})


@needs_viser
@pytest.mark.validation
def test_a_browser_that_has_frozen_holds_up_nothing(page: ControlPage, session: Any) -> None:
    session.positions = np.repeat(session.positions, 100, axis=0)
    with Visitor(page), Visitor(page) as other:
        # The first reads nothing; what it misses is some 10 MB a second.
        for _ in range(20):
            other.next("SceneNodeUpdateMessage", name="/blood")


@needs_viser
@pytest.mark.parametrize(
    "origin", ["http://example.org", "https://127.0.0.1.example.org", "null", "file://"]
)
def test_pages_from_elsewhere_cannot_command(page: ControlPage, origin: str) -> None:
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus, match="403"):
        Visitor(page, origin)


@needs_viser
@pytest.mark.parametrize("origin", ["http://localhost:9000", "http://127.0.0.1:80", "http://[::1]"])
def test_the_page_itself_can_even_through_a_tunnel(page: ControlPage, origin: str) -> None:
    with Visitor(page, origin) as visitor:
        visitor.control("speed limit")


@needs_viser
def test_nothing_is_printed_and_no_tunnel_is_dug(
    session: Any, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from viser import _viser

    def dig(*_: Any) -> None:
        raise AssertionError("a public address was asked for")

    monkeypatch.setattr(_viser, "ViserTunnel", dig)
    page = serve(session)
    with Visitor(page) as visitor:
        visitor.send("ShareUrlRequest")
        visitor.control("speed limit")
    with socket.create_connection((page.host, page.port)) as garbage:
        garbage.sendall(b"\x16\x03\x01\r\n\r\n")
        garbage.recv(100)
    page.close()
    assert capfd.readouterr() == ("", "")


@needs_viser
def test_close_ends_the_thread_and_frees_the_port(session: Any) -> None:
    page = serve(session)
    with Visitor(page):
        page.close()
    page.close()
    assert "page" not in {thread.name for thread in threading.enumerate()}
    serve(session, port=page.port).close()


@needs_viser
def test_a_taken_port_and_other_hosts_are_refused(page: ControlPage, session: Any) -> None:
    with pytest.raises(InputError, match=f"{page.port}: no port to serve at"):
        serve(session, port=page.port)
    for host in ("0.0.0.0", "::"):
        with pytest.raises(InputError, match="ssh -L"):
            serve(session, host)


@needs_viser
def test_the_page_is_at_its_own_address_alone(page: ControlPage) -> None:
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", page.port))


@needs_viser
def test_a_viser_that_cannot_be_guarded_is_refused(
    session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import viser

    class Other(viser.ViserServer):
        def get_port(self) -> int:
            return 1

    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(InputError, match=r"viser==1\.1\.1"):
        serve(session)


def test_without_viser_it_is_said_what_to_install(
    session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"page: .*pip install 'vesselflow\[control\]'"):
        serve(session)


@needs_viser
def test_the_handle_follows_a_tool_that_others_move_unless_it_is_dragged() -> None:
    vertices, faces = cylinder()
    shape = SimpleNamespace(vertices=0.1 * vertices, faces=faces)
    session: Any = FakeSession(particles=10, shape=shape)
    page = serve(session)
    drag = {"name": "/grip", "owner": ""}
    with Visitor(page) as visitor:
        turn = [0.6, 0.8, 0.0, 0.0]
        command = {"command": "tool", "position": [0.01, 0.0, 0.0], "rotation": turn}
        session.submit(command, "channel")
        visitor.next("SetPositionMessage", name="/grip", position=[0.01, 0.0, 0.0])
        visitor.next("SetOrientationMessage", name="/grip", wxyz=pytest.approx(turn))

        visitor.send("TransformControlsDragStartMessage", **drag)
        wait_until(lambda: page.is_dragged)
        session.submit({"command": "tool", "position": [0.02, 0.0, 0.0]}, "channel")
        time.sleep(4 * page_module._PERIOD)
        assert page.tool_handle.position[0] == 0.01
        visitor.send("TransformControlsDragEndMessage", **drag)
        visitor.next("SetPositionMessage", name="/grip", position=[0.02, 0.0, 0.0])
        assert len(session.of("tool")) == 2, "to hold it without a move asks for nothing"

        visitor.send("TransformControlsDragStartMessage", **drag)
        wait_until(lambda: page.is_dragged)
    # Who leaves while dragging drags no more.
    with Visitor(page) as visitor:
        wait_until(lambda: not page.is_dragged)
        session.submit({"command": "tool", "position": [0.03, 0.0, 0.0]}, "channel")
        visitor.next("SetPositionMessage", name="/grip", position=[0.03, 0.0, 0.0])
    page.close()


@needs_viser
def test_the_handle_waits_for_what_it_has_asked_for(page: ControlPage, session: Any) -> None:
    session.delay = []  # results are held back, as where a step takes seconds
    moved = {"name": "/grip", "owner": "", "wxyz": (1.0, 0.0, 0.0, 0.0)}
    with Visitor(page) as visitor:
        visitor.send("TransformControlsUpdateMessage", position=(0.01, 0.0, 0.0), **moved)
        wait_until(lambda: session.delay)
        session.tool.target_position = np.array([0.0, 0.0, 0.05])
        time.sleep(4 * page_module._PERIOD)
        assert page.tool_handle.position.tolist() == [0.01, 0.0, 0.0]
        session.delay.pop()()
        # Within bounds it may be elsewhere than it was asked to.
        visitor.next("SetPositionMessage", name="/grip", position=[0.0, 0.0, 0.05])


@needs_viser
def test_only_models_that_are_ready_are_shown(session: Any) -> None:
    session.models.names = ("physics", "implicit")
    page = serve(session)
    with Visitor(page) as visitor:
        shown = visitor.next("GuiDropdownMessage")["props"]
        if shown["label"] == "colour":  # of the view, and first
            shown = visitor.next("GuiDropdownMessage")["props"]
    page.close()
    assert (shown["label"], tuple(shown["options"])) == ("model", session.models.names)


# Rays and the wound marker


def brute_force_hit(start: Any, way: Any, vertices: Any, faces: Any) -> float | None:
    """Distance along a ray to the first triangle, over the length of `way` (Moeller, Trumbore)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    p = np.cross(way, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / np.einsum("ij,ij->i", b - a, p)
        u = scale * np.einsum("ij,ij->i", start - a, p)
        q = np.cross(start - a, b - a)
        v = scale * (q @ way)
        t = scale * np.einsum("ij,ij->i", c - a, q)
        inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
    return float(t[inside].min()) if inside.any() else None


def grid_of_rays(session: Any, count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """The eye, and ways through a grid of pixels that is wider than the vessel."""
    vertices, up = np.asarray(session.vessel.vertices, float), upward(session.scene.gravity)
    position, target = eye(vertices, up)
    ahead = target - position
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
    above = np.cross(right, ahead) / np.linalg.norm(ahead)
    # At the target the picture is 1.04 of its distance high: this is once more to each side.
    places = np.linspace(-1.0, 1.0, count) * np.linalg.norm(ahead)
    return position, [ahead + x * right + y * above for x in places for y in places]


def test_a_ray_hits_what_it_meets_and_nothing_else(session: Any) -> None:
    vertices = np.asarray(session.vessel.vertices, float)
    faces = np.asarray(session.vessel.faces, np.int64)
    start, ways = grid_of_rays(session, 19)
    hits = 0
    for way in ways:
        expected = brute_force_hit(start, way, vertices, faces)
        found = first_hit(start, way, vertices, faces)
        assert (found is None) == (expected is None)
        if found is not None and expected is not None:
            hits += 1
            # Single precision in libigl.
            np.testing.assert_allclose(found, start + expected * way, atol=1e-6)
    assert 8 < hits < 0.5 * len(ways), "some hit and most miss"


@needs_viser
def test_a_click_that_misses_moves_no_marker_and_one_that_hits_does(
    page: ControlPage, session: Any
) -> None:
    vertices = np.asarray(session.vessel.vertices, float)
    faces = np.asarray(session.vessel.faces, np.int64)
    start, ways = grid_of_rays(session, 12)
    meets = [brute_force_hit(start, way, vertices, faces) is not None for way in ways]

    def click(way: np.ndarray) -> None:
        ray = {"ray_origin": tuple(map(float, start)), "ray_direction": tuple(map(float, way))}
        visitor.send(
            "ScenePointerMessage",
            event_type="click",
            screen_pos=((0.5, 0.5),),
            modifier=None,
            **ray,
        )

    with Visitor(page) as visitor:
        before = np.array(page.wound_marker.position)
        assert session.vessel.nearest_wall(before[None])[0][0] < 1e-6
        misses = [way for way, hit in zip(ways, meets, strict=True) if not hit]
        for way in misses:
            click(way)
        visitor.settle()
        np.testing.assert_array_equal(page.wound_marker.position, before)
        click(ways[meets.index(True)])
        wait_until(lambda: not np.array_equal(page.wound_marker.position, before))


@needs_viser
@pytest.mark.parametrize("lost", [(0.5, 0.0, 0.0), (0.0, 0.0, 0.0), (-3.0, 20.0, 1.0)])
def test_a_marker_that_is_dragged_away_comes_back_to_the_nearest_wall(
    page: ControlPage, session: Any, lost: tuple[float, float, float]
) -> None:
    name = {"name": "/mark", "owner": ""}
    with Visitor(page) as visitor:
        visitor.send("TransformControlsDragStartMessage", **name)
        visitor.send(
            "TransformControlsUpdateMessage", position=lost, wxyz=(1.0, 0.0, 0.0, 0.0), **name
        )
        visitor.send("TransformControlsDragEndMessage", **name)
        visitor.settle()
        at = np.array([page.wound_marker.position])
    vessel = session.vessel
    wall = NearestPoint(vessel.vertices, vessel.faces[vessel.face_opening < 0])
    np.testing.assert_allclose(at, wall(np.array([lost]))[2], atol=1e-6)


def test_gravity_turns_with_its_strength() -> None:
    right, back, down = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -9.81]])
    for turns, expected in (
        ((0.0, 0.0), down),
        ((90.0, 0.0), 9.81 * right),
        ((0.0, 90.0), 9.81 * back),
        ((-90.0, 0.0), -9.81 * right),
        ((180.0, 0.0), -down),
    ):
        np.testing.assert_allclose(tilted(down, right, back, turns), expected, atol=1e-12)


def test_figures_are_told_in_the_units_of_the_theatre(session: Any) -> None:
    text = status_table(session.status() | {"model": "<b>"})
    for expected in ("5000 ml/min", "200.0 ml/min", "3.20 ml", "500.00 mN", "5.0 %", "&lt;b&gt;"):
        assert expected in text


@needs_viser
def test_every_control_of_the_page_reaches_the_session(page: ControlPage, session: Any) -> None:
    pytest.importorskip("selenium", reason="selenium is not installed")
    for program in ("chromium", "chromedriver"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    session.state["paused"] = True  # frames cost a processor that draws them much time
    vertices = np.asarray(session.vessel.vertices, float)
    browser = Browser(page, vertices, session.scene.gravity)
    try:
        use_every_control(browser, page, session)
    finally:
        browser.driver.quit()


def use_every_control(browser: Browser, page: ControlPage, session: Any) -> None:
    def latest(kind: str, right: Callable[[dict[str, Any]], Any] = bool) -> dict[str, Any]:
        """The last command of a kind, as soon as it is the right one."""
        return wait_until(lambda: [c for c in session.of(kind)[-1:] if right(c)])[0]

    def last(kind: str, **content: Any) -> dict[str, Any]:
        """The last command of a kind, as soon as it has this content."""
        return latest(kind, lambda c: c | content == c)

    wait_until(
        lambda: browser.driver.find_elements("xpath", "//*[contains(., 'Software')]//button")
    )
    browser.find("//*[contains(., 'Software')]//button[1]").click()

    browser.press("go on")
    last("pause", on=False)
    browser.press("hold")
    last("pause", on=True)
    browser.press("one step")
    last("step")
    browser.enter("speed limit", 0.5)
    last("speed", factor=0.5)
    browser.enter("speed limit", 0)
    latest("speed", lambda c: "factor" not in c)
    for name in ("implicit", "pcnet", "auto", "physics"):
        browser.choose("model", name)
        last("model", name=name)

    browser.enter("right [deg]", 90)
    gravity = np.array(session.scene.gravity)
    g = float(np.linalg.norm(gravity))
    # A number is typed digit by digit, and each asks.
    level = latest("gravity", lambda c: abs(c["vector"] @ gravity) < 1e-9 * g * g)["vector"]
    assert np.linalg.norm(level) == pytest.approx(g)
    browser.enter("to you [deg]", 30)
    latest("gravity", lambda c: c["vector"] != level)
    for factor, name in enumerate(session.driven):
        browser.enter(name, 0.5 * factor)
        last("inflow", opening=name, factor=0.5 * factor)

    right = page.right
    axis = np.eye(3)[int(np.abs(right).argmax())]
    start = np.array(page.tool_handle.position)
    browser.pull(page.tool_handle, axis)
    moved = np.array(latest("tool")["position"]) - start
    assert abs(moved @ axis) > 0.9 * np.linalg.norm(moved) > 0.0
    browser.enter("rate [ml/min]", 120)
    last("suction", rate=0.0)
    browser.find('//label[.="suction"]/following::input[1]').click()
    latest("suction", lambda c: c["rate"] == pytest.approx(120e-6 / 60.0))
    browser.find('//label[.="suction"]/following::input[1]').click()
    last("suction", rate=0.0)

    browser.enter("radius [mm]", 2.5)
    browser.press("Wound here")
    first = latest("wound")
    assert first["radius"] == pytest.approx(2.5e-3)
    np.testing.assert_allclose(first["centre"], page.wound_marker.position)
    browser.pull(page.wound_marker, axis)
    wait_until(lambda: not np.allclose(first["centre"], page.wound_marker.position))
    # A place on the wall that is away from both gizmos, clicked.
    low = session.vessel.openings[1].centre - 3.0 * 5e-3 * session.vessel.openings[1].normal
    browser.drag(browser.pixel(low))
    wait_until(lambda: np.linalg.norm(page.wound_marker.position - low) < 0.015)
    away, *_ = session.vessel.nearest_wall(np.array([page.wound_marker.position]))
    assert away[0] < 1e-5
    browser.press("Wound here")
    wait_until(lambda: len(session.of("wound")) == 2)
    browser.choose("which", "1")
    browser.press("Clamp")
    last("clamp", wound=1)
    browser.choose("which", "all")
    browser.press("Clamp")
    latest("clamp", lambda c: "wound" not in c)

    browser.enter("dye radius [mm]", 3.5)
    browser.press("Dye here")
    assert latest("dye")["radius"] == pytest.approx(3.5e-3)
    np.testing.assert_allclose(latest("dye")["centre"], page.wound_marker.position)
    browser.choose("dye what enters by", session.driven[1])
    browser.press("Dye inflow")
    last("dye", opening=session.driven[1], concentration=1.0)
    browser.press("Clear inflow")
    last("dye", opening=session.driven[1], concentration=0.0)

    # Speeds swirl along z; by age, colours follow the particles' numbers.
    oldest = [0xFD, 0xE7, 0x25]
    browser.choose("colour", "age")
    wait_until(lambda: page._scene._blood.colors[-1].tolist() == oldest)
    browser.find("//*[contains(., 's and above') and not(contains(., 'm/s and above'))]")
    browser.choose("colour", "speed")
    wait_until(lambda: page._scene._blood.colors[-1].tolist() != oldest)

    # A click beside the vessel leaves the marker where it is.
    before = np.array(page.wound_marker.position)
    browser.drag(browser.corner())
    time.sleep(0.5)
    np.testing.assert_array_equal(page.wound_marker.position, before)

    browser.press("reset")
    last("reset")
    wait_until(lambda: np.array_equal(page.tool_handle.position, start))
    page.tell("this cannot be done")
    browser.find("//*[.='this cannot be done']")
