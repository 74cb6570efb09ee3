"""Settings of a training, and the recorded runs that it learns from and is judged by."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nn.dataset.reader import Dataset, Run
from nn.dataset.schema import mean_acceleration
from nn.features import NAMES, PAPER_COUNT, FeatureScales
from nn.pcnet import PcNet, make_pcnet
from nn.training.rollout import ReplaySimulation
from nn.weights import Training, Weights, dimensionless_numbers
from taichi_sph.diagnostics import FEW, compression
from taichi_sph.errors import RunError
from taichi_sph.fluid.model import AccelerationModel
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.scene_files import sha256

DIED = 0.3
"""99th percentile of compression at which a rollout counts as failed."""

INPUTS = {
    "direct": NAMES[:PAPER_COUNT],
    "pressure": ("N", "D_rv_b", "M", "compression", "divergence"),
}
"""Features that each head sees by default."""


@dataclass(frozen=True)
class Settings:
    """How to train."""

    head: str = "pressure"
    correction: str = "relabel"
    inputs: tuple[str, ...] | None = None
    """Features seen; the head's of INPUTS if None."""
    rounds: int = 0
    """Jacobi iterations after the pressure head's initial pressure."""
    iterations: int = 600
    """Gradient steps."""
    batch: int = 4096
    """Particles a step of the direct head; the pressure head takes the whole frame."""
    learning_rate: float = 5e-3
    seed: int = 0
    drift: int = 10
    """Longest rollout before a drifted sample, reached halfway (relabel) [frames]."""
    validate_every: int = 100
    """Gradient steps between two rollouts on the held-out run."""


class TrainingRuns:
    """Recorded runs to learn from, some held out, and a replay for their frames."""

    def __init__(self, file: Dataset, held_out: Sequence[int]):
        """Set up a replay with room for the largest run.

        Raises:
            InputError: no such run, or no other.
        """
        self.runs, self.held = file.split(held_out)
        self.held_out = list(held_out)
        self._networks: dict[Any, PcNet] = {}
        facts = self.facts = self.runs[0].facts
        largest = max((*self.runs, *self.held), key=lambda run: run.facts.particles)
        self.scene = largest.scene
        self.replay = ReplaySimulation(self.scene, read_vessel(self.scene), largest.facts.seed)
        low, high = self.replay.simulation.vessel.bounds
        self.extent = float(np.linalg.norm(np.asarray(high) - np.asarray(low)))
        """Diagonal of the vessel's box [m]."""
        self.interval = facts.frame_interval
        ratio = self.scene.discretization.wall_spacing_ratio
        self.scales = FeatureScales(
            facts.support_radius, facts.spacing, self.interval, facts.sound_speed, ratio
        )

    def training(self, settings: Settings, command: str) -> Training:
        """What a network trained here is to remember."""
        facts, liquid = self.facts, dimensionless_numbers(self.replay.fluid)
        return Training(
            head=settings.head,
            inputs=INPUTS[settings.head] if settings.inputs is None else settings.inputs,
            spacing=facts.spacing,
            support_radius=facts.support_radius,
            frame_interval=self.interval,
            substeps=facts.substeps,
            rounds=0 if settings.head == "direct" else settings.rounds,
            sound_speed=facts.sound_speed,
            wall_spacing_ratio=self.scales.wall_spacing_ratio,
            artificial_viscosity=liquid["artificial_viscosity"],
            viscosity_ratio=liquid["viscosity_ratio"],
            correction=settings.correction,
            seed=settings.seed,
            scene=facts.scene_name,
            scene_hash=sha256(facts.scene.encode()),
            command=command,
        )

    def pcnet(self, weights: Weights) -> PcNet:
        """The network as `run` has it, without its guard: what dies here must be seen to die.

        One object for all weights that differ in nothing else, since each costs a compilation.
        """
        arrays = tuple(a.tobytes() for a in (weights.mean, weights.deviation, weights.scale))
        training = weights.training
        key = training.head, training.inputs, training.rounds, weights.sizes, arrays
        if key not in self._networks:
            replay = self.replay
            capacity = replay.simulation.particles.capacity
            self._networks[key] = make_pcnet(
                weights, replay.fluid, self.scales, capacity, guarded=False
            )
        self._networks[key].network.load(weights)
        return self._networks[key]

    def put(self, run: Run, frame: int) -> None:
        """Put a recorded frame into the replay."""
        self.replay.restore(run.state(frame), frame * self.interval, 0)
        self.replay.set_acceleration(run.acceleration(frame))

    def advance(self, model: AccelerationModel, frames: int) -> None:
        """Advance by so many frames from where the replay stands, and settle.

        Raises:
            RunError: it diverged.
        """
        self.replay.simulation.model, self.replay.simulation.step_limit = model, math.inf
        self.replay.advance_to(self.replay.simulation.time + frames * self.interval)
        self.replay.settle()

    def relabel(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean acceleration [m/s^2] of the physics over the next frame, and where it is valid."""
        replay = self.replay
        before = replay.state()
        replay.use_physics()
        replay.advance_to(replay.simulation.time + self.interval)
        replay.settle()
        after = replay.state()
        target = mean_acceleration(before.velocity, after.velocity, after.alive, self.interval)
        return target, before.alive & after.alive

    def examples(self, frames: int) -> tuple[np.ndarray, np.ndarray]:
        """Features (n, ROW_COUNT) and targets [m/s^2] (n, 3) from frames all over the runs."""
        inputs, targets = [], []
        for run in self.runs:
            for frame in np.linspace(1, len(run) - 1, frames).astype(int):
                self.put(run, int(frame))
                valid = run.has_target(int(frame))
                inputs.append(self.replay.features(self.scales)[: len(valid)][valid])
                targets.append(run.target(int(frame))[valid])
        return np.concatenate(inputs), np.concatenate(targets)

    def rollout(self, model: AccelerationModel, run: Run) -> dict[str, float]:
        """Roll a model out from the first frame of a run and compare.

        Returns: survived (fraction of frames before it died: diverged, compression beyond DIED,
        blood gone that should be there, or farther off than the vessel is long), path_error
        (largest distance of the centres of mass over the recorded path's length, while FEW of the
        blood are there), drained_error (largest difference of the drained fraction),
        compression_p99 (largest).
        """
        replay, frames = self.replay, len(run)
        self.put(run, 0)
        replay.simulation.model, replay.simulation.step_limit = model, math.inf
        distance = length = drained = worst = 0.0
        last = None
        survived = 0
        for frame in range(1, frames + 1):
            alive = run.alive(frame)
            try:
                replay.advance_to(frame * self.interval)  # in several steps, where blood is fast
            except RunError:
                break
            n = replay.simulation.particles.count[None]
            if not alive.any() or (not n and alive.mean() < FEW):
                survived = frames
                break
            if not n:
                break
            density = replay.simulation.particles.density.to_numpy()[:n]
            p99, _ = compression(density, replay.fluid.rest_density)
            worst = max(worst, p99)
            if not p99 < DIED:
                break
            centre = run.position(frame)[alive].mean(axis=0)
            here = replay.simulation.particles.position.to_numpy()[:n].mean(axis=0)
            if alive.mean() > FEW:
                length += float(np.linalg.norm(centre - last)) if last is not None else 0.0
                distance = max(distance, float(np.linalg.norm(here - centre)))
            if distance > self.extent:
                break
            last = centre
            drained = max(drained, abs(n / len(alive) - float(alive.mean())))
            survived = frame
        return {
            "survived": survived / frames,
            "path_error": distance / max(length, 1e-9),
            "drained_error": drained,
            "compression_p99": worst,
        }
