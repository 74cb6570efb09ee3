"""A session without physics, for tests of what commands one: it keeps what it is offered."""

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
        self.wounds: list[Wound] = []
        self.tool = SimpleNamespace(surface=shape, position=middle, rotation=Rotation.identity())
        self.simulation: Any = SimpleNamespace(
            scene=self.scene,
            vessel=self.vessel,
            derived=SimpleNamespace(expected_speed=1.0),
            tool=self.tool,
            wounds=self.wounds,
            model=SimpleNamespace(name="physics"),
        )
        self.models = {"physics": None, "implicit": None, "pcnet": None}
        self.driven = [opening.name for opening in self.vessel.openings[:2]]
        random = np.random.default_rng(7)
        wall = random.choice(self.vessel.vertices, particles)
        self.positions = middle + 0.9 * np.sqrt(random.random((particles, 1))) * (wall - middle)
        self.drops = middle + 0.2 * (high - low) * random.normal(size=(particles // 20, 3))
        self.lock = threading.Lock()
        self.offered: list[dict[str, Any]] = []
        self.sources: set[str] = set()
        self.full = False
        self.pictures = 0
        self.start, self.last = time.monotonic(), 0.0
        self.state: dict[str, Any] = {
            "paused": False,
            "model": "physics",
            "speed": None,
            "gravity": self.scene.gravity,
            "suction": 0.0,
        }

    def offer(self, given: bytes | str | dict[str, Any], source: str) -> None:
        command = as_dict(parse_command(given))
        with self.lock:
            if self.full:
                raise InputError("the queue is full; wait until the simulation has caught up")
            self.offered.append(command)
            self.sources.add(source)
            kind = command["command"]
            if kind == "pause":
                self.state["paused"] = command["on"]
            elif kind == "model":
                self.state["model"] = command["name"]
            elif kind == "tool":
                self.tool.position = np.array(command["position"])
            elif kind == "wound":
                at = np.array(command["centre"])
                self.wounds.append(Wound(at, at, np.array([0.0, 0.0, 1.0]), command["radius"]))
            elif kind == "clamp":
                for number, wound in enumerate(self.wounds):
                    wound.is_open &= command.get("wound", number) != number

    def of(self, kind: str) -> list[dict[str, Any]]:
        """Commands of a kind, as they came."""
        with self.lock:
            return [command for command in self.offered if command["command"] == kind]

    def figures(self) -> dict[str, Any]:
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
                "frames": self.pictures,
            }

    def picture(self, known: Any) -> Any:
        self.pictures += 1
        if not self.state["paused"]:
            self.last = time.monotonic() - self.start
        swirl = np.sin(2.0 * self.last + 200.0 * self.positions[:, :1])
        position = (self.positions + 2e-4 * swirl).astype(np.float32)
        return SimpleNamespace(
            time=self.last,
            positions=position,
            velocities=(np.abs(swirl) * [0.0, 0.0, 1.0]).astype(np.float32),
            drops=self.drops.astype(np.float32),
        )
