"""PcNet's kernels against numpy and torch, and its weights file."""

import json
import shutil
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

from app.cli import invoke
from builders import DENSITY, D, R, jittered_lattice, make_fluid, periodic, precision
from clouds import SCALES, cloud, extracted
from nn.features import DENSITY_RATIO, DIVERGENCE, NAMES, NETWORK_COUNT, PAPER_COUNT, RESPONSE
from nn.pcnet import DirectPcNet, PressurePcNet, largest_factors, make_pcnet
from nn.weights import Training, Weights, require_fit
from places import ROOT
from taichi_sph.errors import InputError
from taichi_sph.fluid.implicit import LARGEST_ADVECTIVE_CFL, LARGEST_VISCOSITY, SMALLEST_DIAGONAL
from taichi_sph.fluid.rheology import Newtonian

CLOSE = {"f64": 1e-6, "f32": 1e-5}
"""Of the largest output; weights are f32 in both precisions."""
GRAVITY = (0.0, -9.81, 0.0)
FLUID = make_fluid()


def weights(head: str, seed: int = 0) -> Weights:
    """A random network of the paper's size."""
    generator = np.random.default_rng(seed)
    sizes = (PAPER_COUNT, 5, 5, 5, 3) if head == "direct" else (NETWORK_COUNT, 5, 5, 5, 3)
    layers = tuple(
        (
            generator.normal(size=(b, a)).astype(np.float32) / np.float32(np.sqrt(a)),
            generator.normal(size=b).astype(np.float32),
        )
        for a, b in pairwise(sizes)
    )
    training = Training(
        head=head,
        inputs=NAMES[: sizes[0]],
        spacing=D,
        support_radius=R,
        frame_interval=SCALES.frame_interval,
        substeps=4,
        rounds=0,
        sound_speed=SCALES.sound_speed,
        wall_spacing_ratio=1.0,
        artificial_viscosity=0.0,
        viscosity_ratio=17.3,
        correction="bp",
        seed=0,
        scene="tube",
        scene_hash="0" * 64,
    )
    return Weights(
        layers,
        generator.normal(size=sizes[0]).astype(np.float32) * np.float32(0.1),
        np.full(sizes[0], 0.5, np.float32),
        np.full(sizes[-1], 0.3, np.float32),
        training,
    )


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1/(1 + exp(-x))."""
    return 1.0 / (1.0 + np.exp(-x))


def test_the_direct_head_is_the_network_of_the_features():
    stage = cloud(5)
    w = weights("direct")
    f = extracted(stage)
    expected = w.evaluate(f[:, :PAPER_COUNT]) * SCALES.acceleration
    net = DirectPcNet(w, FLUID, SCALES, stage.particles.capacity)
    net.guarded = False
    net.accelerate(stage.particles, stage.wall, stage.neighbors, GRAVITY)
    found = stage.in_order(stage.particles.acceleration)
    assert np.abs(found - expected).max() < CLOSE[precision()] * np.abs(expected).max()


def test_the_pressure_head_gives_numbers_that_are_not_negative():
    stage = cloud(6)
    w = weights("pressure")
    f = extracted(stage)
    o = w.evaluate(f[:, :NETWORK_COUNT])
    # So thick that half of the viscosities meet their bound.
    bound = LARGEST_VISCOSITY * DENSITY * R**2 / SCALES.frame_interval
    fluid = make_fluid(rheology=Newtonian(float(bound / np.exp(np.median(o[:, 2])))))
    net = PressurePcNet(w, fluid, SCALES, stage.particles.capacity)
    net.accelerate(stage.particles, stage.wall, stage.neighbors, GRAVITY)
    speed = R / SCALES.frame_interval
    density = FLUID.equation_of_state.rest_density
    stiffness, damping = largest_factors(0)
    excess = stiffness * sigmoid(o[:, 0]) * (f[:, DENSITY_RATIO] - 1.0)
    excess -= damping * sigmoid(o[:, 1]) * f[:, DIVERGENCE]
    pressure = (
        speed**2 / density * np.maximum(excess, 0.0) / np.maximum(f[:, RESPONSE], SMALLEST_DIAGONAL)
    )
    assert 0.1 < np.mean(pressure > 0.0) < 0.9
    viscosity = np.minimum(fluid.rheology.eta * np.exp(o[:, 2]), bound)
    assert 0.1 < np.mean(viscosity < bound) < 0.9
    for field, expected in (
        (net.implicit.pressure_term, pressure),
        (net.implicit.viscosity, viscosity),
    ):
        found = stage.in_order(field)
        assert found.min() >= 0.0
        assert np.abs(found - expected).max() < CLOSE[precision()] * expected.max()


def test_the_pressure_head_conserves_momentum_whatever_its_weights():
    generator = np.random.default_rng(7)
    stage = periodic()
    x = jittered_lattice(generator)
    stage.put(x, 0.03 * generator.normal(size=x.shape))
    stage.build()
    fluid = make_fluid(rheology=Newtonian(3.5e-3))
    net = make_pcnet(weights("pressure", seed=4), fluid, SCALES, stage.particles.capacity)
    net.accelerate(stage.particles, stage.wall, stage.neighbors, (0.0, 0.0, 0.0))
    a = stage.in_order(stage.particles.acceleration)
    magnitude = np.linalg.norm(a, axis=1).sum()
    assert magnitude > 0.0
    assert np.abs(a.sum(axis=0)).max() < {"f64": 1e-13, "f32": 2e-6}[precision()] * magnitude


def test_the_step_shortens_for_blood_faster_than_any_in_training():
    net = make_pcnet(weights("pressure"), FLUID, SCALES, 8)
    assert net.stable_step(0.1 * SCALES.speed_limit, 1e9) == SCALES.frame_interval
    fast = 4.0 * SCALES.speed_limit
    assert net.stable_step(fast, 1e9) * fast == pytest.approx(LARGEST_ADVECTIVE_CFL * R, rel=1e-12)


def test_the_physics_takes_over_from_a_direct_head_that_lets_blood_collapse():
    stage = cloud(9)
    fluid = make_fluid(rheology=Newtonian(3.5e-3))
    net = DirectPcNet(weights("direct"), fluid, SCALES, stage.particles.capacity)
    step = stage.particles, stage.wall, stage.neighbors, GRAVITY
    x, v = (stage.in_order(f) for f in (stage.particles.position, stage.particles.velocity))
    stage.put(x[::3], v[::3])
    stage.build()
    net.accelerate(*step)
    assert not net.used_fallback
    assert net.stable_step(1e-9, 1.0) == SCALES.frame_interval
    # All of it, a tenth closer: a third denser.
    stage.put(0.9 * x, v)
    stage.build()
    net.accelerate(*step)
    assert net.used_fallback
    found = stage.in_order(stage.particles.acceleration)
    expected = stage.reference(fluid).acceleration(np.asarray(GRAVITY))
    assert np.abs(found - expected).max() < CLOSE[precision()] * np.abs(expected).max()
    assert net.stable_step(1.0, 1.0) == net.physics.stable_step(1.0, 1.0)


def test_the_network_is_the_one_that_torch_trains():
    torch = pytest.importorskip(
        "torch", reason="torch is an extra: pip install 'vesselflow[train]'"
    )
    w = weights("direct", seed=3)
    x = np.random.default_rng(1).normal(size=(50, PAPER_COUNT)).astype(np.float32)
    y = ((torch.from_numpy(x) - torch.from_numpy(w.mean)) / torch.from_numpy(w.deviation)).clamp(
        -5, 5
    )
    for k, (weight, bias) in enumerate(w.layers):
        y = torch.nn.functional.linear(y, torch.from_numpy(weight), torch.from_numpy(bias))
        y = torch.nn.functional.softsign(y) if k + 1 < len(w.layers) else y
    np.testing.assert_allclose(w.evaluate(x), 0.3 * y.numpy(), rtol=1e-5, atol=1e-5)


def test_weights_survive_the_file(tmp_path):
    w = weights("pressure")
    w.save(tmp_path / "w.npz")
    again = Weights.load(tmp_path / "w.npz")
    assert again.training == w.training
    assert again.sizes == (NETWORK_COUNT, 5, 5, 5, 3)
    x = np.random.default_rng(0).normal(size=(9, NETWORK_COUNT)).astype(np.float32)
    np.testing.assert_array_equal(again.evaluate(x), w.evaluate(x))


def test_files_that_are_no_weights_are_one_sentence(tmp_path):
    good = tmp_path / "good.npz"
    weights("direct").save(good)
    cut = tmp_path / "cut.npz"
    cut.write_bytes(good.read_bytes()[:1000])
    text = tmp_path / "text.npz"
    text.write_text("weights")
    other = tmp_path / "other.npz"
    np.savez(other, a=np.zeros(3))
    newer = tmp_path / "newer.npz"
    np.savez(newer, schema=99, training=json.dumps({}))
    for path in (cut, text, other, newer, tmp_path / "none.npz"):
        with pytest.raises(InputError, match=f"^{path}: ") as error:
            Weights.load(path)
        assert "\n" not in str(error.value)


def test_weights_for_another_scene_name_the_field_and_both_values():
    w = weights("direct")
    require_fit(w, "w.npz", {"support_ratio": R / D})
    with pytest.raises(
        InputError, match=r"^w.npz: viscosity_ratio is 17.3 in the weights, 1 in the scene"
    ):
        require_fit(w, "w.npz", {"support_ratio": R / D, "viscosity_ratio": 1.0})


def run(*options: str) -> subprocess.CompletedProcess[str]:
    """`vesselflow run` with the network."""
    command = [sys.executable, "-m", "app", "run", *options, "--model", "pcnet"]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)


@pytest.mark.validation
def test_shipped_weights_pour_a_height_they_never_saw(tmp_path):
    summary = tmp_path / "summary.json"
    options = ("aortoiliac", "--height", "0.012", "--until", "0.02")
    result = run(*options, "--summary", str(summary))
    assert result.returncode == 0, result.stderr
    told = json.loads(summary.read_text())
    assert told["model"] == "pcnet"
    assert told["leaks"] == 0
    assert told["compression_p99"] < 0.1
    assert not told["diverged"]
    again = tmp_path / "again.json"
    assert run(*options, "--summary", str(again)).returncode == 0
    # Bitwise: any difference in a velocity would show in the sum of their squares.
    assert json.loads(again.read_text())["kinetic_energy"] == told["kinetic_energy"]


def test_shipped_weights_refuse_another_liquid(tmp_path):
    folder = tmp_path / "thin"
    shutil.copytree(ROOT / "assets" / "vessels" / "tube", folder)
    scene = folder / "scene.toml"
    text = scene.read_text().replace("height = 0.02 ", "height = 0.004 ")
    assert text != scene.read_text()
    for old, new, field in (
        ("[blood]", "[blood]\nartificial_viscosity = 0.2", "artificial_viscosity is 0 in the"),
        ("[discretization]", "[discretization]\nsupport_ratio = 3.0", "support_ratio is 2 in the"),
    ):
        assert old in text
        scene.write_text(text.replace(old, new))
        message, code = invoke(["run", str(folder), "--model", "pcnet"])
        assert code == 2
        assert "\n" not in message
        assert field in message
