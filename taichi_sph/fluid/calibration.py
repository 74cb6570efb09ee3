"""Constants of the discrete sums, worked out on a lattice instead of guessed.

A cubic lattice of blood at rest must have rest density, no force under a uniform pressure and the
right viscous force, far from a wall and in the first layer at a plane wall.  A kernel sum over
some 30 neighbours misses each by a few per cent (by a factor, at a one-layer wall), so each sum
carries one factor that makes it exact there.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import brentq

from taichi_sph.particles.smoothing_kernel import WendlandC2


@dataclass(frozen=True)
class Calibration:
    """Factors of the discrete sums; dimensionless but for the mass."""

    mass: float
    """Mass m in the sums [kg]: rho_0 / sum_lattice W, so that a lattice has rho_0.  It is some per
    cent less than rho_0 d^3, the blood that a particle stands for."""
    viscosity: float
    """Multiplies the pairwise viscous sum: 1 / its response to a long wave."""
    gradient: float
    """Multiplies gradients (pressure, velocity, stress): 1 / the response to a linear field."""
    setback: float
    """How far behind the lumen surface the proxies stand [m]."""
    wall_density: float
    """gamma of Eq. 3, in the density sum and in the pressure force."""
    wall_friction: float
    """gamma of Eq. 3 in the wall's viscous force: simple shear, at rest on the lumen surface."""
    wall_gradient: float
    """gamma of Eq. 3 in the velocity gradient."""
    wall_concentration: float
    """gamma of Eq. 3 in the gradient of the concentration, which is 0 in the first layer."""


def softening(kernel: WendlandC2) -> float:
    """0.01 h_s^2 [m^2], which keeps v.r/r^2 finite (Monaghan 1992; Eq. 16's epsilon h^2)."""
    return 0.01 * kernel.smoothing_length**2


CROWDING = 0.2
"""Weight of close pairs in the gradient of the concentration (Monaghan 2000, as Sun et al. 2017,
doi:10.1016/j.cma.2016.10.028)."""


def _lattice(radius: float, spacing: float) -> np.ndarray:
    """Points of a cubic lattice within a radius of the origin, the origin left out, (n, 3)."""
    k = int(np.ceil(radius / spacing))
    axis = spacing * np.arange(-k, k + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    r = np.linalg.norm(points, axis=1)
    return points[(r > 0.0) & (r < radius)]


def _slope(kernel: WendlandC2, points: np.ndarray) -> np.ndarray:
    """(dW/dr)/r at points from the origin [m], (n, 3), shape (n,)."""
    return kernel.slope_of(np.linalg.norm(points, axis=1))


def _plane(kernel: WendlandC2, wall_spacing: float) -> np.ndarray:
    """Square lattice of proxies within a support radius of one, along two axes [m], (n, 2)."""
    k = int(np.ceil(kernel.support_radius / wall_spacing))
    axis = wall_spacing * np.arange(-k, k + 1)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)


def plane_proxy_volume(kernel: WendlandC2, wall_spacing: float) -> float:
    """V_k of Eq. 3, gamma = 1, in a plane square lattice of proxies [m^3]."""
    plane = _plane(kernel, wall_spacing)
    return float(1.0 / kernel.w_of(np.linalg.norm(plane, axis=1)).sum())


def _wall_sums(kernel: WendlandC2, d: float, wall_spacing: float, depth: float) -> np.ndarray:
    """Sums over proxies `depth` [m] below: W, force, friction, gradient of simple shear.

    Averaged over where the particle stands above the proxies.
    """
    plane = _plane(kernel, wall_spacing)
    proxy_volume = plane_proxy_volume(kernel, wall_spacing)
    eps = softening(kernel)
    sums = np.zeros(4)
    shifts = wall_spacing * (np.arange(8) + 0.5) / 8.0
    for sx in shifts:
        for sy in shifts:
            p = np.column_stack([plane + (sx, sy), np.full(len(plane), -depth)])
            r2 = (p**2).sum(axis=1)
            s = _slope(kernel, p)
            sums += [
                kernel.w_of(np.sqrt(r2)).sum(),
                (s * p[:, 2]).sum(),
                (s * r2 / (r2 + eps)).sum(),
                (s * p[:, 2] * (-0.5 * d)).sum(),
            ]
    return np.asarray(sums * proxy_volume / len(shifts) ** 2)


def calibrate(
    kernel: WendlandC2, spacing: float, wall_spacing: float, rest_density: float
) -> Calibration:
    """Work out the factors for a spacing d and a wall spacing, both [m].

    The wall: one plane layer of proxies, a square lattice, a setback behind the lumen surface;
    blood's first layer half a spacing before it.  Proxies rest.

    The wall's pressure force is the derivative of its share in the density (one p_i/rho_i^2, as
    Akinci et al. 2012, doi:10.1145/2185520.2185558).  Twice that, Eq. 15's p_k = p_i, is the
    derivative of nothing and feeds energy into blood at rest until it boils.  With one free
    factor a layer of proxies can give the first layer of blood either the density or the force of
    the blood that is missing there; the setback is where one factor gives both.
    """
    d = spacing
    eps = softening(kernel)
    slope = partial(_slope, kernel)
    bulk = _lattice(kernel.support_radius, d)
    number_density = kernel.peak + kernel.w_of(np.linalg.norm(bulk, axis=1)).sum()
    mass = rest_density / number_density
    volume = mass / rest_density
    squared = (bulk**2).sum(axis=1)
    # Linear field u = z: sum_j V (u_j - u_i) dW/dz must be 1; grad W_ij = slope (r_i - r_j).
    bulk_gradient = -volume * (slope(bulk) * bulk[:, 2] ** 2).sum()
    # Quadratic field u = z^2: Morris' sum must be u'' = 2.
    morris = 2.0 * volume * slope(bulk) * squared / (squared + eps)
    bulk_laplacian = -(morris * bulk[:, 2] ** 2).sum()
    viscosity = 2.0 / bulk_laplacian

    # The first layer at z = d/2 loses the lattice at z < 0.
    missing = bulk[bulk[:, 2] < -0.5 * d]
    present = bulk[bulk[:, 2] > -0.5 * d]
    missing_density = volume * kernel.w_of(np.linalg.norm(missing, axis=1)).sum()
    missing_force = -2.0 * volume * (slope(missing) * missing[:, 2]).sum()

    crowding = (
        1.0
        + CROWDING
        * (kernel.w_of(np.linalg.norm(missing, axis=1)) / float(kernel.w_of(np.asarray(d)))) ** 4
    )
    missing_concentration = -(volume * crowding * slope(missing) * missing[:, 2]).sum()

    wall_sums = partial(_wall_sums, kernel, d, wall_spacing)

    def excess_force(depth: float) -> float:
        """Force over density of the wall, less what the missing blood would give [1/m]."""
        w, force, *_ = wall_sums(depth)
        return -force / w - missing_force / missing_density

    depth = brentq(excess_force, 0.5 * d, 0.97 * kernel.support_radius, xtol=1e-9 * d)
    w, force, friction, shear = wall_sums(depth)
    # Simple shear u = g z, no slip at z = 0: no net viscous force on the first layer, u = g d/2.
    # Blood: viscosity * sum 2 V slope r^2/(r^2+eps) (u_i - u_j); wall: 2 V slope r^2/(r^2+eps) u.
    squared = (present**2).sum(axis=1)
    blood = (
        viscosity * 2.0 * volume * slope(present) * squared / (squared + eps) * (-present[:, 2])
    ).sum()
    wall_friction = -blood / (2.0 * friction * 0.5 * d)
    # The same shear: sum_j V (u_j - u_i) dW/dz + sum_k V_k (0 - u_i) dW/dz must be g.
    from_blood = -volume * (slope(present) * present[:, 2] ** 2).sum() / bulk_gradient
    wall_gradient = (1.0 - from_blood) / (-shear / bulk_gradient)
    return Calibration(
        mass=float(mass),
        viscosity=float(viscosity),
        gradient=float(1.0 / bulk_gradient),
        setback=float(depth - 0.5 * d),
        wall_density=float(missing_density / w),
        wall_friction=float(wall_friction),
        wall_gradient=float(wall_gradient),
        wall_concentration=float(-missing_concentration / force),
    )
