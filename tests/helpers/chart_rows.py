"""A row of the chart, for tests that need one."""

import math

from app.studies.chart import Row

ROW = Row(
    scene="A", until=0.1, method="physics", curve="physics, spacing", blood_particles=1000,
    died="", survived=1.0, steps=100, step_factor=1.0, milliseconds_per_step=1.0,
    wall_per_simulated=100.0, yardstick=2.0, leaks=0, path=0.01, drained=0.02, energy=0.01,
    field=0.05, compression=0.01, half_drained=math.nan,
)  # fmt: skip
