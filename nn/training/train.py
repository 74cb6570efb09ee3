"""Train PcNet: recorded runs to weights, in one loop.

Three ways to correct (paper, 2.3 and Algorithm 3):

- `bp`: plain back-propagation on recorded frames, the paper's baseline;
- `periodic`: as the paper prints it.  After every a = 5 samples the network of the moment is rolled
  out from the first frame of a sequence to its a-th through the real simulator, and trained on the
  drifted features with the *recorded* acceleration of that frame as target;
- `relabel`: the same rollouts, but the target is what the *physics* does from the drifted state:
  DAgger (Ross, Gordon and Bagnell 2011, arXiv 1011.0686).  A recorded acceleration belongs to a
  state that the network has left: it teaches no way back.

Rollouts run the kernels of `vesselflow run`.  The network that rolls out best on the held-out run
is kept, not the one with the lowest loss.
"""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nn.training.runs import Settings, TrainingRuns
from nn.training.torch_network import TorchNetwork, TrainingSample, as_f32
from nn.weights import Weights
from taichi_sph.errors import InputError, RunError
from taichi_sph.system import replaced

PERIOD = 5
"""a: samples between two corrections (the paper's value)."""

DEVIATION_FLOOR = 1e-3
"""Smallest deviation of an input: what hardly varies in training must not be blown up by it."""

COMPRESSION = 0.01
"""Compression that counts as much as an acceleration wrong by all of its deviation."""


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


class Trainer:
    """A network under training: its optimiser, its loss, and how it is judged."""

    def __init__(self, runs: TrainingRuns, settings: Settings, command: str):
        """Make a network whose inputs are normalised by examples of the runs."""
        torch.manual_seed(settings.seed)
        self.runs = runs
        self.settings = settings
        self.generator = np.random.default_rng(settings.seed)
        self.direct = settings.head == "direct"
        self.training = runs.training(settings, command)
        # Gravity joins the pressure head's sums; the direct head learns it or nothing does.
        self.gravity = torch.tensor((0.0, 0.0, 0.0) if self.direct else runs.scene.gravity)
        features, wanted = runs.examples(16)
        seen = features[:, self.training.columns.index]
        self.typical = float((wanted - self.gravity.numpy()).std())
        """Deviation of the accelerations wanted, gravity left out [m/s^2]."""
        self.network = TorchNetwork(
            self.training,
            seen.mean(axis=0),
            np.maximum(seen.std(axis=0), DEVIATION_FLOOR),
            self.typical / runs.scales.acceleration if self.direct else 1.0,
        )
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=settings.learning_rate)
        self.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            self.optimiser, settings.iterations
        )
        self.pcnet = runs.pcnet(self.network.weights())
        self._huber = torch.nn.HuberLoss(delta=1.0)

    @property
    def parts(self) -> dict[str, Any]:
        """What has a state of its own, by its name in a checkpoint."""
        return {"model": self.network, "optimiser": self.optimiser, "schedule": self.schedule}

    def next_sample(self, iteration: int) -> TrainingSample | None:
        """The sample of a gradient step; None if the network drifted beyond what can be simulated.

        With `periodic` and `relabel` some samples are of states that the network has led to.
        """
        runs, settings = self.runs, self.settings
        run = runs.runs[self.generator.integers(len(runs.runs))]
        correct = settings.correction == "periodic" and iteration % PERIOD == 0
        drift = PERIOD
        if settings.correction == "relabel":
            # As many drifted samples as recorded ones, and drifts that grow.
            correct = iteration % 2 == 0
            reach = 1 + int(settings.drift * min(1.0, 2.0 * iteration / settings.iterations))
            drift = int(self.generator.integers(1, reach + 1))
        frame = int(self.generator.integers(0, max(1, len(run) - drift)))
        runs.put(run, frame)
        try:
            if correct:
                self.pcnet.network.load(self.network.weights())
                runs.advance(self.pcnet, min(drift, len(run) - 1 - frame))
                frame = min(frame + drift, len(run) - 1)
            sample = TrainingSample(
                runs.replay, runs.scales, run.target(frame), run.has_target(frame),
                pairs=not self.direct,
            )  # fmt: skip
            if correct and settings.correction == "relabel":
                rows = sample.identity
                target, valid = runs.relabel()
                sample.target, sample.valid = as_f32(target[rows]), torch.from_numpy(valid[rows])
        except RunError:
            return None
        return sample if sample.valid.any() else None

    def loss_of(self, sample: TrainingSample) -> torch.Tensor:
        """Huber loss of the acceleration; of the pressure head also viscosity and compression."""
        fluid = self.runs.replay.fluid
        prediction = self.network.step(sample, fluid.rest_density, fluid.rheology.eta, self.gravity)
        error = (prediction.acceleration - sample.target)[sample.valid] / self.typical
        if self.direct and len(error) > self.settings.batch:
            error = error[torch.randperm(len(error))[: self.settings.batch]]
        loss = self._huber(error, torch.zeros_like(error))
        if prediction.log_viscosity is not None and prediction.compression is not None:
            wrong = prediction.log_viscosity - sample.log_viscosity
            loss = loss + torch.mean(wrong**2)
            loss = loss + torch.mean((prediction.compression / COMPRESSION) ** 2)
        return loss

    def learn(self, iteration: int) -> float | None:
        """Take a gradient step; returns the loss, None where there was no sample."""
        sample = self.next_sample(iteration)
        loss = None
        if sample is not None:
            loss = self.loss_of(sample)
            self.optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            self.optimiser.step()
        self.schedule.step()
        return None if loss is None else float(loss.detach())

    def validate(self) -> tuple[Weights, dict[str, float]]:
        """Weights of the moment, and their rollout on the first run held out."""
        weights = self.network.weights()
        self.pcnet.network.load(weights)
        return weights, self.runs.rollout(self.pcnet, self.runs.held[0])


def train_weights(
    runs: TrainingRuns,
    out: Path,
    settings: Settings,
    command: str = "",
    report: Callable[[Progress], None] = print,
) -> tuple[Weights, list[dict[str, float]]]:
    """Train on the runs that are not held out; writes `out`.

    The first run held out chooses the weights; nothing looks at the others.
    A training that was cut short goes on from its checkpoint beside `out`, and ends with the same
    weights as one that was not.

    Returns:
        the weights, and the figures of every validation.

    Raises:
        InputError: a checkpoint of another training.
    """
    began = time.perf_counter()
    trainer = Trainer(runs, settings, command)
    identity = {
        **asdict(settings),
        "held_out": runs.held_out,
        "scene_hash": trainer.training.scene_hash,
        "frame_interval": runs.interval,
        "runs": len(runs.runs),
    }
    checkpoint = out.with_name(out.name + ".checkpoint")
    at = _resume(checkpoint, identity, trainer) or Progress()
    before = at.seconds
    losses: list[float] = []  # since the last validation

    while at.iteration < settings.iterations:
        at.iteration += 1
        loss = trainer.learn(at.iteration)
        if loss is not None:
            losses.append(loss)
        if at.iteration % settings.validate_every and at.iteration < settings.iterations:
            continue
        weights, figures = trainer.validate()
        mean = float(np.mean(losses)) if losses else math.nan
        at.history.append({"iteration": at.iteration, "loss": mean, **figures})
        losses.clear()
        if score_of(figures) > at.best:
            at.best = score_of(figures)
            replace(weights, training=replace(trainer.training, validation=figures)).save(out)
        at.seconds = before + time.perf_counter() - began
        _save(checkpoint, identity, trainer, at)
        report(at)
    checkpoint.unlink(missing_ok=True)
    return Weights.load(out), at.history


def _save(path: Path, identity: dict[str, Any], trainer: Trainer, at: Progress) -> None:
    """Write a checkpoint, whole or not at all."""
    with replaced(path) as file:
        torch.save(
            {
                "identity": identity,
                "parts": {name: part.state_dict() for name, part in trainer.parts.items()},
                "generator": trainer.generator.bit_generator.state,
                "torch": torch.get_rng_state(),
                "progress": asdict(at),
            },
            file,
        )


def _resume(path: Path, identity: dict[str, Any], trainer: Trainer) -> Progress | None:
    """Go on from a checkpoint, if there is one.

    Raises:
        InputError: it cannot be read, or is another training's.
    """
    if not path.exists():
        return None
    try:
        saved = torch.load(path, weights_only=True)
    except Exception:  # torch names no errors of its own
        raise InputError(f"{path}: not a checkpoint, or a cut one; delete it") from None
    for name, value in identity.items():
        if saved["identity"].get(name) != value:
            raise InputError(
                f"{path}: holds a training with {name} {saved['identity'].get(name)}, asked for is "
                f"{value}; delete it, or train the same to go on"
            )
    for name, part in trainer.parts.items():
        part.load_state_dict(saved["parts"][name])
    trainer.generator.bit_generator.state = saved["generator"]
    torch.set_rng_state(saved["torch"])
    return Progress(**saved["progress"])
