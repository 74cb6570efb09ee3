"""PcNet: a small network in the place of the physics, in Taichi kernels.

Two heads.  `direct` is the paper's: 23 features in, the acceleration out.  `pressure` gives each
particle two numbers that are not negative, a pressure term p/rho^2 and a viscosity, and the
physics' own pairwise sum applies both sides' numbers: momentum is conserved, the wall pushes in and
viscosity dissipates whatever the weights.  Weakly compressible SPH is the special case in which
the first number is Tait's; trained over a longer step it becomes what that step needs.

    p_i/rho_i^2 = 0.1 (R/T)^2/rho_0 softplus(o_0)
    mu_i        = 0.03 rho_0 R^2/T  sigmoid(o_1)

The factors are the largest that an explicit step T bears (Courant and viscous limits).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import taichi as ti

from nn.features import FeatureScales, features_of
from nn.weights import CLIP, Weights, require_fit
from taichi_sph.acceleration import Fluid, sum_acceleration
from taichi_sph.neighbors import Neighbors
from taichi_sph.particles import Particles
from taichi_sph.rheology import Casson
from taichi_sph.scene import Scene
from taichi_sph.wall import Wall

VARIABLE = Casson(eta=1.0, tau_y=0.0, n=1.0)
"""Tells the pairwise sum that viscosity differs from particle to particle; never evaluated."""
PRESSURE_FACTOR = 0.1
VISCOSITY_FACTOR = 0.03


@dataclass(eq=False)
class Network:
    """The weights in Taichi fields, flat, layer after layer."""

    sizes: tuple[int, ...]
    mean: tuple[float, ...]
    deviation: tuple[float, ...]
    scale: tuple[float, ...]
    weight: ti.Field
    bias: ti.Field

    @property
    def widest(self) -> int:
        """Width of the widest layer after the input."""
        return max(self.sizes[1:])

    @property
    def first_weight(self) -> tuple[int, ...]:
        """Where each layer's weights begin."""
        return tuple(
            sum(a * b for a, b in pairwise(self.sizes[: k + 1])) for k in range(len(self.sizes) - 1)
        )

    @property
    def first_bias(self) -> tuple[int, ...]:
        """Where each layer's biases begin."""
        return tuple(sum(self.sizes[1 : k + 1]) for k in range(len(self.sizes) - 1))

    @classmethod
    def upload(cls, weights: Weights) -> "Network":
        """Fields for these weights."""
        network = cls(
            weights.sizes,
            tuple(map(float, weights.mean)),
            tuple(map(float, weights.deviation)),
            tuple(map(float, weights.scale)),
            ti.field(float, sum(w.size for w, _ in weights.layers)),
            ti.field(float, sum(b.size for _, b in weights.layers)),
        )
        network.load(weights)
        return network

    def load(self, weights: Weights) -> None:
        """Other weights of the same shape and normalisation, as training goes on."""
        self.weight.from_numpy(np.concatenate([w.ravel() for w, _ in weights.layers]))
        self.bias.from_numpy(np.concatenate([b for _, b in weights.layers]))


@ti.func
def evaluate(network: ti.template(), f: ti.template()):
    """Outputs of the network for a feature vector: tanh between layers.

    Everything is unrolled and every vector filled entry by entry: Taichi 1.7.4 miscompiles local
    vectors that are assigned whole and then read.
    """
    x = ti.Vector([0.0] * network.sizes[0])
    for k in ti.static(range(network.sizes[0])):
        z = (f[k] - ti.static(network.mean[k])) * ti.static(1.0 / network.deviation[k])
        x[k] = ti.max(-CLIP, ti.min(CLIP, z))
    hidden = ti.Vector([0.0] * network.widest)
    before = ti.Vector([0.0] * network.widest)
    for layer in ti.static(range(len(network.sizes) - 1)):
        n_in = ti.static(network.sizes[layer])
        n_out = ti.static(network.sizes[layer + 1])
        w_first = ti.static(network.first_weight[layer])
        b_first = ti.static(network.first_bias[layer])
        for o in ti.static(range(n_out)):
            total = network.bias[b_first + o]
            for k in ti.static(range(n_in)):
                if ti.static(layer == 0):
                    total += network.weight[w_first + o * n_in + k] * x[k]
                else:
                    total += network.weight[w_first + o * n_in + k] * before[k]
            if ti.static(layer + 2 < len(network.sizes)):
                total = ti.tanh(total)
            hidden[o] = total
        for o in ti.static(range(n_out)):
            before[o] = hidden[o]
    for o in ti.static(range(network.sizes[-1])):
        hidden[o] = before[o] * ti.static(network.scale[o])
    return hidden


class PcNet:
    """The learned acceleration; stands where `SphAcceleration` stands."""

    name = "pcnet"

    def __init__(self, weights: Weights, fluid: Fluid, capacity: int):
        """Make the scratch fields for `capacity` particles."""
        training = weights.training
        self.training = training
        self.network = Network.upload(weights)
        self.fluid = replace(fluid, rheology=VARIABLE, artificial_viscosity=0.0, nested=False)
        self.scales = scales_of(weights)
        self.pressure_term = ti.field(float, capacity)
        self.viscosity = ti.field(float, capacity)
        self.next_acceleration = ti.Vector.field(
            3, float, capacity if training.head == "direct" else 1
        )
        self.stress = ti.Matrix.field(3, 3, float, 1)

    def accelerate(
        self,
        particles: Particles,
        wall: Wall,
        neighbors: Neighbors,
        gravity: tuple[float, float, float],
    ) -> None:
        """Features and network, then (pressure head) the pairwise sum."""
        if self.training.head == "direct":
            predict_acceleration(
                particles, wall, neighbors, self.fluid, self.scales, self.network,
                self.next_acceleration,
            )  # fmt: skip
            return
        predict_pressure(
            particles, wall, neighbors, self.fluid, self.scales, self.network,
            self.pressure_term, self.viscosity,
        )  # fmt: skip
        sum_acceleration(
            particles, wall, neighbors, self.fluid, self.pressure_term, self.viscosity,
            self.stress, ti.Vector(gravity),
        )  # fmt: skip

    def stable_step(self, largest_speed: float, largest_acceleration: float) -> float:
        """The trained step [s]: a network knows no other."""
        return self.training.frame_interval


def scales_of(weights: Weights) -> FeatureScales:
    """What the weights' features are measured in."""
    t = weights.training
    return FeatureScales(t.support_radius, t.spacing, t.frame_interval, t.sound_speed)


def load_pcnet(path: Path, scene: Scene) -> Callable[[Fluid, int], PcNet]:
    """A maker of PcNet models for `Simulation`, from a weights file for a scene.

    Raises:
        InputError: not weights, or weights for another scene.
    """
    weights = Weights.load(path)
    grid = scene.discretization
    found = {
        "spacing": grid.spacing,
        "support_radius": grid.support_ratio * grid.spacing,
        "wall_spacing_ratio": grid.wall_spacing_ratio,
    }
    require_fit(weights, str(path), found)

    def make(fluid: Fluid, capacity: int) -> PcNet:
        return PcNet(weights, fluid, capacity)

    return make


@ti.kernel
def predict_acceleration(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    scales: ti.template(),
    network: ti.template(),
    out: ti.template(),
):
    """a_i^{n+1} = net(F_i) (paper, Algorithm 2); it knows gravity or nothing does.

    Writes: acceleration, density.
    """
    for i in range(p.count[None]):
        f = features_of(i, p, w, nb, fluid, scales)
        p.density[i] = f[25] * ti.static(fluid.state.rest_density)
        o = evaluate(network, f)
        for a in ti.static(range(3)):
            out[i][a] = o[a] * ti.static(scales.acceleration)
    for i in range(p.count[None]):
        p.acceleration[i] = out[i]


@ti.kernel
def predict_pressure(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    scales: ti.template(),
    network: ti.template(),
    pressure_term: ti.template(),
    viscosity: ti.template(),
):
    """The pressure head's two numbers.  Writes: pressure_term, viscosity, density."""
    rest_density = ti.static(fluid.state.rest_density)
    for i in range(p.count[None]):
        f = features_of(i, p, w, nb, fluid, scales)
        p.density[i] = f[25] * rest_density
        o = evaluate(network, f)
        softplus = ti.max(o[0], 0.0) + ti.log(1.0 + ti.exp(-ti.abs(o[0])))
        pressure_term[i] = ti.static(PRESSURE_FACTOR * scales.speed_limit**2 / rest_density) * (
            softplus
        )
        viscosity[i] = ti.static(
            VISCOSITY_FACTOR * rest_density * scales.support_radius * scales.speed_limit
        ) / (1.0 + ti.exp(-o[1]))
