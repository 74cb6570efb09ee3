"""What live control and a live view cost a run, for `vesselflow bench --control`."""

import multiprocessing
import os
import socket
import statistics
import threading
import time
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from rich.table import Table

from app.control.auto_model import ModelSelection
from app.control.channel import Channel
from app.control.log import LogWriter
from app.control.page import ControlPage
from app.control.ports import listen
from app.control.session import Session
from app.files import table
from app.models import model_factory
from app.view.rerun_view import RerunView
from taichi_sph.runtime import start
from taichi_sph.scene import Scene
from taichi_sph.simulation import Simulation

if TYPE_CHECKING:
    from multiprocessing.synchronize import Event

PAIRS = 16
"""Of stretches, one bare and one acted on; which is first changes from pair to pair."""
FRAMES = 6
"""Of a stretch: what threads still do when it ends is counted to neither."""
SETTLED = 10
"""Frames before the first of them: blood falls, and kernels are compiled."""
_PATIENCE = 60.0
"""Longest wait for the client [s]."""
COMMANDS = 50.0
"""That a client sends in a second: a hand on the tool [1/s]."""


@dataclass(frozen=True)
class Overhead:
    """A scene with and without control."""

    scene: str
    blood_particles: int
    bare_ms: float
    """A step, frames' figures included, nobody acting [ms]."""
    acted_ms: float
    """The same with log, page, channel, a client that moves the tool, and a live view [ms]."""
    more: float
    """What the latter costs more: median over the pairs."""
    more_low: float
    """Lower quartile."""
    more_high: float
    """Upper quartile."""
    frame_ms: float
    """A frame of the latter [ms]."""
    latency_ms: float
    """Longest wait of a command for its step [ms]."""
    pictures: float
    """That the page sent in a second [1/s]."""


def measure_overhead(
    scene: Scene, weights: Path, arch: str, threads: int | None, folder: Path, pairs: int = PAIRS
) -> Overhead:
    """Run a scene by PcNet, stretches of frames with and without control in turn.

    A client in a process of its own sends commands and takes what the page sends.  What a browser
    needs to draw that is not counted, nor is a viewer.
    """
    start(arch, "f32", threads)
    simulation = Simulation.from_scene(scene, model_factory("pcnet", scene, weights))
    log = LogWriter(folder / "session.jsonl", {}, simulation.particles.names)
    session = Session(simulation, ModelSelection(simulation), log)
    view = RerunView(simulation, None, _free_port())
    sides: dict[bool, list[float]] = {False: [], True: []}
    frame_times, pictures, latency, frame = [], 0, 0.0, 0
    spawn = multiprocessing.get_context("spawn")
    acting, done = spawn.Event(), spawn.Event()
    channel_port, page_port = (listen("127.0.0.1", 0, "bench") for _ in range(2))
    with (
        closing(Channel(session, channel_port)) as channel,
        closing(ControlPage(session, page_port)) as page,
    ):
        place = [float(x) for x in simulation.tool.position]
        client = spawn.Process(
            target=_act, args=(channel.port, page.port, place, acting, done), daemon=True
        )
        client.start()
        end = time.monotonic() + _PATIENCE
        while not session.frame_requested:
            if time.monotonic() > end or not client.is_alive():
                raise RuntimeError("bench --control: its own client does not reach the page")
            time.sleep(0.1)
        simulation.advance_to(SETTLED * scene.frame_interval)
        state = simulation.save_state()
        for pair in range(-1, pairs):
            for acted in (False, True) if pair % 2 else (True, False):
                # Both do the same work: a tool without a shape moves no blood.
                simulation.load_state(state)
                sent, steps, began = page.frames_shown, simulation.steps, time.perf_counter()
                if acted:
                    session.before_step()
                    session.latency = 0.0  # what came too late for the last stretch waited long
                    acting.set()
                else:
                    acting.clear()
                    session.frame_requested = False
                for _ in range(FRAMES):
                    frame += 1
                    simulation.advance_to(
                        simulation.time + scene.frame_interval,
                        session.before_step if acted else None,
                    )
                    figures = simulation.diagnostics()
                    if acted:
                        session.on_frame(simulation, frame, figures)
                        view.on_frame(simulation, frame, figures)
                took = time.perf_counter() - began
                if pair < 0:
                    continue  # the first of each compile
                sides[acted].append(1e3 * took / (simulation.steps - steps))
                if acted:
                    frame_times.append(took / FRAMES)
                    latency = max(latency, session.latency)
                    pictures += page.frames_shown - sent
        done.set()
        acting.set()
        client.join()
    session.close("measured")
    view.close("measured")
    more = [b / a - 1.0 for a, b in zip(*sides.values(), strict=True)]
    low, middle, high = statistics.quantiles(more, n=4)
    return Overhead(
        scene.name, simulation.derived.blood_particles,
        statistics.median(sides[False]), statistics.median(sides[True]), middle, low, high,
        1e3 * statistics.median(frame_times), 1e3 * latency,
        pictures / (FRAMES * sum(frame_times)),
    )  # fmt: skip


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _act(channel: int, page: int, place: list[float], acting: "Event", done: "Event") -> None:
    """A browser that looks at the page, and a client that moves the tool while it is to act."""
    threading.Thread(target=_look, args=(page,), daemon=True).start()
    x, y, z = place
    with closing(socket.create_connection(("127.0.0.1", channel))) as line:
        replies = line.makefile()
        for k in range(1_000_000):
            acting.wait()
            if done.is_set():
                return
            where = f"[{x + 1e-5 * (k % 100)}, {y}, {z}]"
            line.sendall(f'{{"command": "tool", "position": {where}}}\n'.encode())
            replies.readline()
            time.sleep(1.0 / COMMANDS)


def _look(port: int) -> None:
    """Take all that a page sends; it sends pictures to whoever has said where the camera is."""
    from websockets.sync.client import connect

    os.environ["NO_PROXY"] = "127.0.0.1"
    nowhere = (0.0, 0.0, 0.0)
    camera = {
        "type": "ViewerCameraMessage", "wxyz": (1.0, *nowhere), "position": nowhere,
        "look_at": nowhere, "up_direction": nowhere, "fov": 1.0, "near": 1.0, "far": 2.0,
        "image_height": 1, "image_width": 1,
    }  # fmt: skip
    protocols: Any = [f"viser-v{version('viser')}"]
    url = f"ws://127.0.0.1:{port}"
    with connect(url, subprotocols=protocols, max_size=None, compression=None) as line:
        line.send(msgspec.msgpack.encode(camera))
        for _ in line:
            pass


def overhead_table(rows: list[Overhead]) -> Table:
    """One line a scene."""
    found = table(
        "with live control and a live view", "scene", "blood", "bare, ms a step",
        "acted on, ms a step", "more", "quartiles", "a frame ms", "longest wait of a command ms",
        "pictures 1/s",
    )  # fmt: skip
    for row in rows:
        found.add_row(
            row.scene, str(row.blood_particles), f"{row.bare_ms:.2f}", f"{row.acted_ms:.2f}",
            f"{row.more:+.1%}", f"{row.more_low:+.1%} to {row.more_high:+.1%}",
            f"{row.frame_ms:.0f}", f"{row.latency_ms:.1f}", f"{row.pictures:.1f}",
        )  # fmt: skip
    return found
