"""A session without physics, for tests of what commands one: it keeps what is submitted to it."""

import math
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from app.control.commands import as_dict, parse_command
from app.scenes.library import shipped
from taichi_sph.boundary.wounds import Wound
from taichi_sph.errors import InputError
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.scene import read_scene

PATIENCE = 20.0
"""Longest that a busy machine may take for something of a moment [s]."""


def wait_until(happened: Callable[[], Any], patience: float = PATIENCE) -> Any:
    """What `happened` returns once it is true."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        if found := happened():
            return found
        time.sleep(0.02)
    raise AssertionError(f"not within {patience:g} s")


class FakeSession:
    """Blood that swirls without end in a shipped vessel."""

    def __init__(self, scene: str = "aortoiliac", particles: int = 4000, shape: Any = None):
        self.scene = read_scene(shipped()[scene])
        self.vessel = read_vessel(self.scene)
        low, high = self.vessel.bounds
        middle = 0.5 * (low + high)
        self.tool_start = middle
        self.wounds: list[Wound] = []
        self.tool = SimpleNamespace(
            surface=shape, position=middle, rotation=Rotation.identity(),
            target_position=middle, target_rotation=Rotation.identity(),
        )  # fmt: skip
        self.simulation: Any = SimpleNamespace(
            scene=self.scene,
            vessel=self.vessel,
            derived=SimpleNamespace(expected_speed=1.0, quiet_speed=None),
            tool=self.tool,
            wounds=self.wounds,
            inflow=SimpleNamespace(openings=[]),
            model=SimpleNamespace(name="physics"),
        )
        self.models = SimpleNamespace(
            names=("physics", "implicit", "pcnet", "auto"), selected="physics"
        )
        self.driven = [opening.name for opening in self.vessel.openings[:2]]
        random = np.random.default_rng(7)
        wall = random.choice(self.vessel.vertices, particles)
        self.positions = middle + 0.9 * np.sqrt(random.random((particles, 1))) * (wall - middle)
        self.droplets = middle + 0.2 * (high - low) * random.normal(size=(particles // 20, 3))
        self.lock = threading.Lock()
        self.submitted: list[dict[str, Any]] = []
        self.sources: set[str] = set()
        self.full = False
        self.refuses = ""
        """Why commands are refused at their step, if they are."""
        self.delay: list[Callable[[], None]] | None = None
        """Where results are kept back, if they are."""
        self.frames_asked_for = 0
        self.start, self.last = time.monotonic(), 0.0
        self.state: dict[str, Any] = {
            "paused": False,
            "model": "physics",
            "speed": None,
            "gravity": self.scene.gravity,
            "suction": 0.0,
        }

    def submit(
        self,
        value: bytes | str | dict[str, Any],
        source: str,
        on_result: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        command = as_dict(parse_command(value))
        with self.lock:
            if self.full:
                raise InputError("the queue is full; wait until the simulation has caught up")
            self.submitted.append(command)
            self.sources.add(source)
            kind = command["command"]
            if kind == "pause":
                self.state["paused"] = command["on"]
            elif kind == "model":
                self.state["model"] = command["name"]
            elif kind == "tool":
                self.tool.position = self.tool.target_position = np.array(command["position"])
                if "rotation" in command:
                    turn = Rotation.from_quat(np.roll(command["rotation"], -1))
                    self.tool.target_rotation = turn
            elif kind == "reset":
                self.tool.position = self.tool.target_position = self.tool_start
                self.tool.target_rotation = Rotation.identity()
            elif kind == "wound":
                at = np.array(command["centre"])
                self.wounds.append(Wound(at, at, np.array([0.0, 0.0, 1.0]), command["radius"]))
            elif kind == "clamp":
                for number, wound in enumerate(self.wounds):
                    wound.is_open &= command.get("wound", number) != number
        if on_result is not None:
            result: dict[str, Any] = {
                "applied": command, "step": len(self.submitted), "time": self.last,
            }  # fmt: skip
            if self.refuses:
                result = {"refused": self.refuses}
            if self.delay is None:
                on_result(result)
            else:
                self.delay.append(lambda: on_result(result))

    def of(self, kind: str) -> list[dict[str, Any]]:
        """Commands of a kind, as they came."""
        with self.lock:
            return [command for command in self.submitted if command["command"] == kind]

    def status(self) -> dict[str, Any]:
        with self.lock:
            return self.state | {
                "time": time.monotonic() - self.start,
                "real_time_factor": 0.5,
                "particles": len(self.positions),
                "flow_out": 5e-3 / 60.0,
                "bleeding": 2e-4 / 60.0,
                "lost": 3.2e-6,
                "suctioned": 1.1e-6,
                "added": math.nan,
                "guard_share": 0.05,
                "compression": 0.01,
                "wounds": [],
                "tool_position": [float(x) for x in self.tool.position],
                "tool_force": [0.3, 0.0, 0.4],
                "frames": self.frames_asked_for,
            }

    def latest_frame(self, known: Any) -> Any:
        self.frames_asked_for += 1
        if not self.state["paused"]:
            self.last = time.monotonic() - self.start
        swirl = np.sin(2.0 * self.last + 200.0 * self.positions[:, :1])
        position = (self.positions + 2e-4 * swirl).astype(np.float32)
        return SimpleNamespace(
            time=self.last,
            positions=position,
            velocities=(np.abs(swirl) * [0.0, 0.0, 1.0]).astype(np.float32),
            droplets=self.droplets.astype(np.float32),
            dye=np.zeros(len(self.positions), np.float32),
            age=np.linspace(0.0, self.scene.duration, len(self.positions), dtype=np.float32),
        )
