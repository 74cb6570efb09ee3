"""Peers: SPlisHSPlasH gets the blood, the wall and the rules that our own methods get."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.jobs.process import in_own_process
from app.scenes.library import find_scene, with_column
from app.studies import chart
from app.studies.methods import METHODS, PEERS, Method
from app.studies.splishsplash import (
    DELIVERED,
    FRICTION,
    SETBACK,
    SOLVERS,
    Peer,
    has_peer,
    wall_behind,
)
from app.studies.timed_run import RULES, TimedRun, Trace
from taichi_sph.errors import InputError
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.scene import Scene

needs_peer = pytest.mark.skipif(not has_peer(), reason="pysplishsplash is not installed")


def small() -> Scene:
    """A low column at the top of the tube, some 600 particles."""
    return with_column(find_scene("tube"), None, 0.004)


def settings(solver: str) -> dict[str, Any]:
    """What SPlisHSPlasH says it was given."""
    peer = Peer(small(), solver, step_factor=0.5)
    fluid, method = peer._fluid, peer._simulation.getTimeStep()
    viscosity = fluid.getViscosityBase()
    found = {
        "start": peer.positions(),
        "velocity": peer.velocities(),
        "mass": peer.particles.mass,
        "volume": fluid.getVolume(0),
        "support": peer._simulation.getSupportRadius(),
        "gravity": peer._simulation.getVec3ValueReal(peer._simulation.GRAVITATION),
        "viscosity": viscosity.getValueFloat(viscosity.VISCOSITY_COEFFICIENT),
        "friction": viscosity.getValueFloat(viscosity.VISCOSITY_COEFFICIENT_BOUNDARY),
        "courant": peer._simulation.getValueFloat(peer._simulation.CFL_FACTOR),
        "shortest": peer._simulation.getValueFloat(peer._simulation.CFL_MIN_TIMESTEPSIZE),
        "step": peer._stable_step(),
        "proxies": peer.derived.proxy_particles,
    }
    if solver == "splishsplash-wcsph":
        found["stiffness"] = method.getValueFloat(method.STIFFNESS)
        found["exponent"] = method.getValueFloat(method.EXPONENT)
    return found


@needs_peer
@pytest.mark.parametrize("solver", SOLVERS)
def test_the_peer_has_the_same_blood_wall_and_liquid(solver: str) -> None:
    found = in_own_process(settings, solver)
    scene = small()
    vessel, d = read_vessel(scene), scene.discretization.spacing
    blood = vessel.fill_column(scene.column, d)
    np.testing.assert_allclose(found["start"], blood, atol=1e-7)
    assert not found["velocity"].any()
    assert found["mass"] == pytest.approx(scene.blood.density * d**3, rel=1e-5)
    assert found["volume"] == pytest.approx(d**3, rel=1e-5)
    assert found["support"] == pytest.approx(2.0 * d, rel=1e-5)
    np.testing.assert_allclose(found["gravity"], scene.gravity, rtol=1e-6)
    viscosity = 3.5e-3 / 1060.0 / DELIVERED
    assert found["friction"] == pytest.approx(FRICTION * viscosity, rel=1e-5)
    assert found["shortest"] < 1e-7
    # Its Poisson disks are half a spacing apart.
    assert 2.0 < found["proxies"] * d**2 / vessel.wall_area < 3.5
    speed = np.sqrt(2.0 * np.ptp(vessel.vertices @ scene.gravity))
    assert found["viscosity"] == pytest.approx(viscosity + 0.05 * 0.05 * 10.0 * speed * d, rel=1e-5)
    if solver == "splishsplash-wcsph":
        assert found["stiffness"] == pytest.approx(1060.0 * (10.0 * speed) ** 2 / 7.0, rel=1e-5)
        assert found["exponent"] == 7.0
        assert found["step"] < 0.5 * 0.4 * d / (10.0 * speed)
    else:
        assert found["courant"] == 0.5


def test_the_wall_is_moved_by_the_same_distance_everywhere() -> None:
    for name in ("box", "aortoiliac"):
        vessel = read_vessel(find_scene(name))
        setback = 5e-4
        wall = wall_behind(vessel, setback)
        assert len(wall.faces) == len(vessel.wall_faces)
        # Against the planes of the faces themselves, corners and edges included.
        before, after = vessel.vertices[vessel.wall_faces], wall.vertices[wall.faces]
        normal = np.cross(before[:, 1] - before[:, 0], before[:, 2] - before[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        moved = np.einsum("fcx,fx->fc", after - before, normal)
        if name == "box":
            np.testing.assert_allclose(moved, setback, rtol=1e-6)
        assert np.median(moved) == pytest.approx(setback, rel=0.02)
        assert np.percentile(moved, 1) > 0.8 * setback


def cubic(r: np.ndarray) -> np.ndarray:
    """SPlisHSPlasH's kernel, support radius 2."""
    q = r / 2.0
    return (
        np.where(q < 0.5, 6.0 * q**3 - 6.0 * q**2 + 1.0, 2.0 * np.maximum(1.0 - q, 0.0) ** 3)
        / np.pi
    )


def drag(x: np.ndarray, u: np.ndarray) -> float:
    """Its viscous sum over neighbours at x that move at u along the first axis, volume 1."""
    r = np.linalg.norm(x, axis=1)
    slope = (cubic(r + 1e-5) - cubic(r - 1e-5)) / 2e-5 / r
    return float((10.0 * -u * x[:, 0] ** 2 / (r**2 + 0.01 * 2.0**2) * slope).sum())


def test_constants_are_those_of_its_kernel_on_a_lattice() -> None:
    axis = np.arange(-2.0, 3.0)
    x = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    x = x[x.any(axis=1)]
    w = cubic(np.linalg.norm(x, axis=1))
    assert w.sum() + 1.0 / np.pi == pytest.approx(1.0, abs=1e-4)
    assert drag(x, x[:, 2] ** 2) / 2.0 == pytest.approx(DELIVERED, rel=1e-2)
    # A wall sampled without gaps; its volumes make up for how densely.
    axis = np.arange(-2.0, 2.0, 0.02) + 0.01
    plane = np.stack(np.meshgrid(axis, axis, [0.0]), -1).reshape(-1, 3)
    volume = 1.0 / cubic(np.linalg.norm(plane, axis=1)).sum()
    wall = plane - [0.0, 0.0, SETBACK + 0.5]
    share = volume * cubic(np.linalg.norm(wall, axis=1)).sum()
    assert share == pytest.approx(w[x[:, 2] < 0.0].sum(), rel=1e-2)
    # Simple shear, at rest on the surface: half a spacing above it nothing pulls.
    blood = x[x[:, 2] >= 0.0]
    pull = drag(blood, blood[:, 2])
    assert pull + FRICTION * volume * drag(wall, np.full(len(wall), -0.5)) == pytest.approx(
        0.0, abs=1e-2 * pull
    )


def drain() -> tuple[Any, ...]:
    """Some blood put where it has left: beyond the outlet, through the wall and far away."""
    peer = Peer(small(), "splishsplash-dfsph")
    outlet = peer._open[-1]
    x = peer._position
    rows = np.argsort(peer._identity)
    # Too far apart to push each other.
    x[rows[:3]] = outlet.centre + outlet.normal * [[1e-3], [3e-3], [5e-3]]
    x[rows[3]] = outlet.centre - 1e-3 * outlet.normal  # still within
    x[rows[4]] = peer.vessel.bounds[1] + 1.0
    before = peer.diagnostics()
    peer.advance_to(1e-4)
    first = peer.diagnostics()
    for _ in range(3):
        peer.advance_to(peer.time + 1e-3)
    return outlet.name, len(rows), before, first, peer.diagnostics(), peer.positions()


@needs_peer
def test_what_has_left_is_counted_once_and_stays_out() -> None:
    outlet, blood, before, first, last, positions = in_own_process(drain)
    assert (before.particles, before.leaks) == (blood, 1)  # the outlet explains the others
    assert first.particles == blood - 4
    assert first.drained[outlet] == 3
    assert sum(first.drained.values()) == 3
    assert first.leaks == 1  # lost for good
    assert first.drained_volume == pytest.approx(3 * 0.7e-3**3, rel=1e-4)
    assert last.drained[outlet] >= 3
    assert last.leaks == 1
    assert len(positions) == last.particles
    assert np.abs(positions).max() < 0.1
    assert last.max_speed < 1.0


def pour(method: Method) -> TimedRun:
    """Three frames, judged."""
    poured = TimedRun(method.name, method.simulation(small()), Trace(0.005), rules=RULES)
    for frame in range(1, 4):
        poured.frame(0.005 * frame)
    # Views of foreign memory do not travel.
    poured.simulation = None  # type: ignore[assignment]
    return poured


@needs_peer
@pytest.mark.parametrize("method", [PEERS[0], PEERS[5]], ids=lambda method: method.name)
def test_a_short_pour_falls_and_does_not_leak(method: Method) -> None:
    poured = in_own_process(pour, method)
    assert poured.failure == ""
    assert poured.most_leaks == 0
    energy = poured.trace.energy
    # 15 ms of free fall at the most, and most of it.
    assert np.isfinite(energy).all()
    assert 0.5 < energy[-1] / (0.5 * (9.81 * 0.015) ** 2) < 1.02


def test_methods_of_the_peer_have_names_of_their_own_and_scale_with_the_scene() -> None:
    assert {method.model for method in PEERS} == set(SOLVERS)
    assert len({method.name for method in (*METHODS, *PEERS)}) == len(METHODS) + len(PEERS)
    coarse = replace(PEERS[0], spacing=2.0).scene(small())
    assert coarse.discretization.spacing == 2.0 * small().discretization.spacing


def test_a_peer_that_is_not_installed_is_one_sentence(monkeypatch) -> None:
    monkeypatch.setattr("app.studies.splishsplash.has_peer", lambda: False)
    with pytest.raises(InputError, match=r"^--peer: pysplishsplash is not installed"):
        chart.select_methods([], "", True)
