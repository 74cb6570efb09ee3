"""PcNet's kernels against numpy and torch, and its weights file."""

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from builders import D, R, jittered_lattice, make_fluid, periodic, precision
from nn.features import COUNT, EXTENDED
from nn.pcnet import PRESSURE_FACTOR, VISCOSITY_FACTOR, PcNet
from nn.weights import Training, Weights, require_fit
from taichi_sph.errors import InputError
from test_features import SCALES, cloud, extracted

CLOSE = {"f64": 1e-6, "f32": 1e-5}
"""Of the largest output; weights are f32 in both precisions."""
GRAVITY = (0.0, -9.81, 0.0)
ROOT = Path(__file__).parent.parent
FLUID = make_fluid()


def weights(head: str, seed: int = 0) -> Weights:
    """A random network of the paper's size."""
    generator = np.random.default_rng(seed)
    sizes = (COUNT, 5, 5, 5, 3) if head == "direct" else (EXTENDED, 5, 5, 5, 2)
    layers = tuple(
        (
            generator.normal(size=(b, a)).astype(np.float32) / np.float32(np.sqrt(a)),
            generator.normal(size=b).astype(np.float32),
        )
        for a, b in pairwise(sizes)
    )
    training = Training(
        head, D, R, SCALES.frame_interval, 4, SCALES.sound_speed, 1.0, "bp", 0, "tube", "0" * 64
    )
    return Weights(
        layers,
        generator.normal(size=sizes[0]).astype(np.float32) * np.float32(0.1),
        np.full(sizes[0], 0.5, np.float32),
        np.full(sizes[-1], 0.3, np.float32),
        training,
    )


def test_the_direct_head_is_the_network_of_the_features():
    stage = cloud(5)
    w = weights("direct")
    f = extracted(stage)
    expected = w.evaluate(f[:, :COUNT]) * SCALES.acceleration
    net = PcNet(w, FLUID, stage.particles.capacity)
    net.accelerate(stage.particles, stage.wall, stage.neighbors, GRAVITY)
    found = stage.in_order(stage.particles.acceleration)
    assert np.abs(found - expected).max() < CLOSE[precision()] * np.abs(expected).max()


def test_the_pressure_head_gives_two_numbers_that_are_not_negative():
    stage = cloud(6)
    w = weights("pressure")
    f = extracted(stage)
    o = w.evaluate(f[:, :EXTENDED])
    net = PcNet(w, FLUID, stage.particles.capacity)
    net.accelerate(stage.particles, stage.wall, stage.neighbors, GRAVITY)
    speed = R / SCALES.frame_interval
    density = FLUID.state.rest_density
    pressure = PRESSURE_FACTOR * speed**2 / density * np.log1p(np.exp(o[:, 0]))
    viscosity = VISCOSITY_FACTOR * density * R * speed / (1.0 + np.exp(-o[:, 1]))
    for field, expected in ((net.pressure_term, pressure), (net.viscosity, viscosity)):
        found = stage.in_order(field)
        assert found.min() >= 0.0
        assert np.abs(found - expected).max() < CLOSE[precision()] * expected.max()


def test_the_pressure_head_conserves_momentum_whatever_its_weights():
    generator = np.random.default_rng(7)
    stage = periodic()
    x = jittered_lattice(generator)
    stage.put(x, 0.03 * generator.normal(size=x.shape))
    stage.build()
    net = PcNet(weights("pressure", seed=4), FLUID, stage.particles.capacity)
    net.accelerate(stage.particles, stage.wall, stage.neighbors, (0.0, 0.0, 0.0))
    a = stage.in_order(stage.particles.acceleration)
    magnitude = np.linalg.norm(a, axis=1).sum()
    assert magnitude > 0.0
    assert np.abs(a.sum(axis=0)).max() < {"f64": 1e-13, "f32": 2e-6}[precision()] * magnitude


def test_the_network_is_the_one_that_torch_trains():
    torch = pytest.importorskip(
        "torch", reason="torch is an extra: pip install 'vesselflow[train]'"
    )
    w = weights("direct", seed=3)
    x = np.random.default_rng(1).normal(size=(50, COUNT)).astype(np.float32)
    y = ((torch.from_numpy(x) - torch.from_numpy(w.mean)) / torch.from_numpy(w.deviation)).clamp(
        -5, 5
    )
    for k, (weight, bias) in enumerate(w.layers):
        y = torch.nn.functional.linear(y, torch.from_numpy(weight), torch.from_numpy(bias))
        y = torch.tanh(y) if k + 1 < len(w.layers) else y
    np.testing.assert_allclose(w.evaluate(x), 0.3 * y.numpy(), rtol=1e-5, atol=1e-5)


def test_weights_survive_the_file(tmp_path):
    w = weights("pressure")
    w.save(tmp_path / "w.npz")
    again = Weights.load(tmp_path / "w.npz")
    assert again.training == w.training
    assert again.sizes == (EXTENDED, 5, 5, 5, 2)
    x = np.random.default_rng(0).normal(size=(9, EXTENDED)).astype(np.float32)
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
    require_fit(w, "w.npz", {"spacing": D})
    with pytest.raises(
        InputError, match=r"^w.npz: spacing is 0.001 in the weights, 0.002 in the scene"
    ):
        require_fit(w, "w.npz", {"support_radius": R, "spacing": 2.0 * D})


def run(*options: str) -> subprocess.CompletedProcess[str]:
    """`vesselflow run` with the network."""
    command = [sys.executable, "-m", "app", "run", *options, "--model", "pcnet"]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)


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


def test_shipped_weights_refuse_another_scene():
    weights = ROOT / "assets" / "vessels" / "aortoiliac" / "pcnet.npz"
    result = run("A", "--weights", str(weights))
    assert result.returncode == 2
    assert result.stderr.strip().count("\n") == 0
    assert "spacing is 0.0009 in the weights, 0.0004402 in the scene" in result.stderr
