"""Numbers that follow from a scene; printed, never typed."""

import math
from dataclasses import dataclass

import numpy as np

from taichi_sph.rheology import rheology_of
from taichi_sph.scene import Scene
from taichi_sph.vessel import Vessel


@dataclass(frozen=True)
class Derived:
    """What a scene amounts to."""

    blood_particles: int
    proxy_particles: int
    support_radius: float
    """R [m]."""
    expected_speed: float
    """Speed of a free fall through the whole lumen, along gravity [m/s]."""
    sound_speed: float
    """c [m/s]: the scene's ratio times the expected speed."""
    step: float
    """Time step at the expected speed [s], before force limits."""
    reynolds_number: float
    """rho U D / eta at the expected speed and the narrowest opening's diameter."""
    particles_across_narrowest: float
    """Diameter of the narrowest opening over the spacing."""


def expected_speed(scene: Scene, vessel: Vessel) -> float:
    """sqrt(2 g H), H the extent of the lumen along gravity [m/s]."""
    gravity = np.asarray(scene.gravity)
    g = float(np.linalg.norm(gravity))
    if g == 0.0:
        return 0.0
    along = vessel.vertices @ (gravity / g)
    return math.sqrt(2.0 * g * float(along.max() - along.min()))


def derive(scene: Scene, vessel: Vessel, blood_count: int, proxy_count: int) -> Derived:
    """Work out the derived numbers of a scene in its vessel."""
    grid = scene.discretization
    radius = grid.support_ratio * grid.spacing
    speed = expected_speed(scene, vessel)
    # Without gravity nothing drives the blood but itself: 1 m/s, an arterial speed, then.
    sound = grid.sound_speed_ratio * (speed or 1.0)
    h = 0.5 * radius
    viscosity = rheology_of(scene.blood.rheology).largest_viscosity
    step = min(
        grid.courant_number * h / (sound + speed), 0.125 * h * h * scene.blood.density / viscosity
    )
    narrowest = 2.0 * min((o.radius for o in vessel.openings), default=math.nan)
    return Derived(
        blood_particles=blood_count,
        proxy_particles=proxy_count,
        support_radius=radius,
        expected_speed=speed,
        sound_speed=sound,
        step=step,
        reynolds_number=scene.blood.density * speed * narrowest / scene.blood.rheology.viscosity,
        particles_across_narrowest=narrowest / grid.spacing,
    )
