"""Cases that need no viscosity: kernel, momentum, a column at rest and one that falls."""

import math

import numpy as np
import taichi as ti

from app.validation import analytic, flows
from app.validation.flows import DENSITY, GRAVITY, MACH, VISCOSITY, Liquid, state_of
from app.validation.report import Curve, Report, relative_l2, watched
from taichi_sph.fluid.rheology import Casson, Newtonian
from taichi_sph.particles.smoothing_kernel import WendlandC2


@ti.kernel
def sample_kernel(kernel: ti.template(), r: ti.template(), w: ti.template(), slope: ti.template()):
    """The kernel as the sums use it.  Writes: w, slope."""
    for i in r:
        w[i] = kernel.w(r[i])
        slope[i] = kernel.slope(r[i])


def kernel_integrals(report: Report, quick: bool) -> None:
    """Integrals of W and of its gradient by Gauss and Legendre's rule, exact for polynomials."""
    kernel = WendlandC2(2e-3)
    nodes, weights = np.polynomial.legendre.leggauss(16)
    radii = 0.5 * kernel.support_radius * (nodes + 1.0)
    shell = 2.0 * math.pi * kernel.support_radius * weights * radii**2
    r, w, slope = (ti.field(float, len(radii)) for _ in range(3))
    r.from_numpy(radii)
    sample_kernel(kernel, r, w, slope)
    report.compare("kernel: integral of W", float(shell @ w.to_numpy()), 1.0, 1e-12)
    # int x dW/dx dV = -1 makes the gradient of a linear field exact.
    gradient = -float(shell @ (slope.to_numpy() * radii**2)) / 3.0
    report.compare("kernel: integral of -x dW/dx", gradient, 1.0, 1e-12)


def momentum(report: Report, quick: bool) -> None:
    """Total momentum of blood in violent motion in a closed box, double precision."""
    d, n = 1e-3, 10
    generator = np.random.default_rng(1)
    liquid = Liquid(Casson(3.5e-3, 5e-3, 7.0), 1.0, d, background_pressure=50.0)

    def velocity(x: np.ndarray) -> np.ndarray:
        return generator.normal(0.0, 0.05, x.shape)

    motion = flows.box(liquid, (n, n, n), velocity, jitter=0.1)
    before = state_of(motion).velocity
    for k in range(200):
        motion.step(flows.FAR)
        report.advance(k / 200)
    after = state_of(motion).velocity
    drift = np.abs((after - before).sum(axis=0)).max() / np.linalg.norm(before, axis=1).sum()
    report.add(
        "momentum, 200 steps, f64: drift over sum of m |v|", f"{drift:.1e}", "0", drift, 1e-12
    )


def hydrostatic(report: Report, quick: bool) -> None:
    """A column at rest on a floor: pressure, compression, and that it comes to rest."""
    layers, d = (40 if quick else 60), 1e-3
    fill = layers * d
    c = MACH * math.sqrt(2.0 * GRAVITY * fill)
    liquid = Liquid(Newtonian(VISCOSITY), c, d)
    motion = flows.column(liquid, layers, GRAVITY)
    swing = 4.0 * fill / c  # period of the column's slowest sound
    scale = GRAVITY * fill
    first, left = 0.0, 0.0
    for _ in watched(motion, list(swing * np.arange(1, 9) / 16.0), report, 0.0, 0.2):
        first = max(first, 0.5 * float(np.square(state_of(motion).velocity).sum(axis=1).mean()))
    # That sound would ring for 10^5 d/c.  Stopping the blood a quarter period after rest, when a
    # tone passes through its equilibrium, takes the energy out of it: the deepest tone and its
    # overtones in turn, twice.
    for overtone in (1, 3, 5, 7, 9, 11, 13) * 2:
        motion.particles.velocity.fill(0.0)
        motion.advance_to(motion.time + 0.25 * swing / overtone)
        report.advance(0.2 + 0.4 * (1.0 - 1.0 / overtone))
    motion.particles.velocity.fill(0.0)
    begin = motion.time
    for _ in watched(motion, list(begin + swing * np.arange(1, 9) / 8.0), report, 0.6, 1.0):
        left = max(left, 0.5 * float(np.square(state_of(motion).velocity).sum(axis=1).mean()))
    state = state_of(motion)
    height = analytic.hydrostatic_height(fill, GRAVITY, DENSITY, c)
    z = state.position[:, 2]
    pressure = liquid.fluid().equation_of_state.pressure_of(state.density)
    theory = analytic.hydrostatic_pressure(height - z, GRAVITY, DENSITY, c)
    report.add(
        f"hydrostatic column {layers} d high: pressure, L2 over particles",
        f"{pressure.max():.5g} Pa at foot", f"{theory.max():.5g} Pa",
        relative_l2(pressure, theory), 0.02,
    )  # fmt: skip
    compression = state.density.max() / DENSITY - 1.0
    foot = analytic.hydrostatic_density(np.array(height), GRAVITY, DENSITY, c) / DENSITY - 1.0
    report.add(
        "hydrostatic column: largest compression (error: the compression)",
        f"{compression:.3%}", f"{float(foot):.3%}", compression, 0.01,
    )  # fmt: skip
    deep = z < 0.8 * height
    slope, offset = np.polyfit(z[deep], pressure[deep], 1)
    level = -offset / slope
    report.add(
        "hydrostatic column: level of zero pressure (error: spacings)",
        f"{level / d:.2f} d", f"{height / d:.2f} d", abs(level - height) / d, 1.0,
    )  # fmt: skip
    report.add(
        "hydrostatic column: kinetic energy/(m g H), first swing to rest (error: what is left)",
        f"{first / scale:.1e} to {left / scale:.1e}", "0", left / scale, 1e-5,
    )  # fmt: skip
    order = np.argsort(z)
    report.draw(
        "hydrostatic", "height [m]", "pressure [Pa]",
        Curve(f"{layers} spacings", z[order], pressure[order], z[order], theory[order]),
    )  # fmt: skip


TOO_FAST = (
    "the thin front is braked less than with the artificial viscosity that scenes had (8.3 %)"
)
"""Why the collapsing column's front is known to run ahead."""


def dam_break(report: Report, quick: bool) -> None:
    """Front of a collapsing column against Martin and Moyce's experiment."""
    across = 12 if quick else 20
    width = 0.05715
    d = width / across
    c = MACH * math.sqrt(2.0 * GRAVITY * 2.0 * width)
    liquid = Liquid(Newtonian(1e-3), c, d)
    motion = flows.dam(liquid, across, 5.0, GRAVITY)
    scaled = np.arange(0.2, 2.61, 0.2)
    fronts = []
    unit = math.sqrt(0.5 * width / GRAVITY)
    for _ in watched(motion, list(scaled * unit), report, 0.0, 1.0):
        x = np.sort(state_of(motion).position[:, 0])
        fronts.append((x[-flows.SLAB :].mean() + 0.5 * d) / width)  # one row across the slab
    measured = analytic.collapse_front(scaled)
    late = scaled > 1.0
    report.add(
        f"dam break, column {across} wide: front, L2 from t sqrt(2g/a) = 1.2 to 2.6",
        f"x/a {fronts[-1]:.3f} at {scaled[-1]:.1f}", f"{measured[-1]:.3f} (measured)",
        relative_l2(np.array(fronts)[late], measured[late]), 0.1, TOO_FAST,
    )  # fmt: skip
    report.draw(
        "dam-break", "t sqrt(2g/a)", "x/a",
        Curve(f"{across} wide", scaled, np.array(fronts),
              np.array(analytic.COLLAPSE_TIME), np.array(analytic.COLLAPSE_FRONT), "measured"),
    )  # fmt: skip
