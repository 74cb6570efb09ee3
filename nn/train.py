"""Train PcNet: record -> weights, one flat loop.

Three ways to correct (paper, 2.3 and Algorithm 3):

- `bp`: plain back-propagation on recorded frames, the paper's baseline;
- `periodic`: as the paper prints it.  After every a = 5 samples the network of the moment is rolled
  out from the first frame of a sequence to its a-th through the real simulator, and trained on the
  drifted features with the *recorded* acceleration of that frame as target;
- `relabel`: the same rollouts, but the target is what the *physics* does from the drifted state.
  A recorded acceleration belongs to a state that the network has left: it teaches no way back.

Rollouts run the kernels of `vesselflow run`.  The network that rolls out best on the held-out run
is kept, not the one with the lowest loss.
"""

import hashlib
import itertools
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from nn.dataset import Dataset, Run
from nn.features import COUNT, EXTENDED, FeatureScales
from nn.pcnet import PRESSURE_FACTOR, VISCOSITY_FACTOR, PcNet
from nn.stage import Stage
from nn.weights import CLIP, Training, Weights
from taichi_sph.calibration import softening
from taichi_sph.errors import InputError, RunError
from taichi_sph.vessel import read_vessel

PERIOD = 5
"""a: samples between two corrections (the paper's value)."""

WIDTH = 5
DEPTH = 3
"""Hidden layers and their width: the paper's."""

DEVIATION_FLOOR = 1e-3
"""Inputs that hardly vary in training must not be blown up by their deviation."""


@dataclass(frozen=True)
class Settings:
    """How to train."""

    head: str = "pressure"
    correction: str = "relabel"
    iterations: int = 1600
    """Gradient steps."""
    batch: int = 4096
    """Particles a step of the direct head; the pressure head takes the whole frame."""
    learning_rate: float = 5e-3
    seed: int = 0
    drift: int = 10
    """Longest rollout before a drifted sample, reached halfway (relabel) [frames]."""
    validate_every: int = 200
    """Gradient steps between two rollouts on the held-out run."""
    minutes: float = 20.0
    """Stop after this much wall time."""


class Sample:
    """A state with its features, the geometry of its pairs and the acceleration wanted."""

    def __init__(
        self,
        stage: Stage,
        scales: FeatureScales,
        target: np.ndarray,
        valid: np.ndarray,
        pairs: bool,
    ):
        """Read the stage's lists; `target` [m/s^2] and `valid` go by identity."""
        fluid = stage.fluid
        particles, nb = stage.particles, stage.neighbors
        n = particles.count[None]
        identity = particles.identity.to_numpy()[:n]
        self.features = _f32(stage.features(scales)[identity])
        self.target = torch.from_numpy(target[identity].astype(np.float32))
        self.valid = torch.from_numpy(valid[identity])
        if not pairs:
            return
        kernel, factors = fluid.kernel, fluid.calibration
        x = particles.position.to_numpy()[:n].astype(np.float64)
        v = particles.velocity.to_numpy()[:n].astype(np.float64)
        density = (stage.density_ratio(scales)[identity] * fluid.state.rest_density).astype(
            np.float64
        )
        i, j = _entries(nb.blood_count.to_numpy()[:n], nb.blood_index.to_numpy()[:n])
        r = x[i] - x[j]
        r2 = (r**2).sum(axis=1)
        near = r2 < kernel.support_radius**2
        i, j, r, r2 = i[near], j[near], r[near], r2[near]
        slope = kernel.slope_of(np.sqrt(r2))
        eps = softening(kernel)
        self.i, self.j = torch.from_numpy(i), torch.from_numpy(j)
        # a_i = sum_j push (P_i + P_j) + drag mu_ij, as `sum_acceleration`.
        self.push = _f32((-factors.mass * factors.gradient * slope)[:, None] * r)
        drag = 2.0 * factors.viscosity * factors.mass * slope * r2 / (r2 + eps)
        self.drag = _f32((drag / (density[i] * density[j]))[:, None] * (v[i] - v[j]))
        i, k = _entries(nb.wall_count.to_numpy()[:n], nb.wall_index.to_numpy()[:n])
        r = x[i] - stage.wall.position.to_numpy()[k]
        r2 = (r**2).sum(axis=1)
        share = (
            fluid.state.rest_density
            * stage.wall.volume.to_numpy()[k]
            * kernel.slope_of(np.sqrt(r2))
        )
        push = (-factors.wall_density * factors.gradient * share)[:, None] * r
        drag = 2.0 * factors.wall_friction * share * r2 / ((r2 + eps) * density[i] ** 2)
        self.wall_push = _f32(np.stack([np.bincount(i, push[:, a], n) for a in range(3)], 1))
        self.wall_drag = _f32(np.bincount(i, drag, n)[:, None] * v)


def _f32(a: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(a.astype(np.float32))


def _entries(count: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and entry of every list entry."""
    inside = np.arange(index.shape[1])[None, :] < count[:, None]
    return np.nonzero(inside)[0], index[inside].astype(np.int64)


class Model(torch.nn.Module):
    """The same network in torch, with the head's sums."""

    def __init__(self, training: Training, mean: np.ndarray, deviation: np.ndarray, scale: float):
        """Make a network 23-5-5-5-3, or 25-5-5-5-2 for the pressure head."""
        super().__init__()
        self.training_facts = training
        direct = training.head == "direct"
        sizes = (COUNT if direct else EXTENDED, *([WIDTH] * DEPTH), 3 if direct else 2)
        self.layers = torch.nn.ModuleList(
            torch.nn.Linear(a, b) for a, b in itertools.pairwise(sizes)
        )
        self.mean = torch.from_numpy(mean.astype(np.float32))
        self.deviation = torch.from_numpy(deviation.astype(np.float32))
        self.scale = scale

    def outputs(self, features: torch.Tensor) -> torch.Tensor:
        """Outputs of the network for dimensionless features (n, in)."""
        y = ((features[:, : len(self.mean)] - self.mean) / self.deviation).clamp(-CLIP, CLIP)
        for layer in self.layers[:-1]:
            y = torch.tanh(layer(y))
        return self.layers[-1](y) * self.scale

    def acceleration(self, sample: Sample, rest_density: float) -> torch.Tensor:
        """Acceleration without gravity [m/s^2] of every particle of a sample."""
        t = self.training_facts
        o = self.outputs(sample.features)
        if t.head == "direct":
            return o * (t.support_radius / t.frame_interval**2)
        speed = t.support_radius / t.frame_interval
        p = torch.nn.functional.softplus(o[:, :1]) * (PRESSURE_FACTOR * speed**2 / rest_density)
        mu = torch.sigmoid(o[:, 1:]) * (VISCOSITY_FACTOR * rest_density * t.support_radius * speed)
        mu_i, mu_j = mu[sample.i], mu[sample.j]
        pairs = sample.push * (p[sample.i] + p[sample.j])
        pairs = pairs + sample.drag * (2.0 * mu_i * mu_j / (mu_i + mu_j))
        a = torch.zeros_like(sample.wall_push).index_add(0, sample.i, pairs)
        return a + sample.wall_push * p + sample.wall_drag * mu

    def weights(self) -> Weights:
        """Raw arrays of the network."""
        layers = tuple(
            (x.weight.detach().numpy().copy(), x.bias.detach().numpy().copy()) for x in self.layers
        )
        outputs = layers[-1][1].shape[0]
        return Weights(
            layers,
            self.mean.numpy(),
            self.deviation.numpy(),
            np.full(outputs, self.scale, np.float32),
            self.training_facts,
        )


def _drive(stage: Stage, model: object, steps: int, interval: float) -> None:
    """Take `steps` steps of the network from where the stage stands, and settle."""
    stage.model, stage.step_limit = model, math.inf  # type: ignore[assignment]
    for _ in range(steps):
        stage.step(interval)
    stage.settle()


def _put(stage: Stage, run: Run, frame: int) -> None:
    """Put the stage into a recorded frame."""
    stage.restore(run.state(frame), frame * run.facts.frame_interval, 0)
    stage.set_acceleration(run.acceleration(frame))


def _relabel(stage: Stage, physics: object, interval: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean acceleration [m/s^2] that the physics gives over the next interval, and where valid."""
    before = stage.state()
    stage.model, stage.step_limit = physics, stage.derived.step  # type: ignore[assignment]
    stage.advance_to(stage.time + interval)
    stage.settle()
    after = stage.state()
    target = (after.velocity.astype(np.float64) - before.velocity) / interval
    return np.where(after.alive[:, None], target, 0.0), before.alive & after.alive


def rollout(stage: Stage, model: object, run: Run, frames: int | None = None) -> dict[str, float]:
    """Roll a model out from the first frame of a recorded run and compare.

    Returns: survived (fraction of frames before it died: diverged or 99th percentile of
    compression over 30 %), path_error (largest distance of the centres of mass over the recorded
    path's length), drained_error (largest difference of the drained fraction), compression_p99.
    """
    interval = run.facts.frame_interval
    frames = frames or len(run)
    _put(stage, run, 0)
    stage.model, stage.step_limit = model, math.inf  # type: ignore[assignment]
    distance = length = drained = worst = 0.0
    last = None
    survived = 0
    for frame in range(1, frames + 1):
        alive = run.alive(frame)
        try:
            stage.step(interval)
        except RunError:
            break
        n = stage.particles.count[None]
        if not n or not alive.any():
            survived = frames
            break
        density = stage.particles.density.to_numpy()[:n] / stage.fluid.state.rest_density
        compression = float(np.percentile(np.maximum(density - 1.0, 0.0), 99))
        worst = max(worst, compression)
        if not compression < 0.3:
            break
        survived = frame
        centre = run.position(frame)[alive].mean(axis=0)
        here = stage.particles.position.to_numpy()[:n].mean(axis=0)
        # Few drops say little of a centre of mass.
        if alive.mean() > 0.2:
            length += float(np.linalg.norm(centre - last)) if last is not None else 0.0
            distance = max(distance, float(np.linalg.norm(here - centre)))
        last = centre
        drained = max(drained, abs(n / len(alive) - float(alive.mean())))
    return {
        "survived": survived / frames,
        "path_error": distance / max(length, 1e-9),
        "drained_error": drained,
        "compression_p99": worst,
    }


def score_of(figures: dict[str, float]) -> float:
    """One number to choose weights by: survival, less what it got wrong while it lived."""
    wrong = figures["path_error"] + figures["drained_error"] + figures["compression_p99"]
    return figures["survived"] - min(1.0, wrong)


def train_weights(
    data: Path,
    out: Path,
    settings: Settings,
    held_out: int,
    command: str = "",
    report: Callable[[str], None] = print,
) -> Weights:
    """Train on all runs of a file but one, which chooses the weights; writes `out`.

    Raises:
        InputError: no such run, or fewer than two.
    """
    torch.manual_seed(settings.seed)
    generator = np.random.default_rng(settings.seed)
    begin = time.perf_counter()
    with Dataset(data) as file:
        runs, (held,) = file.split([held_out])
        if not runs:
            raise InputError(f"{data}: has one run; training needs one more than it holds out")
        largest = max((*runs, held), key=lambda run: run.facts.particles)
        scene = largest.scene
        stage = Stage(scene, read_vessel(scene), largest.facts.seed)
        facts, fluid = held.facts, stage.fluid
        interval = facts.frame_interval
        physics = stage.model
        direct = settings.head == "direct"
        training = Training(
            head=settings.head,
            spacing=facts.spacing,
            support_radius=facts.support_radius,
            frame_interval=interval,
            substeps=facts.substeps,
            sound_speed=facts.sound_speed,
            wall_spacing_ratio=scene.discretization.wall_spacing_ratio,
            correction=settings.correction,
            seed=settings.seed,
            scene=facts.scene_name,
            scene_hash=hashlib.sha256(facts.scene.encode()).hexdigest(),
            command=command,
        )
        scales = FeatureScales(facts.support_radius, facts.spacing, interval, facts.sound_speed)
        gravity = torch.tensor(() if direct else scene.gravity, dtype=torch.float32)

        # What inputs and targets are like, from frames all over the training runs.
        inputs, targets = [], []
        for run in runs:
            for frame in np.linspace(1, len(run) - 1, 16).astype(int):
                _put(stage, run, int(frame))
                valid = run.has_target(int(frame))
                inputs.append(stage.features(scales)[: len(valid)][valid])
                targets.append(run.target(int(frame))[valid])
        everything = np.concatenate(inputs)
        wanted = np.concatenate(targets) - (0.0 if direct else np.asarray(scene.gravity))
        width = COUNT if direct else EXTENDED
        mean = everything[:, :width].mean(axis=0)
        deviation = np.maximum(everything[:, :width].std(axis=0), DEVIATION_FLOOR)
        typical = float(wanted.std())
        unit = facts.support_radius / interval**2
        model = Model(training, mean, deviation, typical / unit if direct else 1.0)
        if not direct:
            with torch.no_grad():  # begin with next to no pressure and little viscosity
                model.layers[-1].bias[:] = torch.tensor([-3.0, -5.0])
        optimiser = torch.optim.Adam(model.parameters(), lr=settings.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.iterations)
        net = PcNet(model.weights(), fluid, stage.particles.capacity)
        best: tuple[float, Weights] | None = None
        history = []
        losses: list[float] = []
        physics_loss = torch.nn.HuberLoss(delta=1.0)

        for iteration in range(1, settings.iterations + 1):
            run = runs[generator.integers(len(runs))]
            correct = settings.correction != "bp" and iteration % PERIOD == 0
            if settings.correction == "relabel":
                # As many drifted samples as recorded ones, and drifts that grow.
                correct = iteration % 2 == 0
                reach = 1 + int(settings.drift * min(1.0, 2.0 * iteration / settings.iterations))
                drift = int(generator.integers(1, reach + 1))
            else:
                drift = PERIOD
            frame = int(generator.integers(0, len(run) - drift))
            _put(stage, run, frame)
            try:
                if correct:
                    net.network.load(model.weights())
                    _drive(stage, net, drift, interval)
                frame += drift if correct else 0
                valid = run.has_target(frame)
                sample = Sample(stage, scales, run.target(frame), valid, pairs=not direct)
                if correct and settings.correction == "relabel":
                    rows = stage.particles.identity.to_numpy()[: stage.particles.count[None]]
                    target, valid = _relabel(stage, physics, interval)
                    sample.target = _f32(target[rows])
                    sample.valid = torch.from_numpy(valid[rows])
            except RunError:
                continue  # drifted beyond what the simulator bears: nothing to learn there
            if not sample.valid.any():
                continue
            error = model.acceleration(sample, fluid.state.rest_density) - sample.target
            error = (error + (0.0 if direct else gravity))[sample.valid] / typical
            if direct and len(error) > settings.batch:
                error = error[torch.randperm(len(error))[: settings.batch]]
            loss = physics_loss(error, torch.zeros_like(error))
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimiser.step()
            schedule.step()
            losses.append(float(loss.detach()))
            late = time.perf_counter() - begin > 60.0 * settings.minutes
            if iteration % settings.validate_every == 0 or late or iteration == settings.iterations:
                weights = model.weights()
                net.network.load(weights)
                figures = rollout(stage, net, held)
                score = score_of(figures)
                history.append({"iteration": iteration, "loss": float(np.mean(losses)), **figures})
                losses = []
                report(
                    f"{iteration:6d}  loss {history[-1]['loss']:.4f}  "
                    + "  ".join(f"{k} {v:.3f}" for k, v in figures.items())
                    + f"  {time.perf_counter() - begin:.0f} s"
                )
                if best is None or score > best[0]:
                    best = score, replace(weights, training=replace(training, validation=figures))
                    best[1].save(out)
                out.with_suffix(".history.json").write_text(json.dumps(history, indent=1))
            if late:
                break
    assert best is not None
    return best[1]


__all__ = ["Settings", "rollout", "train_weights"]
