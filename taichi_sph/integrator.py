"""Kick and drift: symplectic Euler, and the correction of blood that would pass the wall."""

from typing import Any

import taichi as ti

from taichi_sph.particles.wall import wall_velocity

WALL_MARGIN = 0.1
"""Blood may come this close to the lumen surface [setbacks]; at rest it keeps some 0.5."""

WALL_SIDE = 0.5
"""A proxy guards only blood that was on its side before the step, to this depth [setbacks]:
behind a thin septum lies another branch, whose blood must not be pulled over."""


@ti.func
def is_finite(a):
    """Whether a number is neither NaN nor infinite, from its bits: fast math may not be asked."""
    finite = True
    if ti.static(a.ptr.get_rvalue_type() == ti.f64):
        finite = (ti.bit_cast(a, ti.i64) >> 52) & 0x7FF != 0x7FF
    else:
        finite = (ti.bit_cast(a, ti.i32) >> 23) & 0xFF != 0xFF
    return finite


@ti.kernel
def largest_speed_and_acceleration(p: ti.template()) -> ti.math.vec3:
    """Largest speed [m/s], largest acceleration [m/s^2], number of non-finite particles.

    Reads: velocity, acceleration.
    """
    speed2 = 0.0
    acceleration2 = 0.0
    broken = 0.0
    for i in range(p.count[None]):
        v2 = p.velocity[i].norm_sqr()
        a2 = p.acceleration[i].norm_sqr()
        if not (is_finite(v2) and is_finite(a2)):
            broken += 1.0
        ti.atomic_max(speed2, v2)
        ti.atomic_max(acceleration2, a2)
    return ti.Vector([ti.sqrt(speed2), ti.sqrt(acceleration2), broken])


def has_buffers(inflow: Any) -> bool:
    """Whether anything drives blood in, asked when `kick_drift` is compiled."""
    return inflow is not None and inflow.regions.count > 0


@ti.kernel
def kick_drift(
    p: ti.template(),
    w: ti.template(),
    nb: ti.template(),
    inflow: ti.template(),
    as_printed: ti.template(),
    dt: float,
    datum_share: float,
) -> ti.math.vec2:
    """Advance velocity and position by dt [s], then keep blood inside the wall.

    v' = v + a dt (Eq. 17), x' = x + (v' + w) dt: symplectic Euler, with the shifting w.
    `as_printed` takes Eq. 18 as printed, x' = x + (v + v')/2 dt, which amplifies sound of angular
    frequency f at every step (determinant 1 + (f dt)^2/2).

    Wall penetration correction: blood that comes nearer to the lumen surface than WALL_MARGIN
    setbacks is put back on that distance along the normal of the proxies beside it, and its
    velocity into the wall is taken away.  The pressure of the wall holds blood that is packed;
    this holds a lone droplet, which has no pressure.

    Blood in a buffer of `inflow` (the `BufferZones`, or None) moves with it, and no wall stops it;
    none is shifted within a support radius of a buffer.  `datum_share` of the mean pressure is
    the local datum of the next step (`taichi_sph.fluid.local_datum`), but nothing there either.

    Returns the largest squared distance from where the lists were built [m^2] and the number of
    particles put back.
    Reads: acceleration, shifting, wall, lists.  Writes: velocity, position, local_datum.
    """
    moved2 = 0.0
    corrected = 0.0
    for i in range(p.count[None]):
        v = p.velocity[i]
        v_new = v + p.acceleration[i] * dt
        shifting = p.shifting[i]
        share = datum_share
        if ti.static(has_buffers(inflow)):
            # The rows of a buffer end at its rim: blood would be shifted back into the gap.
            beside = inflow.regions.buffer_at(p.position[i], nb.support_radius) >= 0
            if beside:
                shifting *= 0.0
                # What acts on a buffer is the whole pressure, and what is not kept even by shifting
                # needs it beside a body that does not give way.
                share = 0.0
        if ti.static(p.has_local_datum):
            p.local_datum[i] = share * p.mean_pressure_term[i]
        x = p.position[i]
        x_old = x
        if ti.static(as_printed):
            x += 0.5 * (v + v_new) * dt
        else:
            x += (v_new + shifting) * dt
        walls = nb.wall_count[i]
        if ti.static(has_buffers(inflow)):
            buffer = inflow.regions.buffer_at(x_old)
            if buffer >= 0:
                v_new = inflow.speed[buffer] * inflow.regions.inward_normal(buffer)
                x = x_old + v_new * dt
                walls = 0
        near2 = ti.static((0.75 * w.spacing) ** 2)
        aside2 = ti.static((1.1 * w.spacing) ** 2)
        limit = ti.static(-(1.0 + WALL_MARGIN) * w.setback)
        side = ti.static(-(1.0 - WALL_SIDE) * w.setback)
        touched = 0
        for n in range(walls):
            k = nb.wall_index[i, n]
            r_ik = nb.grid.separation(x, w.position[k])
            normal = w.normal[k]
            depth = r_ik.dot(normal)
            before = nb.grid.separation(x_old, w.position[k]).dot(normal)
            # Proxies straight behind the particle: their plane is the wall there.  At an edge none
            # may be; those a little aside then hold what has reached the surface itself.
            aside = r_ik.norm_sqr() - depth * depth
            beyond = (depth > limit and aside < near2) or (
                depth > ti.static(-w.setback) and aside < aside2
            )
            if beyond and before < side:
                x -= (depth - limit) * normal
                v_new -= ti.max(0.0, (v_new - wall_velocity(w, k)).dot(normal)) * normal
                touched = 1
        corrected += ti.cast(touched, float)
        p.velocity[i] = v_new
        built = ti.Vector([nb.built.x[i], nb.built.y[i], nb.built.z[i]])
        ti.atomic_max(moved2, nb.grid.separation(x, built).norm_sqr())
        p.position[i] = nb.grid.wrap(x)
    return ti.Vector([moved2, corrected])
