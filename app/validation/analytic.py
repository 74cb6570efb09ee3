"""Closed forms that flows are judged by; numpy and scipy only.

A pipe has radius `radius` [m] and is driven by G = -dp/dz, or rho times a body force [Pa/m].
Nothing here knows how the flow was computed, and nothing may be tuned to it.
"""

import math
from collections.abc import Callable

import numpy as np
from scipy.integrate import cumulative_simpson, solve_ivp
from scipy.optimize import brentq
from scipy.special import j0, j1, jn_zeros, jv

from taichi_sph.fluid.equation_of_state import Tait

BESSEL_TERMS = 200
"""Terms of the start-up series; the first one left out is below 1e-6 of the steady speed."""

CHANNEL_TERMS = 200
"""Terms of the plane start-up series."""


def pipe_speed(r: np.ndarray, radius: float, drive: float, viscosity: float) -> np.ndarray:
    """Steady Poiseuille flow in a round pipe, u = G (R^2 - r^2)/(4 mu) [m/s].

    Batchelor, An Introduction to Fluid Dynamics (1967), section 4.2.
    """
    return drive * (radius**2 - np.asarray(r) ** 2) / (4.0 * viscosity)


def pipe_flow_rate(radius: float, drive: float, viscosity: float) -> float:
    """Hagen and Poiseuille's law, Q = pi G R^4/(8 mu) [m^3/s]."""
    return math.pi * drive * radius**4 / (8.0 * viscosity)


def pipe_start_up(
    r: np.ndarray, time: float, radius: float, drive: float, viscosity: float, density: float
) -> np.ndarray:
    """Speed in a round pipe that was at rest until t = 0 [m/s].

    u = G (R^2 - r^2)/(4 mu) - (2 G R^2/mu) sum_n J0(l_n r/R)/(l_n^3 J1(l_n)) exp(-l_n^2 nu t/R^2),
    l_n the zeros of J0: Szymanski (1932); Batchelor (1967), section 4.3.
    """
    zeros = jn_zeros(0, BESSEL_TERMS)
    decay = np.exp(-(zeros**2) * viscosity / density * time / radius**2)
    series = j0(np.multiply.outer(np.asarray(r) / radius, zeros)) @ (decay / (zeros**3 * j1(zeros)))
    return pipe_speed(r, radius, drive, viscosity) - 2.0 * drive * radius**2 / viscosity * series


def womersley_number(radius: float, frequency: float, viscosity: float, density: float) -> float:
    """Return Wo = R sqrt(w rho/mu) [-] at an angular frequency w [1/s]: radius over layer depth."""
    return radius * math.sqrt(frequency * density / viscosity)


def pipe_pulsation(
    r: np.ndarray,
    time: float,
    radius: float,
    drive: float,
    frequency: float,
    viscosity: float,
    density: float,
) -> np.ndarray:
    """Speed in a round pipe that G cos(w t) has driven for long [m/s].

    u = Re{G/(i rho w) [1 - J0(i^(3/2) Wo r/R)/J0(i^(3/2) Wo)] e^(i w t)}, w the angular `frequency`
    [1/s]: Womersley (1955), doi:10.1113/jphysiol.1955.sp005276.
    """
    edge = (1j**1.5) * womersley_number(radius, frequency, viscosity, density)
    shape = 1.0 - jv(0, edge * np.asarray(r) / radius) / jv(0, edge)
    turn = np.exp(1j * frequency * time)
    return np.real(drive / (1j * density * frequency) * shape * turn)


def pipe_pulsation_flow_rate(
    radius: float, drive: float, frequency: float, viscosity: float, density: float
) -> complex:
    """Flow rate of the same as a complex number Q, Re{Q e^(i w t)} [m^3/s].

    Q = pi R^2 G/(i rho w) [1 - 2 J1(i^(3/2) Wo)/(i^(3/2) Wo J0(i^(3/2) Wo))].
    """
    edge = (1j**1.5) * womersley_number(radius, frequency, viscosity, density)
    shape = 1.0 - 2.0 * jv(1, edge) / (edge * jv(0, edge))
    return complex(math.pi * radius**2 * drive / (1j * density * frequency) * shape)


def pipe_pulsation_wall_stress(
    radius: float, drive: float, frequency: float, viscosity: float, density: float
) -> complex:
    """Wall shear stress of the same as a complex number tau, Re{tau e^(i w t)} [Pa].

    tau = G R J1(i^(3/2) Wo)/(i^(3/2) Wo J0(i^(3/2) Wo)): what the flow rate leaves of the drive.
    """
    edge = (1j**1.5) * womersley_number(radius, frequency, viscosity, density)
    return complex(drive * radius * jv(1, edge) / (edge * jv(0, edge)))


def channel_start_up(
    y: np.ndarray, time: float, width: float, drive: float, viscosity: float, density: float
) -> np.ndarray:
    """Speed between plates at y = 0 and y = L that was zero until t = 0 [m/s].

    u = G y (L - y)/(2 mu) - sum_n 4 G L^2/(mu pi^3 k^3) sin(k pi y/L) exp(-k^2 pi^2 nu t/L^2),
    k = 2 n + 1: Morris, Fox & Zhu (1997), doi:10.1006/jcph.1997.5776, eq. 20.
    """
    y = np.asarray(y)
    k = 2.0 * np.arange(CHANNEL_TERMS) + 1.0
    decay = np.exp(-((k * math.pi / width) ** 2) * viscosity / density * time)
    series = np.sin(np.multiply.outer(math.pi * y / width, k)) @ (decay / k**3)
    steady = drive * y * (width - y) / (2.0 * viscosity)
    return steady - 4.0 * drive * width**2 / (viscosity * math.pi**3) * series


def plug_ratio(wall_shear_rate: float, eta: float, tau_y: float) -> float:
    """Return beta = tau_y/tau_w = plug radius over pipe radius at a wall shear rate [1/s]."""
    s = math.sqrt(tau_y / (eta * wall_shear_rate))
    return (s / (1.0 + s)) ** 2


def casson_pipe_speed(
    r: np.ndarray, radius: float, drive: float, eta: float, tau_y: float
) -> np.ndarray:
    """Speed of a Casson liquid with a true yield stress in a round pipe [m/s].

    u = (G/4 eta) [R^2 - r^2 - (8/3) sqrt(r_c) (R^(3/2) - r^(3/2)) + 2 r_c (R - r)], r >= r_c;
    constant inside the plug r_c = 2 tau_y/G.  Fung, Biomechanics: Circulation (1997), section 3.2.
    """
    plug = 2.0 * tau_y / drive
    if plug >= radius:
        return np.zeros_like(np.asarray(r, dtype=float))
    r = np.maximum(np.asarray(r, dtype=float), plug)
    return (drive / (4.0 * eta)) * (
        radius**2 - r**2
        - 8.0 / 3.0 * math.sqrt(plug) * (radius**1.5 - r**1.5)
        + 2.0 * plug * (radius - r)
    )  # fmt: skip


def casson_pipe_flow_rate(radius: float, drive: float, eta: float, tau_y: float) -> float:
    """Flow rate of the same, Q = (pi G R^4/8 eta) F(beta) [m^3/s].

    F = 1 - (16/7) sqrt(beta) + (4/3) beta - beta^4/21, beta = 2 tau_y/(G R); none for beta >= 1.
    """
    beta = 2.0 * tau_y / (drive * radius)
    if beta >= 1.0:
        return 0.0
    shape = 1.0 - 16.0 / 7.0 * math.sqrt(beta) + 4.0 / 3.0 * beta - beta**4 / 21.0
    return pipe_flow_rate(radius, drive, eta) * shape


def regularised_casson(shear_rate: float, eta: float, tau_y: float, n: float) -> float:
    """The law that is solved, mu = (sqrt(eta) + sqrt(tau_y/g) (1 - e^-sqrt(n g)))^2 [Pa s].

    Papanastasiou (1987), doi:10.1122/1.549926, for Casson's law.
    """
    if shear_rate <= 0.0:
        return (math.sqrt(eta) + math.sqrt(n * tau_y)) ** 2
    rise = -math.expm1(-math.sqrt(n * shear_rate))
    return (math.sqrt(eta) + math.sqrt(tau_y / shear_rate) * rise) ** 2


def generalised_pipe(
    radius: float, drive: float, viscosity: Callable[[float], float], points: int = 2001
) -> tuple[np.ndarray, np.ndarray, float]:
    """Steady pipe flow of any liquid mu(shear rate), by quadrature in one dimension.

    The stress is G r/2 whatever the liquid, so mu(g) g = G r/2 is solved for the shear rate g at
    each radius, and u = int_r^R g dr, Q = pi int_0^R g r^2 dr.

    Returns:
        Radii [m] and speeds [m/s], shape (points,), and the flow rate [m^3/s].
    """
    r = np.linspace(0.0, radius, points)
    least = min(viscosity(0.0), viscosity(1e12))

    def shear_rate(stress: float) -> float:
        if stress <= 0.0:
            return 0.0
        return brentq(
            lambda g: viscosity(g) * g - stress, 0.0, 1.01 * stress / least, xtol=1e-14, rtol=1e-13
        )

    g = np.array([shear_rate(0.5 * drive * s) for s in r])
    inner = cumulative_simpson(g, x=r, initial=0.0)
    volume = cumulative_simpson(g * r**2, x=r, initial=0.0)
    return r, inner[-1] - inner, math.pi * float(volume[-1])


def hydrostatic_density(
    depth: np.ndarray,
    gravity: float,
    rest_density: float,
    sound_speed: float,
    gamma: float = Tait.exponent,
) -> np.ndarray:
    """Density at a depth below the surface of a liquid at rest that obeys Tait's law [kg/m^3].

    From dp/dz = rho g and p = rho_0 c^2/gamma ((rho/rho_0)^gamma - 1):
    rho = rho_0 (1 + (gamma - 1) g z/c^2)^(1/(gamma - 1)).
    """
    z = np.maximum(np.asarray(depth, dtype=float), 0.0)
    return rest_density * (1.0 + (gamma - 1.0) * gravity * z / sound_speed**2) ** (
        1.0 / (gamma - 1.0)
    )


def hydrostatic_pressure(
    depth: np.ndarray,
    gravity: float,
    rest_density: float,
    sound_speed: float,
    gamma: float = Tait.exponent,
) -> np.ndarray:
    """Pressure at a depth below the surface of the same [Pa]; rho_0 g z to first order."""
    ratio = hydrostatic_density(depth, gravity, rest_density, sound_speed, gamma) / rest_density
    return rest_density * sound_speed**2 / gamma * (ratio**gamma - 1.0)


def hydrostatic_height(
    fill: float,
    gravity: float,
    rest_density: float,
    sound_speed: float,
    gamma: float = Tait.exponent,
) -> float:
    """Height to which a column that filled `fill` [m] at rest density sinks by its weight [m].

    Its weight is rho_0 g times the fill, which is the pressure at its foot.
    """
    foot = rest_density * gravity * fill
    ratio = (1.0 + gamma * foot / (rest_density * sound_speed**2)) ** (1.0 / gamma)
    return (ratio ** (gamma - 1.0) - 1.0) * sound_speed**2 / ((gamma - 1.0) * gravity)


def shear_wave_rate(wave_number: float, viscosity: float, density: float) -> float:
    """Decay rate of u_x = U sin(k z): nu k^2 [1/s], exact at any amplitude."""
    return viscosity / density * wave_number**2


def shear_wave_decay(
    wave_number: float, speed: float, viscosity: Callable[[float], float], density: float,
    time: float, points: int = 64,
) -> float:  # fmt: skip
    """Part of u_x = U sin(k z) that is left of any liquid mu(shear rate), by its projection on it.

    rho du/dt = d/dz (mu(|du/dz|) du/dz) over a quarter of the wave, where u is 0 and du/dz is 0 at
    the ends, by finite volumes.

    Args:
        wave_number: k [1/m].
        speed: U [m/s].
        viscosity: mu [Pa s] at a shear rate [1/s].
        density: [kg/m^3].
        time: since the sine [s].
        points: volumes.
    """
    width = 0.5 * math.pi / wave_number / points
    z = (np.arange(points) + 0.5) * width
    sine = np.sin(wave_number * z)

    def acceleration(_: float, u: np.ndarray) -> np.ndarray:
        # Beyond the node u is its negative; beyond the crest its mirror image.
        slope = np.diff(np.concatenate([[-u[0]], u, [u[-1]]])) / width
        stress = np.array([viscosity(abs(g)) * g for g in slope])
        return np.asarray(np.diff(stress) / width / density)

    solved = solve_ivp(
        acceleration, (0.0, time), speed * sine, method="LSODA", rtol=1e-8, atol=1e-8 * speed,
        lband=1, uband=1,
    )  # fmt: skip
    return float((solved.y[:, -1] * sine).sum() / (speed * np.square(sine).sum()))


def taylor_green(
    x: np.ndarray, y: np.ndarray, time: float, length: float, speed: float, nu: float
) -> tuple[np.ndarray, np.ndarray]:
    """Velocity of the plane Taylor-Green vortices [m/s], an exact solution in a periodic square.

    u = -U cos(2 pi x/L) sin(2 pi y/L) e^(-8 pi^2 nu t/L^2), v the same with -sin, cos.
    Taylor & Green (1937), doi:10.1098/rspa.1937.0036.
    """
    k = 2.0 * math.pi / length
    fade = speed * math.exp(-2.0 * nu * k * k * time)
    return -fade * np.cos(k * x) * np.sin(k * y), fade * np.sin(k * x) * np.cos(k * y)


def taylor_green_energy_rate(length: float, nu: float) -> float:
    """Decay rate of their kinetic energy, 16 pi^2 nu/L^2 [1/s]."""
    return 16.0 * math.pi**2 * nu / length**2


COLLAPSE_TIME = (0.41, 0.84, 1.19, 1.43, 1.63, 1.83, 1.98, 2.20, 2.32, 2.51, 2.65, 2.83, 2.98)
"""t sqrt(2 g/a) of the front of a collapsing column a wide and 2 a high, measured."""
COLLAPSE_FRONT = (1.11, 1.22, 1.44, 1.67, 1.89, 2.11, 2.33, 2.56, 2.78, 3.00, 3.22, 3.44, 3.67)
"""x/a of that front.  Martin & Moyce (1952), doi:10.1098/rsta.1952.0006, table 2, a = 2.25 inches;
Koshizuka & Oka (1996), doi:10.13182/NSE96-A24205, measured the same within 2 %."""


def collapse_front(time: np.ndarray) -> np.ndarray:
    """Front x/a of the collapsing column at t sqrt(2 g/a), between the measured points."""
    return np.interp(time, (0.0, *COLLAPSE_TIME), (1.0, *COLLAPSE_FRONT))
