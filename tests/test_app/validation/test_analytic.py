"""The closed forms against limits, each other and the equations that they solve."""

import math
from functools import partial

import numpy as np
import pytest

from app.validation import analytic

RADIUS, DRIVE, ETA, TAU_Y, DENSITY = 2e-3, 50.0, 3.5e-3, 5e-3, 1060.0


def _flow_rate(r, u):
    return 2.0 * math.pi * np.trapezoid(u * r, r)


def test_the_poiseuille_profile_carries_hagen_and_poiseuilles_flow_rate():
    r = np.linspace(0.0, RADIUS, 4001)
    u = analytic.pipe_speed(r, RADIUS, DRIVE, ETA)
    assert _flow_rate(r, u) == pytest.approx(analytic.pipe_flow_rate(RADIUS, DRIVE, ETA), rel=1e-6)


def test_pipe_start_up_begins_at_rest_and_ends_steady():
    r = np.linspace(0.0, RADIUS, 50)
    steady = analytic.pipe_speed(r, RADIUS, DRIVE, ETA)
    at_rest = analytic.pipe_start_up(r, 0.0, RADIUS, DRIVE, ETA, DENSITY)
    late = analytic.pipe_start_up(r, 10.0 * RADIUS**2 * DENSITY / ETA, RADIUS, DRIVE, ETA, DENSITY)
    assert np.abs(at_rest).max() < 1e-6 * steady.max()
    assert late == pytest.approx(steady, abs=1e-12)


def test_pipe_start_up_obeys_the_momentum_equation():
    r = np.linspace(0.0, RADIUS, 2001)
    t, dt = 0.1 * RADIUS**2 * DENSITY / ETA, 1e-5

    def u(time):
        return analytic.pipe_start_up(r, time, RADIUS, DRIVE, ETA, DENSITY)

    accelerated = DENSITY * (u(t + dt) - u(t - dt)) / (2.0 * dt)
    slope = np.gradient(u(t), r, edge_order=2)
    viscous = ETA * np.gradient(r * slope, r, edge_order=2)[5:-5] / r[5:-5]
    assert accelerated[5:-5] == pytest.approx(DRIVE + viscous, abs=1e-3 * DRIVE)


def _pulsation(number, r, phase):
    """Speed at a Womersley number and a part of the period, and its angular frequency."""
    w = ETA / DENSITY * (number / RADIUS) ** 2
    time = phase * 2.0 * math.pi / w
    return analytic.pipe_pulsation(r, time, RADIUS, DRIVE, w, ETA, DENSITY), w


@pytest.mark.parametrize("number", [0.5, 4.0, 15.0])
@pytest.mark.parametrize("phase", [0.0, 0.2, 0.7])
def test_a_pulsating_pipe_obeys_the_momentum_equation_and_sticks_to_the_wall(number, phase):
    r = np.linspace(0.0, RADIUS, 4001)
    u, w = _pulsation(number, r, phase)
    part = 1e-4
    rise = _pulsation(number, r, phase + part)[0] - _pulsation(number, r, phase - part)[0]
    accelerated = DENSITY * rise / (2.0 * part * 2.0 * math.pi / w)
    slope = np.gradient(u, r, edge_order=2)
    viscous = ETA * np.gradient(r * slope, r, edge_order=2)[5:-5] / r[5:-5]
    driven = DRIVE * math.cos(2.0 * math.pi * phase)
    assert accelerated[5:-5] == pytest.approx(driven + viscous, abs=1e-3 * DRIVE)
    assert abs(u[-1]) < 1e-12 * DRIVE / (DENSITY * w)


@pytest.mark.parametrize("phase", [0.0, 0.1, 0.5])
def test_a_slow_pulse_is_poiseuille_flow_at_every_moment(phase):
    r = np.linspace(0.0, RADIUS, 50)
    steady = analytic.pipe_speed(r, RADIUS, DRIVE, ETA)
    u, _ = _pulsation(0.05, r, phase)
    assert u == pytest.approx(steady * math.cos(2.0 * math.pi * phase), abs=1e-3 * steady.max())


@pytest.mark.parametrize("phase", [0.0, 0.1, 0.25])
def test_a_fast_pulse_moves_blood_as_a_plug_a_quarter_period_late(phase):
    r = np.linspace(0.0, 0.7 * RADIUS, 50)
    u, w = _pulsation(50.0, r, phase)
    plug = DRIVE / (DENSITY * w)
    assert u == pytest.approx(plug * math.sin(2.0 * math.pi * phase), abs=1e-3 * plug)


@pytest.mark.parametrize("number", [0.5, 4.0, 15.0])
def test_a_pulsating_profile_carries_the_pulsating_flow_rate(number):
    r = np.linspace(0.0, RADIUS, 20001)
    at_zero, w = _pulsation(number, r, 0.0)
    a_quarter_on, _ = _pulsation(number, r, 0.25)
    rate = analytic.pipe_pulsation_flow_rate(RADIUS, DRIVE, w, ETA, DENSITY)
    assert _flow_rate(r, at_zero) == pytest.approx(rate.real, abs=1e-6 * abs(rate))
    assert _flow_rate(r, a_quarter_on) == pytest.approx(-rate.imag, abs=1e-6 * abs(rate))


def test_the_womersley_number_of_an_artery():
    # 5.4 mm across, 70 beats a minute.
    number = analytic.womersley_number(2.7e-3, 2.0 * math.pi * 70.0 / 60.0, ETA, DENSITY)
    assert number == pytest.approx(4.0, rel=0.01)


def test_channel_start_up_obeys_the_momentum_equation():
    width = 2e-3
    y = np.linspace(0.0, width, 2001)
    t, dt = 0.05 * width**2 * DENSITY / ETA, 1e-5

    def u(time):
        return analytic.channel_start_up(y, time, width, DRIVE, ETA, DENSITY)

    accelerated = DENSITY * (u(t + dt) - u(t - dt)) / (2.0 * dt)
    viscous = ETA * np.gradient(np.gradient(u(t), y, edge_order=2), y, edge_order=2)
    assert accelerated[5:-5] == pytest.approx((DRIVE + viscous)[5:-5], abs=1e-3 * DRIVE)
    assert np.abs(u(0.0)).max() < 1e-6 * DRIVE * width**2 / ETA


@pytest.mark.parametrize("beta", [0.01, 0.1, 0.3, 0.6])
def test_the_ideal_casson_profile_has_cassons_stress_and_flow_rate(beta):
    drive = 2.0 * TAU_Y / (beta * RADIUS)
    r = np.linspace(0.0, RADIUS, 40001)
    u = analytic.casson_pipe_speed(r, RADIUS, drive, ETA, TAU_Y)
    shear = -np.gradient(u, r, edge_order=2)
    outside = r > 1.02 * beta * RADIUS
    stress = (np.sqrt(TAU_Y) + np.sqrt(ETA * shear[outside])) ** 2
    assert stress[1:-1] == pytest.approx((0.5 * drive * r)[outside][1:-1], rel=1e-4)
    assert np.ptp(u[r < beta * RADIUS]) == 0.0
    assert _flow_rate(r, u) == pytest.approx(
        analytic.casson_pipe_flow_rate(RADIUS, drive, ETA, TAU_Y), rel=1e-6
    )


def test_a_casson_liquid_below_its_yield_stress_does_not_flow():
    drive = 1.9 * TAU_Y / RADIUS
    assert analytic.casson_pipe_flow_rate(RADIUS, drive, ETA, TAU_Y) == 0.0
    assert not analytic.casson_pipe_speed(np.array([0.0, 1e-3]), RADIUS, drive, ETA, TAU_Y).any()


def test_the_plug_ratio_is_yield_stress_over_wall_stress():
    shear_rate = 8.0
    wall_stress = (math.sqrt(TAU_Y) + math.sqrt(ETA * shear_rate)) ** 2
    assert analytic.plug_ratio(shear_rate, ETA, TAU_Y) == pytest.approx(TAU_Y / wall_stress)


def test_quadrature_returns_poiseuille_for_a_newtonian_liquid():
    r, u, rate = analytic.generalised_pipe(RADIUS, DRIVE, lambda g: ETA)
    assert u == pytest.approx(analytic.pipe_speed(r, RADIUS, DRIVE, ETA), abs=1e-10)
    assert rate == pytest.approx(analytic.pipe_flow_rate(RADIUS, DRIVE, ETA), rel=1e-10)


def test_the_regularised_casson_pipe_tends_to_the_ideal_one():
    drive = 2.0 * TAU_Y / (0.3 * RADIUS)
    ideal = analytic.casson_pipe_flow_rate(RADIUS, drive, ETA, TAU_Y)
    errors = []
    for n in (7.0, 1e3, 1e5):
        r, u, rate = analytic.generalised_pipe(
            RADIUS, drive, partial(analytic.regularised_casson, eta=ETA, tau_y=TAU_Y, n=n)
        )
        assert _flow_rate(r, u) == pytest.approx(rate, rel=1e-5)
        errors.append(abs(rate / ideal - 1.0))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-3


@pytest.mark.parametrize(
    ("shear_rate", "viscosity"), [(1.0, 6.185169e-2), (100.0, 5.5308969e-3), (1e4, 3.241822e-3)]
)
def test_cassons_law_agrees_with_the_figures_of_hemelbs_unit_test(shear_rate, viscosity):
    # tau_y = 0.1937^2 Pa, eta = 0.055^2 Pa s, no regulariser: n is taken large.
    mu = analytic.regularised_casson(shear_rate, 0.055**2, 0.1937**2, 1e9)
    assert mu == pytest.approx(viscosity, rel=1e-6)


def test_the_regularised_viscosity_is_finite_and_largest_at_rest():
    plateau = analytic.regularised_casson(0.0, ETA, TAU_Y, 7.0)
    assert plateau == pytest.approx(60.6e-3, rel=1e-3)  # physics.md, finding 2
    assert analytic.regularised_casson(1e-12, ETA, TAU_Y, 7.0) == pytest.approx(plateau, rel=1e-5)


def test_hydrostatic_pressure_balances_the_weight_above():
    z = np.linspace(0.0, 1.0, 20001)
    rho = analytic.hydrostatic_density(z, 9.81, 1000.0, 20.0)
    p = analytic.hydrostatic_pressure(z, 9.81, 1000.0, 20.0)
    weight = 9.81 * np.concatenate([[0.0], np.cumsum(0.5 * (rho[1:] + rho[:-1]) * np.diff(z))])
    assert p == pytest.approx(weight, rel=1e-8, abs=1e-6)


def test_a_column_sinks_but_keeps_its_mass():
    fill, c = 1.0, 20.0
    height = analytic.hydrostatic_height(fill, 9.81, 1000.0, c)
    z = np.linspace(0.0, height, 20001)
    mass = np.trapezoid(analytic.hydrostatic_density(z, 9.81, 1000.0, c), z)
    assert mass == pytest.approx(1000.0 * fill, rel=1e-8)
    assert fill - height == pytest.approx(9.81 * fill**2 / (2.0 * c**2), rel=0.1)


def test_taylor_green_is_solenoidal_and_its_energy_decays_at_the_stated_rate():
    length, nu, n = 1.0, 1e-3, 64
    x, y = np.meshgrid(np.arange(n) / n, np.arange(n) / n, indexing="ij")
    u, v = analytic.taylor_green(x, y, 0.0, length, 2.0, nu)
    assert np.fft.ifft2(
        np.fft.fft2(u) * 2j * np.pi * np.fft.fftfreq(n, 1 / n)[:, None]
        + np.fft.fft2(v) * 2j * np.pi * np.fft.fftfreq(n, 1 / n)[None, :]
    ).real == pytest.approx(0.0, abs=1e-10)
    t = 3.0
    later = np.square(analytic.taylor_green(x, y, t, length, 2.0, nu)).sum()
    rate = -math.log(later / (u**2 + v**2).sum()) / t
    assert rate == pytest.approx(analytic.taylor_green_energy_rate(length, nu), rel=1e-12)


def test_the_measured_front_starts_at_the_dam_and_only_advances():
    t = np.linspace(0.0, 2.98, 100)
    front = analytic.collapse_front(t)
    assert front[0] == 1.0
    assert (np.diff(front) > 0.0).all()
    # Slower than the thin tongue of Ritter's ideal dam break, 2 sqrt(2) per unit of this time.
    assert np.diff(front).max() / (t[1] - t[0]) < 2.0 * math.sqrt(2.0)


def test_a_shear_wave_of_a_newtonian_liquid_decays_exponentially():
    k, mu, rho = 200.0, 3.5e-3, 1060.0
    time = 0.5 / analytic.shear_wave_rate(k, mu, rho)
    left = analytic.shear_wave_decay(k, 0.3, lambda _: mu, rho, time)
    assert left == pytest.approx(math.exp(-0.5), rel=2e-4)


def test_a_shear_wave_of_casson_blood_decays_between_those_of_its_least_and_largest_viscosity():
    k, rho, eta, tau_y, n = 200.0, 1060.0, 3.5e-3, 5e-3, 1.0
    time = 0.2 / analytic.shear_wave_rate(k, eta, rho)

    def left(speed: float) -> float:
        def law(g: float) -> float:
            return analytic.regularised_casson(g, eta, tau_y, n)

        return analytic.shear_wave_decay(k, speed, law, rho, time)

    # The faster, the nearer to eta; the slower, the nearer to the plateau.
    plateau = analytic.regularised_casson(0.0, eta, tau_y, n)
    assert left(100.0) == pytest.approx(math.exp(-0.2), rel=0.02)
    assert left(1e-8) == pytest.approx(math.exp(-0.2 * plateau / eta), rel=0.02)
    assert left(1e-8) < left(1e-2) < left(0.3) < left(100.0)
