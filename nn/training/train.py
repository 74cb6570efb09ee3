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
import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nn.dataset.reader import Dataset, Run
from nn.dataset.schema import mean_acceleration
from nn.features import COUNT, NAMES, FeatureScales
from nn.pcnet import LARGEST_EXPONENT, PcNet, largest_factors, make_pcnet
from nn.training.rollout import ReplaySimulation
from nn.weights import CLIP, Training, Weights, dimensionless_numbers
from taichi_sph.diagnostics import FEW, compression
from taichi_sph.errors import InputError, RunError
from taichi_sph.fluid.calibration import softening
from taichi_sph.fluid.implicit import LARGEST_VISCOSITY, LEAST_RESPONSE, RELAXATION
from taichi_sph.fluid.wcsph import AccelerationModel
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.system import replaced

PERIOD = 5
"""a: samples between two corrections (the paper's value)."""

WIDTH = 5
DEPTH = 3
"""Hidden layers and their width: the paper's."""

DEVIATION_FLOOR = 1e-3
"""Inputs that hardly vary in training must not be blown up by their deviation."""

COMPRESSION = 0.01
"""Compression that counts as much as an acceleration wrong by all of its deviation."""

DIED = 0.3
"""99th percentile of compression at which a rollout counts as dead."""

INPUTS = {"direct": NAMES[:COUNT], "pressure": ("N", "D_rv_b", "M", "compression", "divergence")}
"""Features that each head sees by default."""


def use_threads(threads: int | None) -> None:
    """Let torch have so many threads; all of them if None."""
    if threads:
        torch.set_num_threads(threads)


@dataclass(frozen=True)
class Settings:
    """How to train."""

    head: str = "pressure"
    correction: str = "relabel"
    inputs: tuple[str, ...] | None = None
    """Features seen; the head's of INPUTS if None."""
    rounds: int = 0
    """Rounds after the pressure head's guess."""
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


class TrainingSample:
    """A state with its features, the geometry of its pairs and the acceleration wanted."""

    def __init__(
        self,
        stage: ReplaySimulation,
        scales: FeatureScales,
        target: np.ndarray,
        valid: np.ndarray,
        pairs: bool,
    ):
        """Read the stage's lists; `target` [m/s^2] and `valid` go by identity."""
        fluid = stage.fluid
        particles, nb = stage.simulation.particles, stage.simulation.neighbors
        n = particles.count[None]
        identity = particles.identity.to_numpy()[:n]
        self.identity = identity
        self.features = _f32(stage.features(scales)[identity])
        self.target = torch.from_numpy(target[identity].astype(np.float32))
        self.valid = torch.from_numpy(valid[identity])
        if not pairs:
            return
        kernel, factors = fluid.kernel, fluid.calibration
        x = particles.position.to_numpy()[:n].astype(np.float64)
        v = particles.velocity.to_numpy()[:n].astype(np.float64)
        ratio = self.features[:, 25].numpy().astype(np.float64)
        density = ratio * fluid.equation_of_state.rest_density
        i, j = _entries(nb.blood_count.to_numpy()[:n], nb.blood_index.to_numpy()[:n])
        r = x[i] - x[j]
        r2 = (r**2).sum(axis=1)
        near = r2 < kernel.support_radius**2
        i, j, r, r2 = i[near], j[near], r[near], r2[near]
        v_ij = v[i] - v[j]
        slope = factors.mass * kernel.slope_of(np.sqrt(r2))
        eps = softening(kernel)
        self.i, self.j = torch.from_numpy(i), torch.from_numpy(j)
        # a_i = known + sum_j push (P_i + P_j) + drag mu_ij, as `sum_acceleration`; and
        # d(rho_i/rho_0)/dt = squeeze (sum_j push (v_i - v_j) + wall_push v_i).
        self.velocity = _f32(v)
        self.thickness = _f32(np.log(stage.viscosity() / fluid.rheology.eta))
        self.squeeze = -1.0 / (factors.gradient * fluid.equation_of_state.rest_density)
        self.push = _f32((-factors.gradient * slope)[:, None] * r)
        drag = 2.0 * factors.viscosity * slope * r2 / (r2 + eps)
        self.drag = _f32((drag / (density[i] * density[j]))[:, None] * v_ij)
        approach = np.minimum((v_ij * r).sum(axis=1), 0.0) / (r2 + eps)
        damping = 2.0 * fluid.signal * slope * approach / (density[i] + density[j])
        known = _sums(i, damping[:, None] * r, n)
        i, k = _entries(nb.wall_count.to_numpy()[:n], nb.wall_index.to_numpy()[:n])
        r = x[i] - stage.simulation.wall.position.to_numpy()[k]
        r2 = (r**2).sum(axis=1)
        share = (
            fluid.equation_of_state.rest_density
            * stage.simulation.wall.volume.to_numpy()[k]
            * kernel.slope_of(np.sqrt(r2))
        )
        self.wall_push = _f32(
            _sums(i, (-factors.wall_density * factors.gradient * share)[:, None] * r, n)
        )
        drag = 2.0 * factors.wall_friction * share * r2 / ((r2 + eps) * density[i] ** 2)
        self.wall_drag = _f32(np.bincount(i, drag, n)[:, None] * v)
        approach = np.minimum((v[i] * r).sum(axis=1), 0.0) / (r2 + eps)
        damping = factors.wall_density * share * fluid.signal * approach / density[i]
        self.known = _f32(known + _sums(i, damping[:, None] * r, n))


def _sums(i: np.ndarray, values: np.ndarray, n: int) -> np.ndarray:
    """Sums of vectors by row, (n, 3)."""
    return np.stack([np.bincount(i, values[:, a], n) for a in range(3)], 1)


def _f32(a: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(a.astype(np.float32))


def _entries(count: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and entry of every list entry."""
    inside = np.arange(index.shape[1])[None, :] < count[:, None]
    return np.nonzero(inside)[0], index[inside].astype(np.int64)


@dataclass
class Step:
    """What a step of the network does to the blood of a sample."""

    acceleration: torch.Tensor
    """[m/s^2], (n, 3)"""
    thickness: torch.Tensor | None = None
    """ln(mu/eta), (n,), learned from the physics' own viscosity: accelerations hardly teach it."""
    compression: torch.Tensor | None = None
    """max(rho/rho_0 - 1, 0) that is left at the end of the step, (n,)."""


class Model(torch.nn.Module):
    """The same network in torch, with the head's sums."""

    def __init__(self, training: Training, mean: np.ndarray, deviation: np.ndarray, scale: float):
        """Make a network 23-5-5-5-3, or with as many inputs as `training` names."""
        super().__init__()
        self.training_facts = training
        self.columns = list(training.columns.index)
        sizes = (len(self.columns), *([WIDTH] * DEPTH), 3)
        with warnings.catch_warnings():  # of a network without inputs
            warnings.filterwarnings("ignore", message="Initializing zero-element tensors")
            self.layers = torch.nn.ModuleList(
                torch.nn.Linear(a, b) for a, b in itertools.pairwise(sizes)
            )
        self.mean = torch.from_numpy(mean.astype(np.float32))
        self.deviation = torch.from_numpy(deviation.astype(np.float32))
        self.scale = scale
        if training.head == "pressure":
            with torch.no_grad():  # begin nearly as hard and as damped as it may be
                self.layers[-1].bias[:] = torch.tensor((3.0, 3.0, 1.0))

    def outputs(self, features: torch.Tensor) -> torch.Tensor:
        """Outputs of the network for all features (n, 27)."""
        y = ((features[:, self.columns] - self.mean) / self.deviation).clamp(-CLIP, CLIP)
        for layer in self.layers[:-1]:
            y = torch.nn.functional.softsign(layer(y))
        return self.layers[-1](y) * self.scale

    def step(
        self, sample: TrainingSample, rest_density: float, eta: float, gravity: torch.Tensor
    ) -> Step:
        """What a step does to every particle, as `PcNet` does it."""
        t = self.training_facts
        o = self.outputs(sample.features)
        if t.head == "direct":
            return Step(o * (t.support_radius / t.frame_interval**2))
        speed = t.support_radius / t.frame_interval
        f = sample.features
        stiffness, damping = largest_factors(t.rounds)
        compression = f[:, 25] - 1.0
        excess = stiffness * torch.sigmoid(o[:, 0]) * compression
        excess = excess - damping * torch.sigmoid(o[:, 1]) * f[:, 24]
        response = f[:, 26].clamp(min=LEAST_RESPONSE) * (rest_density / speed**2)
        p = excess.clamp(min=0.0) / response
        bound = LARGEST_VISCOSITY * rest_density * t.support_radius * speed
        thickness = o[:, 2:].clamp(max=LARGEST_EXPONENT)
        mu = (eta * torch.exp(thickness.detach())).clamp(max=bound)
        # Not mu[i], whose gradient adds up in an order that varies from run to run.
        mu_i, mu_j = mu.index_select(0, sample.i), mu.index_select(0, sample.j)
        drag = sample.drag * (2.0 * mu_i * mu_j / (mu_i + mu_j))
        rest = sample.known.index_add(0, sample.i, drag) + sample.wall_drag * mu + gravity
        for remaining in range(t.rounds, -1, -1):
            both = p.index_select(0, sample.i) + p.index_select(0, sample.j)
            pairs = sample.push * both[:, None]
            a = rest.index_add(0, sample.i, pairs) + sample.wall_push * p[:, None]
            v = sample.velocity + t.frame_interval * a
            rate = (sample.wall_push * v).sum(dim=1)
            v_ij = v.index_select(0, sample.i) - v.index_select(0, sample.j)
            rate = rate.index_add(0, sample.i, (sample.push * v_ij).sum(dim=1))
            after = compression + t.frame_interval * sample.squeeze * rate
            if remaining:
                p = (p + RELAXATION * after / response).clamp(min=0.0)
        return Step(a, thickness[:, 0], after.clamp(min=0.0))

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


class TrainingRuns:
    """Recorded runs to learn from, some held out, and a stage for their frames."""

    def __init__(self, file: Dataset, held_out: Sequence[int]):
        """Set the stage for the largest run.

        Raises:
            InputError: no such run, or no other.
        """
        self.runs, self.held = file.split(held_out)
        self.held_out = list(held_out)
        self._nets: dict[Any, PcNet] = {}
        facts = self.facts = self.runs[0].facts
        largest = max((*self.runs, *self.held), key=lambda run: run.facts.particles)
        self.scene = largest.scene
        self.stage = ReplaySimulation(self.scene, read_vessel(self.scene), largest.facts.seed)
        low, high = self.stage.simulation.vessel.bounds
        self.extent = float(np.linalg.norm(np.asarray(high) - np.asarray(low)))
        """Diagonal of the vessel's box [m]."""
        self.interval = facts.frame_interval
        ratio = self.scene.discretization.wall_spacing_ratio
        self.scales = FeatureScales(
            facts.support_radius, facts.spacing, self.interval, facts.sound_speed, ratio
        )

    def training(self, settings: Settings, command: str) -> Training:
        """What a network trained here is to remember."""
        facts, liquid = self.facts, dimensionless_numbers(self.stage.fluid)
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
            thickening=liquid["thickening"],
            correction=settings.correction,
            seed=settings.seed,
            scene=facts.scene_name,
            scene_hash=hashlib.sha256(facts.scene.encode()).hexdigest(),
            command=command,
        )

    def pcnet(self, weights: Weights) -> PcNet:
        """The network as `run` has it, without its guard: what dies here must be seen to die.

        One object for all weights that differ in nothing else, since each costs a compilation.
        """
        arrays = tuple(a.tobytes() for a in (weights.mean, weights.deviation, weights.scale))
        training = weights.training
        key = training.head, training.inputs, training.rounds, weights.sizes, arrays
        if key not in self._nets:
            stage = self.stage
            capacity = stage.simulation.particles.capacity
            self._nets[key] = make_pcnet(weights, stage.fluid, self.scales, capacity, guarded=False)
        self._nets[key].network.load(weights)
        return self._nets[key]

    def put(self, run: Run, frame: int) -> None:
        """Put a recorded frame on the stage."""
        self.stage.restore(run.state(frame), frame * self.interval, 0)
        self.stage.set_acceleration(run.acceleration(frame))

    def drive(self, model: AccelerationModel, frames: int) -> None:
        """Advance by so many frames from where the stage stands, and settle.

        Raises:
            RunError: it diverged.
        """
        self.stage.simulation.model, self.stage.simulation.step_limit = model, math.inf
        self.stage.advance_to(self.stage.simulation.time + frames * self.interval)
        self.stage.settle()

    def relabel(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean acceleration [m/s^2] of the physics over the next frame, and where it is valid."""
        stage = self.stage
        before = stage.state()
        stage.use_physics()
        stage.advance_to(stage.simulation.time + self.interval)
        stage.settle()
        after = stage.state()
        target = mean_acceleration(before.velocity, after.velocity, after.alive, self.interval)
        return target, before.alive & after.alive

    def examples(self, frames: int) -> tuple[np.ndarray, np.ndarray]:
        """Features (n, 27) and targets [m/s^2] (n, 3) from frames all over the training runs."""
        inputs, targets = [], []
        for run in self.runs:
            for frame in np.linspace(1, len(run) - 1, frames).astype(int):
                self.put(run, int(frame))
                valid = run.has_target(int(frame))
                inputs.append(self.stage.features(self.scales)[: len(valid)][valid])
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
        stage, frames = self.stage, len(run)
        self.put(run, 0)
        stage.simulation.model, stage.simulation.step_limit = model, math.inf
        distance = length = drained = worst = 0.0
        last = None
        survived = 0
        for frame in range(1, frames + 1):
            alive = run.alive(frame)
            try:
                stage.advance_to(frame * self.interval)  # in several steps, where blood is fast
            except RunError:
                break
            n = stage.simulation.particles.count[None]
            if not alive.any() or (not n and alive.mean() < FEW):
                survived = frames
                break
            if not n:
                break
            density = stage.simulation.particles.density.to_numpy()[:n]
            p99, _ = compression(density, stage.fluid.equation_of_state.rest_density)
            worst = max(worst, p99)
            if not p99 < DIED:
                break
            centre = run.position(frame)[alive].mean(axis=0)
            here = stage.simulation.particles.position.to_numpy()[:n].mean(axis=0)
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


def score_of(figures: dict[str, float]) -> float:
    """One number to choose weights by: survival, less what it got wrong while it lived."""
    wrong = figures["path_error"] + figures["drained_error"] + figures["compression_p99"]
    return figures["survived"] - min(1.0, wrong)


@dataclass
class Progress:
    """Where a training stands; all that a resumed one needs beside the network's tensors."""

    iteration: int = 0
    best: float = -math.inf
    seconds: float = 0.0
    """Wall time so far [s]."""
    history: list[dict[str, float]] = field(default_factory=list)


def train_weights(
    course: TrainingRuns,
    out: Path,
    settings: Settings,
    command: str = "",
    report: Callable[[Progress], None] = print,
) -> tuple[Weights, list[dict[str, float]]]:
    """Train on the runs of a course that are not held out; writes `out`.

    The first run held out chooses the weights; nothing looks at the others.
    A training that was cut short goes on from its checkpoint beside `out`, and ends with the same
    weights as one that was not.

    Returns:
        the weights, and the figures of every validation.

    Raises:
        InputError: a checkpoint of another training.
    """
    torch.manual_seed(settings.seed)
    generator = np.random.default_rng(settings.seed)
    began = time.perf_counter()
    fluid, direct = course.stage.fluid, settings.head == "direct"
    density, eta = fluid.equation_of_state.rest_density, fluid.rheology.eta
    training = course.training(settings, command)
    # Gravity joins the pressure head's sums; the direct head learns it or nothing does.
    gravity = torch.tensor((0.0, 0.0, 0.0) if direct else course.scene.gravity)
    features, wanted = course.examples(16)
    seen = features[:, training.columns.index]
    typical = float((wanted - gravity.numpy()).std())
    unit = course.scales.acceleration
    model = Model(
        training,
        seen.mean(axis=0),
        np.maximum(seen.std(axis=0), DEVIATION_FLOOR),
        typical / unit if direct else 1.0,
    )
    optimiser = torch.optim.Adam(model.parameters(), lr=settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.iterations)
    net = course.pcnet(model.weights())
    huber = torch.nn.HuberLoss(delta=1.0)
    parts = {"model": model, "optimiser": optimiser, "schedule": schedule}
    identity = {
        **asdict(settings),
        "held_out": course.held_out,
        "scene_hash": training.scene_hash,
    }
    identity |= {"frame_interval": course.interval, "runs": len(course.runs)}
    checkpoint = out.with_name(out.name + ".checkpoint")
    at = _resume(checkpoint, identity, parts, generator) or Progress()
    before = at.seconds
    losses: list[float] = []  # since the last validation

    while at.iteration < settings.iterations:
        at.iteration += 1
        sample = _draw(course, settings, at.iteration, generator, net, model)
        if sample is not None:
            found = model.step(sample, density, eta, gravity)
            error = (found.acceleration - sample.target)[sample.valid] / typical
            if direct and len(error) > settings.batch:
                error = error[torch.randperm(len(error))[: settings.batch]]
            loss = huber(error, torch.zeros_like(error))
            if found.thickness is not None and found.compression is not None:
                loss = loss + torch.mean((found.thickness - sample.thickness) ** 2)
                loss = loss + torch.mean((found.compression / COMPRESSION) ** 2)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimiser.step()
            losses.append(float(loss.detach()))
        schedule.step()
        if at.iteration % settings.validate_every and at.iteration < settings.iterations:
            continue
        weights = model.weights()
        net.network.load(weights)
        figures = course.rollout(net, course.held[0])
        mean = float(np.mean(losses)) if losses else math.nan
        at.history.append({"iteration": at.iteration, "loss": mean, **figures})
        losses.clear()
        if score_of(figures) > at.best:
            at.best = score_of(figures)
            replace(weights, training=replace(training, validation=figures)).save(out)
        at.seconds = before + time.perf_counter() - began
        _save(checkpoint, identity, parts, generator, at)
        report(at)
    checkpoint.unlink(missing_ok=True)
    return Weights.load(out), at.history


def _draw(
    course: TrainingRuns,
    settings: Settings,
    iteration: int,
    generator: np.random.Generator,
    net: PcNet,
    model: Model,
) -> TrainingSample | None:
    """The sample of a gradient step; None if the network drifted beyond what can be simulated."""
    run = course.runs[generator.integers(len(course.runs))]
    correct = settings.correction == "periodic" and iteration % PERIOD == 0
    drift = PERIOD
    if settings.correction == "relabel":
        # As many drifted samples as recorded ones, and drifts that grow.
        correct = iteration % 2 == 0
        reach = 1 + int(settings.drift * min(1.0, 2.0 * iteration / settings.iterations))
        drift = int(generator.integers(1, reach + 1))
    frame = int(generator.integers(0, max(1, len(run) - drift)))
    course.put(run, frame)
    try:
        if correct:
            net.network.load(model.weights())
            course.drive(net, min(drift, len(run) - 1 - frame))
            frame = min(frame + drift, len(run) - 1)
        sample = TrainingSample(
            course.stage, course.scales, run.target(frame), run.has_target(frame),
            pairs=settings.head != "direct",
        )  # fmt: skip
        if correct and settings.correction == "relabel":
            rows = sample.identity
            target, valid = course.relabel()
            sample.target, sample.valid = _f32(target[rows]), torch.from_numpy(valid[rows])
    except RunError:
        return None
    return sample if sample.valid.any() else None


def _save(
    path: Path,
    identity: dict[str, Any],
    parts: dict[str, Any],
    generator: np.random.Generator,
    at: Progress,
) -> None:
    """Write a checkpoint, whole or not at all."""
    with replaced(path) as file:
        torch.save(
            {
                "identity": identity,
                "parts": {name: part.state_dict() for name, part in parts.items()},
                "generator": generator.bit_generator.state,
                "torch": torch.get_rng_state(),
                "progress": asdict(at),
            },
            file,
        )


def _resume(
    path: Path, identity: dict[str, Any], parts: dict[str, Any], generator: np.random.Generator
) -> Progress | None:
    """Go on from a checkpoint, if there is one.

    Raises:
        InputError: it cannot be read, or is another training's.
    """
    if not path.exists():
        return None
    try:
        found = torch.load(path, weights_only=True)
    except Exception:  # torch names no errors of its own
        raise InputError(f"{path}: not a checkpoint, or a cut one; delete it") from None
    for name, value in identity.items():
        if found["identity"].get(name) != value:
            raise InputError(
                f"{path}: holds a training with {name} {found['identity'].get(name)}, asked for is "
                f"{value}; delete it, or train the same to go on"
            )
    for name, part in parts.items():
        part.load_state_dict(found["parts"][name])
    generator.bit_generator.state = found["generator"]
    torch.set_rng_state(found["torch"])
    return Progress(**found["progress"])
