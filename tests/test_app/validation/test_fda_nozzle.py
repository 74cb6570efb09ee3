"""The nozzle's survey on made-up flows, its table of measurements, and that a run goes on."""

import math

import numpy as np
import pytest

from app.validation import fda_nozzle
from app.validation.fda_nozzle import (
    AXIS,
    BINS,
    CUTS,
    FLOW,
    PROFILES,
    RADII,
    RING,
    ROW,
    Survey,
    half_width,
    survey,
)
from app.validation.report import Report
from driven_tube import VISCOSITY, make_tube

RADIUS, SPEED, D = 4e-3, 0.5, 4e-4


def parabola(z: int) -> tuple[np.ndarray, np.ndarray]:
    """Blood on a fine lattice about z [mm] in a tube of RADIUS, and its velocities."""
    line = np.arange(-20, 21) * 0.5 * D
    x = np.stack(np.meshgrid(line, line, np.arange(-4, 4) * 0.5 * D + 0.25 * D), -1).reshape(-1, 3)
    x = x[np.hypot(x[:, 0], x[:, 1]) < RADIUS] + [1e-6, 2e-6, 1e-3 * z]
    speed = SPEED * (1.0 - (x[:, 0] ** 2 + x[:, 1] ** 2) / RADIUS**2)
    return x, np.column_stack([0.0 * speed, 0.0 * speed, speed])


def test_a_parabola_has_its_speed_on_the_axis_its_width_and_its_flow():
    seen = Survey(0.5 * D)
    x, v = parabola(8)
    for _ in range(3):
        seen.look(x, v, np.full(len(x), 7.0))
    means = seen.means()
    row = ROW[8]
    assert means.axis[row] == pytest.approx(SPEED, rel=1e-9)
    wide = half_width(means.profile(row), float(means.axis[row]))
    assert wide == pytest.approx(2.0 * RADIUS * math.sqrt(0.5), abs=RING)
    # A lattice cut to a circle of 8 spacings has its area to some per cent.
    assert means.flow[row] == pytest.approx(0.5 * math.pi * RADIUS**2 * SPEED, rel=0.03)
    assert means.wall_pressure[row] == pytest.approx(7.0)
    sides = np.nanmean(means.speed[row], axis=1)
    assert np.ptp(sides) < 0.05 * SPEED  # lattice rows on the axes belong to one quarter


def test_a_jet_that_never_falls_to_half_has_no_width():
    assert math.isnan(half_width(np.full(BINS, 0.9), 1.0))


@pytest.mark.parametrize("z", [0, 8, 16])
def test_the_measured_profiles_carry_the_flow_and_begin_on_the_axis(z):
    speeds = np.array(PROFILES[z])
    radii = 1e-3 * np.array(RADII[: len(speeds)])
    assert speeds[0] == pytest.approx(AXIS[z][0], abs=0.001)
    # The laboratories' profiles hold 0.90 to 1.02 of Q near the expansion.
    fine = np.linspace(0.0, radii[-1], 2000)
    flow = np.trapezoid(2.0 * math.pi * fine * np.interp(fine, radii, speeds), fine)
    assert 0.88 < flow / FLOW < 1.04
    assert min(CUTS) < -62.685 < -40.0 < 0.0 < max(CUTS)


def test_a_run_that_was_stopped_goes_on_bitwise(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(fda_nozzle, "LOOK", 2e-4)
    monkeypatch.setattr(fda_nozzle, "KEPT", 2)
    scene = make_tube(tmp_path, VISCOSITY).scene
    ends, averaged = 1.6e-3, 1.2e-3

    def stop(fraction: float) -> None:
        if fraction > 0.6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        survey(Report(stop), scene, ends, averaged)
    kept = list((tmp_path / "cache" / "vesselflow").glob("validation-*"))
    assert len(kept) == 1
    begun: list[float] = []
    went_on, one = survey(Report(begun.append), scene, ends, averaged)
    assert min(begun) > 0.5  # not from the beginning
    assert not kept[0].exists()
    whole, other = survey(Report(lambda fraction: None), scene, ends, averaged)
    assert went_on.looks == whole.looks == 6
    assert np.array_equal(one.positions(), other.positions())
    assert np.array_equal(went_on.sums, whole.sums)
    assert np.array_equal(went_on.near_axis, whole.near_axis)
