"""What live control and a live view cost a run, for `vesselflow bench --control`."""

import socket
import statistics
import threading
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from app.channel import Channel
from app.models import maker_of
from app.output import table
from app.page import ControlPage
from app.session import Session
from app.view import RerunView
from taichi_sph.runtime import start
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation

FRAMES = 24
"""Of each kind, in turn."""
COMMANDS = 50.0
"""That a client sends in a second: a hand on the tool [1/s]."""


@dataclass(frozen=True)
class Overhead:
    """A scene with and without control."""

    scene: str
    bare_ms: float
    """A step, frames' figures included, nobody looking [ms]."""
    acted_ms: float
    """The same with log, page, channel, a client that moves the tool, and a live view [ms]."""
    more: float
    """What the latter costs more: median over frames and the ones before them."""
    frame_ms: float
    """A frame of the latter [ms]."""
    latency_ms: float
    """Longest wait of a command for its step [ms]."""


def measure_overhead(
    scene: Scene, weights: Path, arch: str, threads: int | None, folder: Path
) -> Overhead:
    """Run a scene by PcNet, one frame with control and one without in turn."""
    start(arch, "f32", threads)
    simulation = Simulation.from_scene(scene, maker_of("pcnet", scene, weights))
    session = Session(simulation, {}, folder / "session.jsonl")
    view = RerunView(simulation, None, _free_port())
    sides: dict[bool, list[float]] = {False: [], True: []}
    frame_times: list[float] = []
    acting, done = threading.Event(), threading.Event()
    with closing(Channel(session)) as channel, closing(ControlPage(session, port=0)):
        session.watched = True
        hand = threading.Thread(target=_move_tool, args=(channel, session, acting, done))
        hand.start()
        for frame in range(1, 2 * FRAMES + 3):
            acted = frame % 2 == 0
            worst = session.latency
            session.before_step()  # what came too late for the last frame has not waited for this
            session.latency = worst if frame > 2 else 0.0
            acting.set() if acted else acting.clear()
            steps, began = simulation.steps, time.perf_counter()
            simulation.advance_to(
                frame * scene.frame_interval, session.before_step if acted else None
            )
            figures = simulation.diagnostics()
            if acted:
                session.on_frame(simulation, frame, figures)
                view.on_frame(simulation, frame, figures)
            took = time.perf_counter() - began
            if frame > 2:  # the first of each compile
                sides[acted].append(1e3 * took / (simulation.steps - steps))
                frame_times += [took] * acted
        done.set()
        acting.set()
        hand.join()
    session.close("measured")
    view.close("measured")
    return Overhead(
        scene.name, statistics.median(sides[False]), statistics.median(sides[True]),
        statistics.median(b / a for a, b in zip(*sides.values(), strict=True)) - 1.0,
        1e3 * statistics.median(frame_times), 1e3 * session.latency,
    )  # fmt: skip


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _move_tool(
    channel: Channel, session: Session, acting: threading.Event, done: threading.Event
) -> None:
    """A client on the channel that moves the tool while there is somebody to act."""
    x, y, z = map(float, session.simulation.surgery.tool.position)
    with closing(socket.create_connection((channel.host, channel.port))) as line:
        replies = line.makefile()
        for k in range(1_000_000):
            acting.wait()
            if done.is_set():
                return
            place = f"[{x + 1e-5 * (k % 100)}, {y}, {z}]"
            line.sendall(f'{{"command": "tool", "position": {place}}}\n'.encode())
            replies.readline()
            time.sleep(1.0 / COMMANDS)


def overhead_table(rows: list[Overhead]) -> Table:
    """One line a scene."""
    found = table(
        "with live control and a live view", "scene", "bare, ms a step", "acted on, ms a step",
        "more", "a frame ms", "longest wait of a command ms",
    )  # fmt: skip
    for row in rows:
        found.add_row(
            row.scene, f"{row.bare_ms:.2f}", f"{row.acted_ms:.2f}",
            f"{row.more:+.1%}", f"{row.frame_ms:.0f}",
            f"{row.latency_ms:.1f}",
        )  # fmt: skip
    return found
