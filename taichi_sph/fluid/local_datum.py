"""Local datum: what pressure is measured from in blood that fills its vessel.

Particles that are sheared crowd along some directions and part along others.  A pressure that is
the same all round then pushes them unevenly, and they resist shear with a part of it.  Where blood
is surrounded, most of the pressure of its neighbourhood is therefore taken from each of its sums:

    a_i = -m sum_j (q_i + q_j - 2 D_i) grad W_ij - gamma rho_0 sum_k V_k (q_i - D_i) grad W_ik

    D_i = b f_i Q_i,    Q_i = sum_j q_j W_ij / sum_j W_ij,    q = p/rho^2

with Q_i of the last step.  Among even particles it changes nothing, for there the sum of
V grad W_ij is zero; the differences of pressure stay, and so does q - Q, which keeps particles
apart.  (Difference forms do alike: Sun et al. 2017, doi:10.1016/j.cma.2016.10.028, under tension.)
Pairs no longer conserve momentum exactly, so it serves where a wall takes it: in closed scenes
(`taichi_sph.boundary.datum`) while no wound is open, and not in the buffers of driven openings, on
which the whole pressure acts, nor within a support radius of them: blood that is not shifted there
clumped before the buffer.

| symbol | here | meaning | unit |
|---|---|---|---|
| b Q_i | p.local_datum | of the last step | m^5/(kg s^2) |
| b | LOCAL_SHARE | times the share of the datum that there is | 1 |
| f_i | surrounded | see `taichi_sph.fluid.shifting` | 1 |
"""

import taichi as ti

from taichi_sph.fluid.shifting import surrounded

LOCAL_SHARE = 0.9
"""b: at 0, 0.5, 0.9 and 0.95 a shear wave in the blood of `aorta_surgery`, under some 0.3 rho U^2,
feels 11, 7, 3.1 and 2.6 times its viscosity; at 1 nothing keeps particles apart: all is noise."""


@ti.func
def local_datum(fluid: ti.template(), p: ti.template(), i):
    """Part b f_i Q_i of the pressure term that is taken from particle i's [m^5/(kg s^2)]."""
    datum = 0.0
    if ti.static(p.has_local_datum):
        ratio = p.density[i] * ti.static(1.0 / fluid.rest_density)
        datum = surrounded(ratio) * p.local_datum[i]
    return datum
