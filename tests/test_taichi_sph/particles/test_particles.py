"""Particles: a quantity is one entry, which sorting, saving and loading follow."""

from functools import cache

import numpy as np
import pytest

from builders import (
    CAPACITY,
    R,
    Setup,
    calibration,
    cubic_lattice,
    float_dtype,
    make_fluid,
    make_model,
    plane,
)
from states import through_a_file
from taichi_sph.boundary.boundary import BloodFlow
from taichi_sph.boundary.inflow import BufferRegions, add_blood
from taichi_sph.errors import RunError
from taichi_sph.fluid.rheology import Newtonian
from taichi_sph.particles.particles import QUANTITIES, Particles, Quantity
from taichi_sph.simulation import Simulation

MORE = (Quantity("dye"), Quantity("swirl", "vector"), Quantity("generation", "integer"))
"""One of each kind, which nothing in the packages knows."""


@cache
def particles() -> Particles:
    return Particles(CAPACITY, calibration().mass, MORE)


def marked(seed: int = 0) -> tuple[Setup, dict[str, np.ndarray]]:
    """Stirred blood on the plane wall whose new quantities are functions of the identity."""
    stage = Setup(particles(), *(getattr(plane(), name) for name in (
        "wall", "neighbors", "wall_position", "wall_normal")))  # fmt: skip
    generator = np.random.default_rng(seed)
    x = cubic_lattice(8, 8, 4)
    identity = generator.permutation(len(x)) + 100
    stage.particles.replace(
        {"identity": identity, "position": x, "velocity": 0.3 * generator.normal(size=x.shape),
         **made_of(identity)}
    )  # fmt: skip
    return stage, made_of(np.sort(identity))


def made_of(identity: np.ndarray) -> dict[str, np.ndarray]:
    third = identity[:, None] * [1.0, 2.0, 3.0]
    return {"dye": identity / 8.0, "swirl": third, "generation": 7 * identity}


def assert_follows(stage: Setup, expected: dict[str, np.ndarray]) -> None:
    for name, values in expected.items():
        found = stage.particles.in_order(getattr(stage.particles, name))
        # Multiples of an eighth are exact in f32 too.
        np.testing.assert_array_equal(found, values)


def test_new_quantities_are_fields_of_their_kind():
    p = particles()
    assert [q.name for q in p.quantities] == [q.name for q in (*QUANTITIES, *MORE)]
    stage, expected = marked()
    rows = p.rows()
    assert set(rows) == set(p.names)
    assert (rows["dye"].dtype, rows["swirl"].dtype) == (float_dtype(), float_dtype())
    assert (rows["generation"].dtype, rows["swirl"].shape) == (np.int32, (256, 3))
    assert_follows(stage, expected)


def test_new_quantities_go_with_their_particle_through_sorts():
    stage, expected = marked()
    before = stage.particles.identity.to_numpy()[:256].copy()
    sim = Simulation(
        BloodFlow(stage.particles, stage.wall, stage.neighbors, (0.0, 0.0, -9.81)),
        make_model(make_fluid(1.5, rheology=Newtonian(1e-3))), speed_limit=1e9,
    )  # fmt: skip
    builds = stage.neighbors.builds
    sim.advance_to(0.5 * R / 0.3)
    assert stage.neighbors.builds > builds + 2
    assert (stage.particles.identity.to_numpy()[:256] != before).any()
    assert_follows(stage, expected)


def test_new_quantities_are_saved_and_loaded(tmp_path):
    stage, expected = marked()
    sim = Simulation(
        BloodFlow(stage.particles, stage.wall, stage.neighbors, (0.0, 0.0, 0.0)),
        make_model(make_fluid(1.5)), speed_limit=1e9,
    )  # fmt: skip
    kept = through_a_file(sim.save_state(), tmp_path)
    x = cubic_lattice(2, 2, 2)
    sim.set_blood(np.arange(8), x, np.zeros_like(x))
    # Other blood has nothing of what was there before.
    assert_follows(stage, {name: 0 * values[:8] for name, values in expected.items()})
    sim.load_state(kept)
    assert_follows(stage, expected)
    # A state that is older than a quantity has none of it.
    older = {name: rows for name, rows in kept.particles.items() if name != "dye"}
    sim.particles.replace(older)
    assert_follows(stage, {**expected, "dye": 0.0 * expected["dye"]})


def test_added_blood_has_none_of_a_new_quantity_whatever_its_row_held():
    stage, expected = marked()
    p = stage.particles
    for field in (p.dye, p.swirl, p.generation):  # type: ignore[attr-defined]
        whole = field.to_numpy()
        whole[256:] = 99
        field.from_numpy(whole)
    x = np.array([[1e-3, 1e-3, 9e-3], [2e-3, 1e-3, 9e-3]], float_dtype())
    crowded = np.zeros(2, np.int32)
    assert add_blood(p, BufferRegions(), x, 0.0 * x, crowded, 1000, 1e-12) == 2
    stage.build()
    more = {name: np.concatenate([v, 0 * v[:2]]) for name, v in expected.items()}
    assert_follows(stage, more)
    assert p.identities()[-2:].tolist() == [1000, 1001]


def test_particles_at_no_place_are_refused():
    with pytest.raises(RunError, match="must be finite numbers"):
        Particles.from_numpy(np.array([[0.0, np.nan, 0.0]]))
