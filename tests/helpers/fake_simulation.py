"""A simulation without physics: particles on known paths, for tests of what watches one.

As a program it records such a run: `python fake_simulation.py FILE FRAMES PARTICLES [PORT]`, and
says each frame's number on stdout.
"""

import sys
import time as clock
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from app.scenes.library import shipped
from taichi_sph.diagnostics import Diagnostics
from taichi_sph.errors import RunError
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.scene import read_scene


class SphAcceleration:
    """Stands for a model; its name is what matters."""

    name = "physics"


class FakeSimulation:
    """Particles that fall at different, constant speeds."""

    def __init__(self, particles: int = 200, diverges_at: float = np.inf, pause: float = 0.0):
        self.scene = read_scene(shipped()["box"])
        self.vessel = read_vessel(self.scene)
        self.model = SphAcceleration()
        self.derived = SimpleNamespace(
            blood_particles=particles,
            proxy_particles=10,
            expected_speed=1.0,
            quiet_speed=None,
            sound_speed=10.0,
            support_radius=2e-3,
        )
        self.time, self.steps = 0.0, 0
        self.diverges_at, self.pause = diverges_at, pause
        random = np.random.default_rng(7)
        low, high = self.vessel.bounds
        self.start = random.uniform(low, high, (particles, 3))
        self.velocity = np.zeros((particles, 3), np.float32)
        self.velocity[:, 2] = -np.linspace(0.0, 1.0, particles)
        self.dye, self.age = (np.zeros(particles, np.float32) for _ in range(2))
        self.particles = SimpleNamespace(in_order=lambda field: field)
        self.boundary = lambda kind: SimpleNamespace(dye=self.dye, age=self.age)
        self.tool = SimpleNamespace(surface=None, position=np.zeros(3))
        self.wall_motion = None
        self.inflow = SimpleNamespace(openings=[])
        self.wounds: list[Any] = []
        self.suction = SimpleNamespace(rate=0.0)

    def advance_to(self, time: float, before_step: Callable[[], None] | None = None) -> None:
        clock.sleep(self.pause)
        if time > self.diverges_at:
            raise RunError("the run diverged: particle 3 is not finite")
        self.time = time
        self.steps += 4

    def positions(self) -> np.ndarray:
        return (self.start + self.time * self.velocity).astype(np.float32)

    def positions_and_velocities(self) -> tuple[np.ndarray, np.ndarray]:
        return self.positions(), self.velocity

    def diagnostics(self) -> Diagnostics:
        return Diagnostics(
            time=self.time,
            step=1e-4,
            particles=len(self.start),
            drained={},
            drained_volume=0.0,
            leaks=int(self.time > 0.0),
            wall_corrections=self.steps,
            compression_p99=0.01,
            fallback_share=0.0,
            compression_max=0.02,
            kinetic_energy=0.5,
            max_speed=1.0,
        )


def main() -> None:
    from app.cli import leave
    from app.run.loop import drive
    from app.view.rerun_view import RerunView

    file, frames, particles, *port = sys.argv[1:]
    simulation: Any = FakeSimulation(int(particles), pause=0.01)
    view = RerunView(simulation, Path(file), int(port[0]) if port else None)
    slowest = 0.0

    class Teller:
        def on_frame(self, _: Any, frame: int, __: Any) -> None:
            print(frame, flush=True)

        def close(self, ending: str) -> None:
            dropped = view.live.dropped if view.live else 0
            print(f"{ending}; dropped {dropped}; slowest {slowest:.3f}", flush=True)

    class Timed:
        def on_frame(self, *arguments: Any) -> None:
            nonlocal slowest
            before = clock.perf_counter()
            view.on_frame(*arguments)
            slowest = max(slowest, clock.perf_counter() - before)

        def close(self, ending: str) -> bool:
            return view.close(ending)

    outcome = drive(simulation, [Timed(), Teller()], 0.01 * int(frames), 0.01)
    leave(str(outcome.error or ""), outcome.exit_code, at_once=bool(outcome.stalled))


if __name__ == "__main__":
    main()
