"""Shifting: particles move a little beside the flow, to where there are fewer.

    dx_i/dt = v_i + w_i
    w_i     = -f_i min(s |D|_i, 0.2/T) h_s^2 C_i, at most f_i |D|_i h_s

Sheared particles that are left to themselves crowd along some directions and part along others.
Any pressure then pushes them unevenly: like grains they resist shear with a part of the pressure,
which in blood is far more than viscosity (docs/physics.md).  Shifting keeps them even (Lind et al.
2012, doi:10.1016/j.jcp.2011.10.027; Sun et al. 2017, doi:10.1016/j.cma.2016.10.028).  It moves
positions only: momentum is not touched.  Blood at rest is not shifted, for the rate is that of the
local shear, and nothing where neighbours are missing: at a free surface C_i points out of it.  The
integrator leaves it out beside buffers, whose blood does not fill them to the rim.

| symbol | here | meaning | unit |
|---|---|---|---|
| |D|_i | rate | shear rate sqrt(2 D:D) | 1/s |
| C_i | concentration | see `taichi_sph.fluid.density` | 1/m |
| h_s | | smoothing length, R/2 | m |
| f_i | surrounded | 0 to 1, by rho_i/rho_0 | 1 |
| s | fluid.shifting | factor | 1 |
| 1/T | frequency | steps in a time | 1/s |

The bound by the step T keeps shifting stable: it is a diffusion of the particles, and the long
steps of the implicit model would swing them to and fro.
"""

import taichi as ti

LARGEST_SHIFTING = 0.2
"""Upper bound of s |D| T: at 0.3 a pour by the implicit model is compressed by 2.4 %, at 0.2 by
1.8 % as without shifting, at 0.1 by 1.7 %; the physics is slower to order its blood under 0.2."""
SURFACE, SURROUNDED = 0.90, 0.95
"""rho/rho_0 under which a particle is at a free surface, and over which it is not: at a plane
surface of a lattice the first layer has 0.88, the second 1.00.  Sheared blood under the little
pressure of a pour has 0.96 to 0.98: with 0.93 and 0.98 it had a fifth of thin blood's viscosity."""


@ti.func
def surrounded(density_ratio):
    """Factor f_i from rho/rho_0: 0 at a free surface, 1 inside."""
    inside = (density_ratio - SURFACE) / ti.static(SURROUNDED - SURFACE)
    return ti.max(0.0, ti.min(1.0, inside))


@ti.func
def shifting_velocity(fluid: ti.template(), density_ratio, rate, concentration, frequency):
    """Velocity w_i of a particle beside the flow [m/s].

    Of rho/rho_0, the shear rate |D| [1/s], C [1/m] and how many steps there are in a time [1/s].
    """
    h = ti.static(fluid.kernel.smoothing_length)
    quick = ti.min(ti.static(fluid.shifting) * rate, LARGEST_SHIFTING * frequency)
    w = -quick * h * h * concentration
    most = rate * h
    return surrounded(density_ratio) * most / ti.max(most, w.norm() + 1e-30) * w
