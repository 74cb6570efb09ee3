"""Model factories: what `Simulation` makes the blood's acceleration with."""

from taichi_sph.fluid.implicit import implicit_factory
from taichi_sph.fluid.wcsph import SphAcceleration
from taichi_sph.scene import Scene
from taichi_sph.simulation import ModelFactory


def physics(scene: Scene) -> ModelFactory:
    """Factory of the weakly compressible physics, the default of a simulation."""
    return SphAcceleration


def implicit(scene: Scene) -> ModelFactory:
    """Factory of the implicit model, whose step suits the largest speed of a scene."""
    return implicit_factory(scene)
