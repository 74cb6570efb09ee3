"""PcNet: a small network in the place of the physics, in Taichi kernels.

Two heads, each a network with three outputs.  `direct` is the paper's: 23 features in, the
acceleration out.  `pressure` looks at two more (density is not among the paper's) and gives three
coefficients of the physics' own pairwise sum, none of them negative: momentum is conserved, blood
is pushed apart, the wall pushes in and viscosity dissipates whatever the weights.

    p_i/rho_i^2 = max(0, k_i (rho_i/rho_0 - 1) - g_i T div v_i) / (T^2 rho_0 D_i)
    mu_i        = min(eta exp(o_2), 0.03 rho_0 R^2/T)
    k_i = sigmoid(o_0),  g_i = 0.3 sigmoid(o_1)          (0.8 and 0.1 without iterations)

It is the initial pressure of `taichi_sph.fluid.implicit`, whose iterations follow: as many as the
weights were trained with.  Without any, a step is stable where k + 2 g stays under 4/3.8; the
factors hold that, and what the iterations need, for any weights.  Weakly compressible SPH,
linearised, is k = (c T/R)^2 R^2 D, g = 0.  Viscosity is learned as a multiple of the blood's own
at high shear, eta; its bound is what an explicit step T bears (Morris et al. 1997).  Monaghan's
artificial term stays as the scene has it.

Everything is dimensionless, so weights serve any spacing whose scene has the same proportions:
the step is T = C R/c with the trained C, the sound speed c and the support radius R the scene's.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import taichi as ti

from nn.features import (
    DENSITY_RATIO,
    DIVERGENCE,
    RESPONSE,
    FeatureScales,
    Inputs,
    features_of,
)
from nn.weights import CLIP, Weights, dimensionless_numbers, require_fit
from taichi_sph.fluid.implicit import (
    DAMPING,
    LARGEST_ADVECTIVE_CFL,
    LARGEST_VISCOSITY,
    SMALLEST_DIAGONAL,
    STIFFNESS,
    ImplicitAcceleration,
    advective_step,
)
from taichi_sph.fluid.model import Fluid
from taichi_sph.fluid.rheology import Casson
from taichi_sph.fluid.wcsph import SphAcceleration
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.wall import Wall
from taichi_sph.scene import Scene

VARIABLE = Casson(eta=1.0, tau_y=0.0, n=1.0)
"""Tells the pairwise sum that viscosity differs from particle to particle; never evaluated."""
LARGEST_EXPONENT = 10.0
"""Keeps exp finite in single precision, long after the bound has taken over."""
LARGEST_COMPRESSION = 0.1
"""What the direct head may let happen; the physics stays under 0.02."""


def largest_factors(iterations: int) -> tuple[float, float]:
    """Bounds of k and g that keep any weights stable, with so many iterations."""
    return (STIFFNESS, DAMPING) if iterations else (0.8, 0.1)


@dataclass(eq=False)
class Network:
    """The weights in Taichi fields, flat, layer after layer."""

    inputs: Inputs
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
            weights.training.columns,
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
    """Outputs of the network for a feature vector: softsign, x/(1 + |x|), between layers.

    The paper names no activation; tanh costs ten times as much, more than all the features.

    Everything is unrolled and every vector filled entry by entry: Taichi 1.7.4 miscompiles local
    vectors that are assigned whole and then read.
    """
    x = ti.Vector([0.0] * (network.sizes[0] + 1))  # no network is too small for a vector
    for k in ti.static(range(network.sizes[0])):
        z = (f[ti.static(network.inputs.index[k])] - ti.static(network.mean[k])) * ti.static(
            1.0 / network.deviation[k]
        )
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
                total = total / (1.0 + ti.abs(total))
            hidden[o] = total
        for o in ti.static(range(n_out)):
            before[o] = hidden[o]
    for o in ti.static(range(network.sizes[-1])):
        hidden[o] = before[o] * ti.static(network.scale[o])
    return hidden


class DirectPcNet:
    """The paper's head: the network gives the acceleration itself.

    Nothing keeps it from running away: while a particle is compressed or fast beyond all training,
    the physics takes over.
    """

    name = "pcnet"
    largest_viscosity = math.inf

    def __init__(
        self,
        weights: Weights,
        fluid: Fluid,
        scales: FeatureScales,
        capacity: int,
        guarded: bool = True,
    ):
        """Make the scratch fields for `capacity` particles."""
        self.network = Network.upload(weights)
        self.fluid = replace(fluid, rheology=VARIABLE, nested=False)
        self.sound_speed = fluid.sound_speed
        self.scales = scales
        self.physics = SphAcceleration(fluid, capacity)
        self.guarded = guarded
        """Whether the physics may take over."""
        self.used_fallback = False
        self.next_acceleration = ti.Vector.field(3, float, capacity)

    @property
    def interval(self) -> float:
        """Present step T [s]."""
        return self.scales.frame_interval * (self.fluid.sound_speed / self.sound_speed)

    @property
    def pair_coefficients(self) -> tuple[Fluid, ti.Field, ti.Field, float] | None:
        """Forces come from pairs only where the physics took over."""
        return self.physics.pair_coefficients if self.used_fallback else None

    def accelerate(
        self,
        particles: Particles,
        wall: Wall,
        neighbors: Neighbors,
        gravity: tuple[float, float, float],
    ) -> None:
        """Features and network; or the physics."""
        alarms = predict_acceleration(
            particles, wall, neighbors, self.fluid, self.scales, self.network,
            self.next_acceleration, self.interval,
        )  # fmt: skip
        self.used_fallback = self.guarded and alarms > 0
        if self.used_fallback:
            self.physics.sound_speed = self.sound_speed
            self.physics.accelerate(particles, wall, neighbors, gravity)
        else:
            copy_vectors(particles, self.next_acceleration)

    def stable_step(self, largest_speed: float, largest_acceleration: float) -> float:
        """The trained step [s], or less: LARGEST_ADVECTIVE_CFL at most, or the physics' own."""
        if self.used_fallback:
            return self.physics.stable_step(largest_speed, largest_acceleration)
        return advective_step(self.interval, self.scales.support_radius, largest_speed)


class PressurePcNet:
    """The default head: the network estimates the initial pressure of the implicit model.

    It cannot run away, and the physics must not guard it: what a soft pressure has let come close,
    stiff physics throws apart.  (It killed a run that lives without.)
    """

    name = "pcnet"
    used_fallback = False

    def __init__(self, weights: Weights, fluid: Fluid, scales: FeatureScales, capacity: int):
        """Make the scratch fields for `capacity` particles."""
        self.network = Network.upload(weights)
        self.scales = scales
        self.eta = fluid.rheology.eta
        self.implicit = ImplicitAcceleration(
            replace(fluid, rheology=VARIABLE), capacity, scales.frame_interval,
            weights.training.rounds, self.estimate, self.name,
        )  # fmt: skip
        self.accelerate = self.implicit.accelerate
        self.stable_step = self.implicit.stable_step

    @property
    def sound_speed(self) -> float:
        """Present sound speed c [m/s]: the implicit model's."""
        return self.implicit.sound_speed

    @sound_speed.setter
    def sound_speed(self, sound_speed: float) -> None:
        self.implicit.sound_speed = sound_speed

    @property
    def largest_viscosity(self) -> float:
        """Bound of mu [Pa s]: the implicit model's."""
        return self.implicit.largest_viscosity

    @property
    def pair_coefficients(self) -> tuple[Fluid, ti.Field, ti.Field, float]:
        """Constants, p/rho^2, mu and c of the implicit model."""
        return self.implicit.pair_coefficients

    def estimate(
        self, particles: Particles, wall: Wall, neighbors: Neighbors, model: ImplicitAcceleration
    ) -> None:
        """Estimate the initial pressure and the viscosity by features and network."""
        stiffness, damping = largest_factors(model.iterations)
        predict_pressure(
            particles, wall, neighbors, model.fluid, self.scales, self.network, stiffness, damping,
            self.eta, model.pressure_term, model.viscosity, model.diagonal, model.interval,
        )  # fmt: skip


PcNet = DirectPcNet | PressurePcNet
"""The learned acceleration; stands where `SphAcceleration` stands."""


def make_pcnet(
    weights: Weights, fluid: Fluid, scales: FeatureScales, capacity: int, guarded: bool = True
) -> PcNet:
    """The head that the weights are for; a direct one with or without its guard."""
    if weights.training.head == "direct":
        return DirectPcNet(weights, fluid, scales, capacity, guarded)
    return PressurePcNet(weights, fluid, scales, capacity)


def scales_of(weights: Weights, fluid: Fluid, spacing: float, wall_ratio: float) -> FeatureScales:
    """What features are measured in where blood is `fluid` at a spacing [m]."""
    radius, sound = fluid.kernel.support_radius, fluid.sound_speed
    interval = weights.training.courant_number * radius / sound
    return FeatureScales(radius, spacing, interval, sound, wall_ratio)


def load_pcnet(path: Path, scene: Scene, guarded: bool = True) -> Callable[[Fluid, int], PcNet]:
    """A maker of PcNet models for `Simulation`, from a weights file for a scene.

    Raises:
        InputError: not weights, or (from the maker) weights for a scene of other proportions.
    """
    weights = Weights.load(path)
    grid = scene.discretization

    def make(fluid: Fluid, capacity: int) -> PcNet:
        found = {"support_ratio": grid.support_ratio, **dimensionless_numbers(fluid)}
        require_fit(weights, str(path), found)
        scales = scales_of(weights, fluid, grid.spacing, grid.wall_spacing_ratio)
        return make_pcnet(weights, fluid, scales, capacity, guarded)

    return make


@ti.func
def beyond_training(f, velocity, scales: ti.template(), interval):
    """1 if a particle with these features must not be left to a network, else 0."""
    dense = f[DENSITY_RATIO] > ti.static(1.0 + LARGEST_COMPRESSION)
    fast = velocity.norm() * interval > ti.static(LARGEST_ADVECTIVE_CFL * scales.support_radius)
    return int(dense or fast)


@ti.kernel
def predict_acceleration(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    scales: ti.template(),
    network: ti.template(),
    out: ti.template(),
    interval: float,
) -> int:
    """a_i^{n+1} = net(F_i) (paper, Algorithm 2); it knows gravity or nothing does.

    Returns how many particles are beyond training.  Writes: out, density, shifting.
    """
    alarms = 0
    for i in range(p.count[None]):
        f, p.shifting[i] = features_of(i, p, w, nb, fluid, scales, network.inputs, interval)
        alarms += beyond_training(f, p.velocity[i], scales, interval)
        p.density[i] = f[DENSITY_RATIO] * ti.static(fluid.rest_density)
        o = evaluate(network, f)
        for a in ti.static(range(3)):
            out[i][a] = o[a] * ti.static(scales.support_radius) / (interval * interval)
    return alarms


@ti.kernel
def copy_vectors(p: ti.template(), a: ti.template()):
    """Writes: acceleration."""
    for i in range(p.count[None]):
        p.acceleration[i] = a[i]


@ti.func
def sigmoid(x):
    """1/(1 + exp(-x))."""
    return 1.0 / (1.0 + ti.exp(-x))


@ti.kernel
def predict_pressure(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    fluid: ti.template(),
    scales: ti.template(),
    network: ti.template(),
    largest_stiffness: float,
    largest_damping: float,
    eta: float,
    pressure_term: ti.template(),
    viscosity: ti.template(),
    diagonal: ti.template(),
    interval: float,
):
    """The pressure head's q^0, mu and T^2 rho_0 D.

    Writes: pressure_term, viscosity, diagonal, density, shifting.
    """
    rest_density = ti.static(fluid.rest_density)
    thickest = (
        ti.static(LARGEST_VISCOSITY * fluid.rest_density * scales.support_radius**2) / interval
    )
    unit = ti.static(fluid.rest_density / scales.support_radius**2) * interval * interval
    for i in range(p.count[None]):
        f, p.shifting[i] = features_of(i, p, w, nb, fluid, scales, network.inputs, interval)
        p.density[i] = f[DENSITY_RATIO] * rest_density
        diagonal[i] = unit * ti.max(SMALLEST_DIAGONAL, f[RESPONSE])
        o = evaluate(network, f)
        excess = largest_stiffness * sigmoid(o[0]) * (f[DENSITY_RATIO] - 1.0)
        excess -= largest_damping * sigmoid(o[1]) * f[DIVERGENCE]
        pressure_term[i] = ti.max(0.0, excess) / diagonal[i]
        viscosity[i] = ti.min(thickest, eta * ti.exp(ti.min(o[2], LARGEST_EXPONENT)))
