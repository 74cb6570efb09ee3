"""The network in torch, with the sums of its head, and what it learns from in one sample."""

import itertools
import warnings
from dataclasses import dataclass

import numpy as np
import torch

from nn.features import DENSITY_RATIO, DIVERGENCE, RESPONSE, FeatureScales
from nn.pcnet import LARGEST_EXPONENT, largest_factors
from nn.training.rollout import ReplaySimulation
from nn.weights import CLIP, Training, Weights
from taichi_sph.fluid.implicit import LARGEST_VISCOSITY, RELAXATION, SMALLEST_DIAGONAL

WIDTH = 5
DEPTH = 3
"""Hidden layers and their width: the paper's."""


def use_threads(threads: int | None) -> None:
    """Let torch have so many threads; all of them if None."""
    if threads:
        torch.set_num_threads(threads)


def as_f32(a: np.ndarray) -> torch.Tensor:
    """Tensor of an array, single precision, same shape."""
    return torch.from_numpy(a.astype(np.float32))


class TrainingSample:
    """A state with its features, the geometry of its pairs and the acceleration wanted.

    With q_i = p_i/rho_i^2 the accelerations of `sum_acceleration`, and the rate of the density are

        a_i = other_i + sum_j (by_pressure_ij (q_i + q_j) + by_viscosity_ij mu_ij)
                      + wall_by_pressure_i q_i + wall_by_viscosity_i mu_i + g
        d(rho_i/rho_0)/dt = rate_factor (sum_j by_pressure_ij.v_ij + wall_by_pressure_i.v_i)

    `other` is what the kernel gives without pressure and viscosity: any further term of the
    equation is in it.
    """

    def __init__(
        self,
        replay: ReplaySimulation,
        scales: FeatureScales,
        target: np.ndarray,
        valid: np.ndarray,
        pairs: bool,
    ):
        """Read the lists of a replay; `target` [m/s^2] and `valid` go by identity."""
        particles = replay.simulation.particles
        self.identity = particles.identity.to_numpy()[: particles.count[None]]
        self.features = as_f32(replay.features(scales)[self.identity])
        self.target = as_f32(target[self.identity])
        self.valid = torch.from_numpy(valid[self.identity])
        if pairs:
            self._read_pairs(replay)

    def _read_pairs(self, replay: ReplaySimulation) -> None:
        """Geometry of the pairs of blood and of the wall, and all but pressure and viscosity."""
        fluid, blood = replay.fluid, replay.simulation.blood
        factors, eps, n = fluid.calibration, fluid.softening, len(self.identity)
        x = blood.particles.position.to_numpy()[:n].astype(np.float64)
        v = blood.particles.velocity.to_numpy()[:n].astype(np.float64)
        density = fluid.rest_density * self.features[:, DENSITY_RATIO].numpy().astype(np.float64)
        self.velocity = as_f32(v)
        self.log_viscosity = as_f32(np.log(replay.viscosity() / fluid.rheology.eta))
        """ln(mu/eta) of the physics, (n,)."""
        self.other = as_f32(replay.other_acceleration())
        self.rate_factor = -1.0 / (factors.gradient * fluid.rest_density)

        lists = blood.neighbors
        i, j = _entries(lists.blood_count.to_numpy()[:n], lists.blood_index.to_numpy()[:n])
        r = x[i] - x[j]
        r2 = (r**2).sum(axis=1)
        near = r2 < fluid.kernel.support_radius**2
        i, j, r, r2 = i[near], j[near], r[near], r2[near]
        slope = factors.mass * fluid.kernel.slope_of(np.sqrt(r2))
        self.i, self.j = torch.from_numpy(i), torch.from_numpy(j)
        self.by_pressure = as_f32((-factors.gradient * slope)[:, None] * r)
        drag = 2.0 * factors.viscosity * slope * r2 / ((r2 + eps) * density[i] * density[j])
        self.by_viscosity = as_f32(drag[:, None] * (v[i] - v[j]))

        i, k = _entries(lists.wall_count.to_numpy()[:n], lists.wall_index.to_numpy()[:n])
        r = x[i] - blood.wall.position.to_numpy()[k]
        r2 = (r**2).sum(axis=1)
        mass = fluid.rest_density * blood.wall.volume.to_numpy()[k]
        slope = mass * fluid.kernel.slope_of(np.sqrt(r2))
        push = (-factors.wall_density * factors.gradient * slope)[:, None] * r
        self.wall_by_pressure = as_f32(
            np.stack([np.bincount(i, push[:, a], n) for a in range(3)], 1)
        )
        slope *= blood.wall.friction.to_numpy()[k]
        drag = 2.0 * factors.wall_friction * slope * r2 / ((r2 + eps) * density[i] ** 2)
        self.wall_by_viscosity = as_f32(np.bincount(i, drag, n)[:, None] * v)


def _entries(count: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and entry of every list entry."""
    inside = np.arange(index.shape[1])[None, :] < count[:, None]
    return np.nonzero(inside)[0], index[inside].astype(np.int64)


@dataclass
class Prediction:
    """What a step of the network does to the blood of a sample."""

    acceleration: torch.Tensor
    """[m/s^2], (n, 3)"""
    log_viscosity: torch.Tensor | None = None
    """ln(mu/eta), (n,), learned from the physics' own viscosity: accelerations hardly teach it."""
    compression: torch.Tensor | None = None
    """max(rho/rho_0 - 1, 0) that is left at the end of the step, (n,)."""


class TorchNetwork(torch.nn.Module):
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
        self.mean = as_f32(mean)
        self.deviation = as_f32(deviation)
        self.scale = scale
        if training.head == "pressure":
            with torch.no_grad():  # begin nearly as hard and as damped as it may be
                self.layers[-1].bias[:] = torch.tensor((3.0, 3.0, 1.0))

    def outputs(self, features: torch.Tensor) -> torch.Tensor:
        """Outputs of the network, (n, 3), for all rows of the features, (n, ROW_COUNT)."""
        y = ((features[:, self.columns] - self.mean) / self.deviation).clamp(-CLIP, CLIP)
        for layer in self.layers[:-1]:
            y = torch.nn.functional.softsign(layer(y))
        return self.layers[-1](y) * self.scale

    def step(
        self, sample: TrainingSample, rest_density: float, eta: float, gravity: torch.Tensor
    ) -> Prediction:
        """What a step does to every particle, as `nn.pcnet` does it."""
        t = self.training_facts
        o = self.outputs(sample.features)
        if t.head == "direct":
            return Prediction(o * (t.support_radius / t.frame_interval**2))
        speed = t.support_radius / t.frame_interval
        f = sample.features
        stiffness, damping = largest_factors(t.rounds)
        compression = f[:, DENSITY_RATIO] - 1.0
        excess = stiffness * torch.sigmoid(o[:, 0]) * compression
        excess = excess - damping * torch.sigmoid(o[:, 1]) * f[:, DIVERGENCE]
        diagonal = f[:, RESPONSE].clamp(min=SMALLEST_DIAGONAL) * (rest_density / speed**2)
        q = excess.clamp(min=0.0) / diagonal
        bound = LARGEST_VISCOSITY * rest_density * t.support_radius * speed
        log_viscosity = o[:, 2:].clamp(max=LARGEST_EXPONENT)
        mu = (eta * torch.exp(log_viscosity.detach())).clamp(max=bound)
        # Not mu[i], whose gradient adds up in an order that varies from run to run.
        mu_i, mu_j = mu.index_select(0, sample.i), mu.index_select(0, sample.j)
        drag = sample.by_viscosity * (2.0 * mu_i * mu_j / (mu_i + mu_j))
        rest = sample.other.index_add(0, sample.i, drag) + sample.wall_by_viscosity * mu + gravity
        for remaining in range(t.rounds, -1, -1):
            q_ij = q.index_select(0, sample.i) + q.index_select(0, sample.j)
            pairs = sample.by_pressure * q_ij[:, None]
            a = rest.index_add(0, sample.i, pairs) + sample.wall_by_pressure * q[:, None]
            v = sample.velocity + t.frame_interval * a
            rate = (sample.wall_by_pressure * v).sum(dim=1)
            v_ij = v.index_select(0, sample.i) - v.index_select(0, sample.j)
            rate = rate.index_add(0, sample.i, (sample.by_pressure * v_ij).sum(dim=1))
            after = compression + t.frame_interval * sample.rate_factor * rate
            if remaining:
                q = (q + RELAXATION * after / diagonal).clamp(min=0.0)
        return Prediction(a, log_viscosity[:, 0], after.clamp(min=0.0))

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
