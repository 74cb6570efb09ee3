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
from app.control.page import ControlPage, figures_table, tilted
from browser import Browser, needs_viser
from fake_session import PATIENCE, FakeSession, wait_until
from meshes import cylinder
from taichi_sph.errors import InputError


@pytest.fixture
def session() -> Any:
    return FakeSession(particles=300)


@pytest.fixture
def page(session: Any) -> Iterator[ControlPage]:
    page = ControlPage(session, port=0)
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
    assert session.pictures
    wait_until(lambda: not page._server.get_clients())
    time.sleep(2 * page_module._PERIOD)
    before = session.pictures
    time.sleep(4 * page_module._PERIOD)
    assert session.pictures == before, "nobody looks"


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
    page = ControlPage(session, port=0)
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
            session.offer(wound, "test")
        visitor.next("LineSegmentsMessage", name="/wounds/1")
        visitor.next("GuiUpdateMessage", updates={"options": ["all", "0", "1"]})
        session.offer({"command": "clamp", "wound": 0}, "test")
        visitor.next("RemoveSceneNodeMessage", name="/wounds/0")
        visitor.next("GuiUpdateMessage", updates={"options": ["all", "1"]})


@needs_viser
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
    page = ControlPage(session, port=0)
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
    page = ControlPage(session, port=0)
    with Visitor(page):
        page.close()
    page.close()
    assert "page" not in {thread.name for thread in threading.enumerate()}
    ControlPage(session, port=page.port).close()


@needs_viser
def test_a_taken_port_and_other_hosts_are_refused(page: ControlPage, session: Any) -> None:
    with pytest.raises(InputError, match=f"{page.port}: no port to serve at"):
        ControlPage(session, port=page.port)
    for host in ("0.0.0.0", "::"):
        with pytest.raises(InputError, match="ssh -L"):
            ControlPage(session, host=host, port=0)


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
        ControlPage(session, port=0)


def test_without_viser_it_is_said_what_to_install(
    session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"page: .*pip install 'vesselflow\[control\]'"):
        ControlPage(session, port=0)


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
    text = figures_table(session.figures() | {"model": "<b>"})
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

    right = page._right
    axis = np.eye(3)[int(np.abs(right).argmax())]
    start = np.array(page._grip.position)
    browser.pull(page._grip, axis)
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
    np.testing.assert_allclose(first["centre"], page._marker.position)
    browser.pull(page._marker, axis)
    wait_until(lambda: not np.allclose(first["centre"], page._marker.position))
    # A place on the wall that is away from both gizmos, clicked.
    low = session.vessel.openings[1].centre - 3.0 * 5e-3 * session.vessel.openings[1].normal
    browser.drag(browser.pixel(low))
    wait_until(lambda: np.linalg.norm(page._marker.position - low) < 0.015)
    away, *_ = session.vessel.nearest_wall(np.array([page._marker.position]))
    assert away[0] < 1e-5
    browser.press("Wound here")
    wait_until(lambda: len(session.of("wound")) == 2)
    browser.choose("which", "1")
    browser.press("Clamp")
    last("clamp", wound=1)
    browser.choose("which", "all")
    browser.press("Clamp")
    latest("clamp", lambda c: "wound" not in c)

    browser.press("reset")
    last("reset")
    np.testing.assert_array_equal(page._grip.position, start)
    page.tell("this cannot be done")
    browser.find("//*[.='this cannot be done']")
