"""Methods that are compared: an entry each, for the chart, the stability cases and advice.

A method is a model at a setting.  Methods of one `curve` are joined by a line on the chart.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import taichi as ti

from app.models import MODELS, model_factory
from app.studies.splishsplash import SOLVERS, Peer
from nn.weights import Weights
from taichi_sph.fluid.implicit import implicit_factory
from taichi_sph.fluid.model import AccelerationModel, Fluid
from taichi_sph.particles.neighbors import Neighbors
from taichi_sph.particles.particles import Particles
from taichi_sph.particles.wall import Wall
from taichi_sph.scene import NewtonianTable, Scene
from taichi_sph.simulation import ModelFactory, Simulation

CURVES = {
    "physics, spacing": "tab:blue",
    "physics, sound speed": "tab:cyan",
    "physics, longest step": "navy",
    "physics, Newtonian": "tab:purple",
    "soft physics, spacing": "magenta",
    "implicit, spacing": "tab:green",
    "implicit, 0 rounds": "teal",
    "implicit, rounds": "olive",
    "ballistic": "black",
    "pcnet, spacing": "tab:red",
    "splishsplash-wcsph, spacing": "gold",
    "splishsplash-wcsph, longest step": "darkgoldenrod",
    "splishsplash-dfsph, spacing": "tab:orange",
    "splishsplash-dfsph, longest step": "tab:brown",
}
"""Curves of the chart, with the colour of each."""
OTHER_NETWORKS = ("tab:pink", "tab:gray", "lime")
"""Colours of networks that are given as files, in turn."""


@dataclass(frozen=True)
class Method:
    """A model at a setting; what is None is as the scene has it."""

    name: str
    curve: str = ""
    """One of CURVES; empty of what is on none."""
    model: str = "physics"
    """One of app.models, "ballistic", or one of app.studies.splishsplash."""
    spacing: float = 1.0
    """Times the scene's."""
    sound_speed_ratio: float | None = None
    artificial_viscosity: float | None = None
    courant_number: float | None = None
    newtonian: bool = False
    integrator: str | None = None
    step_factor: float | None = 1.0
    """Times the model's own step; None: the largest that lives, found by trial."""
    rounds: int | None = None
    """Of the implicit model."""
    weights: Path | None = None
    """Of the network."""
    guarded: bool = True
    """Whether the physics stands in for a direct head that runs away."""
    is_charted: bool = True
    """Whether the chart has it."""
    is_tested: bool = False
    """Whether it meets the stability cases."""

    def __post_init__(self) -> None:
        if self.model not in (*MODELS, "ballistic", *SOLVERS):
            raise ValueError(f"{self.name}: there is no model {self.model}")
        if self.curve and self.curve not in CURVES and self.weights is None:
            raise ValueError(f"{self.name}: there is no curve {self.curve}; there are {[*CURVES]}")

    @property
    def setting(self) -> "Method":
        """What it is but for its name, its spacing and where it is shown."""
        return replace(self, name="", curve="", spacing=1.0, is_charted=True, is_tested=False)

    def scene(self, scene: Scene) -> Scene:
        """The scene as this method pours it; the column keeps its volume."""
        grid: dict[str, Any] = {"spacing": self.spacing * scene.discretization.spacing}
        if self.sound_speed_ratio is not None:
            grid["sound_speed_ratio"] = self.sound_speed_ratio
        if self.courant_number is not None:
            grid["courant_number"] = self.courant_number
        if self.integrator is not None:
            grid["integrator"] = self.integrator
        blood: dict[str, Any] = {}
        if self.artificial_viscosity is not None:
            blood["artificial_viscosity"] = self.artificial_viscosity
        if self.newtonian:
            blood["rheology"] = NewtonianTable(viscosity=scene.blood.rheology.viscosity)
        column = scene.column
        if column.particles is not None:
            count = max(1, round(column.particles / self.spacing**3))
            column = msgspec.structs.replace(column, particles=count)
        change = msgspec.structs.replace
        return change(
            scene,
            column=column,
            discretization=change(scene.discretization, **grid),
            blood=change(scene.blood, **blood),
        )

    def simulation(self, scene: Scene) -> Simulation | Peer:
        """What pours a scene by this method.

        Raises:
            InputError: the scene or the weights cannot be used.
        """
        scene = self.scene(scene)
        if self.model in SOLVERS:
            return Peer(scene, self.model, self.step_factor or 1.0)
        return Simulation.from_scene(scene, self.maker(scene))

    def maker(self, scene: Scene) -> ModelFactory:
        """What makes the model, for a scene as `scene` gives it.

        Raises:
            InputError: weights that cannot be read.
        """
        if self.model == "ballistic":
            own: ModelFactory = Ballistic
        elif self.model == "implicit" and self.rounds is not None:
            own = implicit_factory(scene, iterations=self.rounds)
        else:
            own = model_factory(self.model, scene, self.weights, self.guarded)
        factor = self.step_factor or 1.0
        if factor == 1.0:
            return own
        return lambda fluid, capacity: Stretched(own(fluid, capacity), factor)


class Stretched:
    """A model with longer or shorter steps than it asks for."""

    def __init__(self, model: AccelerationModel, factor: float):
        """Take `factor` times the steps of `model`."""
        self.model = model
        self.factor = factor
        self.name = model.name
        self.accelerate = model.accelerate

    @property
    def used_fallback(self) -> bool:
        """As the model's."""
        return self.model.used_fallback

    @property
    def largest_viscosity(self) -> float:
        """As the model's."""
        return self.model.largest_viscosity

    @property
    def sound_speed(self) -> float:
        """As the model's."""
        return self.model.sound_speed

    @sound_speed.setter
    def sound_speed(self, sound_speed: float) -> None:
        self.model.sound_speed = sound_speed

    @property
    def pair_coefficients(self) -> tuple[Fluid, ti.Field, ti.Field, float] | None:
        """As the model's."""
        return self.model.pair_coefficients

    def stable_step(self, largest_speed: float, largest_acceleration: float) -> float:
        """The model's step times the factor [s]."""
        return self.factor * self.model.stable_step(largest_speed, largest_acceleration)


class Ballistic:
    """Free fall, and the wall's last defence: what a method must beat to be worth its name."""

    name = "ballistic"
    used_fallback = False
    pair_coefficients = None
    largest_viscosity = math.inf

    def __init__(self, fluid: Fluid, capacity: int):
        """It keeps nothing but the liquid."""
        self.fluid = fluid
        self.sound_speed = fluid.sound_speed

    def accelerate(
        self,
        particles: Particles,
        wall: Wall,
        neighbors: Neighbors,
        gravity: tuple[float, float, float],
    ) -> None:
        """a_i = g."""
        fall(particles, ti.Vector(gravity), self.fluid.rest_density)

    def stable_step(self, largest_speed: float, largest_acceleration: float) -> float:
        """A fifth of the support radius at the largest speed, or at a hundredth of sound's [s]."""
        slowest = 0.01 * self.sound_speed
        return 0.2 * self.fluid.kernel.support_radius / max(largest_speed, slowest)


@ti.kernel
def fall(p: ti.template(), gravity: ti.math.vec3, rest_density: float):
    """Writes: acceleration, density, shifting."""
    for i in range(p.count[None]):
        p.acceleration[i] = gravity
        p.shifting[i] = ti.Vector([0.0, 0.0, 0.0])
        p.density[i] = rest_density


REFERENCE = Method("reference", spacing=0.5, sound_speed_ratio=20.0)
"""Half the spacing and stiff: errors are against it."""
DISCRETISATION_FLOOR = Method("spacing 2/3, c = 20 U", spacing=2.0 / 3.0, sound_speed_ratio=20.0)
"""How far the next coarser one is from the reference: no error below means anything."""

COARSER = (1.25, 1.5, 2.0)
"""Spacings at which methods are charted too, times the scene's."""


def _over_spacing(plain: Method) -> list[Method]:
    """A method and its coarser likes."""
    coarser = [
        replace(plain, name=f"{plain.name}, {s:g} d", spacing=s, is_tested=False) for s in COARSER
    ]
    return [plain, *coarser]


SOFT = Method(
    "soft physics",
    "soft physics, spacing",
    sound_speed_ratio=3.0,
    artificial_viscosity=0.3,
    courant_number=0.8,
    is_tested=True,
)
"""The physics at its fastest, with room left: steps half as long again live too."""

METHODS: tuple[Method, ...] = (
    *_over_spacing(Method("physics", "physics, spacing", is_tested=True)),
    Method("physics, 2 x step", step_factor=2.0, is_charted=False, is_tested=True),
    *(
        Method(
            f"physics, c = {c:g} U",
            "physics, sound speed",
            sound_speed_ratio=c,
            is_tested=c == 3.0,
        )
        for c in (5.0, 3.0, 2.0)
    ),
    *(
        Method(
            f"physics, c = {c:g} U, alpha {alpha:g}, longest step",
            "physics, longest step",
            sound_speed_ratio=c,
            artificial_viscosity=alpha,
            step_factor=None,
        )
        for c, alpha in ((10.0, 0.05), (5.0, 0.3), (3.0, 0.3))
    ),
    Method("physics, Newtonian", "physics, Newtonian", newtonian=True),
    *_over_spacing(SOFT),
    Method("physics, printed integrator", integrator="paper", is_charted=False, is_tested=True),
    *_over_spacing(Method("implicit", "implicit, spacing", "implicit", is_tested=True)),
    *_over_spacing(
        Method("implicit, 0 rounds", "implicit, 0 rounds", "implicit", rounds=0, is_tested=True)
    ),
    *(Method(f"implicit, {k} rounds", "implicit, rounds", "implicit", rounds=k) for k in (2, 4)),
    Method("ballistic", "ballistic", "ballistic"),
    *_over_spacing(Method("pcnet", "pcnet, spacing", "pcnet", is_tested=True)),
)
"""All of them, in the order of tables and matrices."""
CHARTED = tuple(method for method in METHODS if method.is_charted)
TESTED = tuple(method for method in METHODS if method.is_tested)

PEERS: tuple[Method, ...] = tuple(
    method
    for name in SOLVERS
    for method in (
        *_over_spacing(Method(name, f"{name}, spacing", name)),
        Method(f"{name}, longest step", f"{name}, longest step", name, step_factor=None),
    )
)
"""Other programs on the same blood."""


def method_of_weights(path: Path) -> Method:
    """The network of a weights file, named by how it was trained.

    Raises:
        InputError: it cannot be read.
    """
    training = Weights.load(path).training
    how = f"{training.head} head, {training.correction}"
    name = f"pcnet, {how}, M = {training.substeps}, {training.rounds} rounds, seed {training.seed}"
    return Method(name, f"pcnet, {how}", "pcnet", weights=path)
