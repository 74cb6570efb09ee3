"""Training: torch's sums are the kernels', and a short training learns. Needs torch, an extra."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is an extra: pip install 'vesselflow[train]'")

from app.scenes import find_scene  # noqa: E402
from nn.features import FeatureScales  # noqa: E402
from nn.pcnet import PcNet  # noqa: E402
from nn.stage import Stage  # noqa: E402
from nn.train import Model, Sample  # noqa: E402
from nn.weights import Training  # noqa: E402
from taichi_sph.vessel import read_vessel  # noqa: E402

CLOSE = {"f64": 2e-6, "f32": 2e-5}
"""Of the largest acceleration; torch sums in f32."""


@pytest.fixture(scope="module")
def stage() -> Stage:
    """A small column in the straight tube, a while after it has let go."""
    scene = find_scene("tube")
    grid = msgspec.structs.replace(scene.discretization, spacing=1.25e-3)
    column = msgspec.structs.replace(scene.column, height=0.015, particles=None)
    scene = msgspec.structs.replace(scene, discretization=grid, column=column)
    stage = Stage(scene, read_vessel(scene), 0)
    stage.advance_to(0.01)
    # Stirred, so that every term of the sums matters.
    state = stage.state()
    noise = np.random.default_rng(0).normal(size=state.velocity.shape)
    stage.restore(
        type(state)(
            state.position,
            (state.velocity + 0.05 * noise).astype(state.velocity.dtype),
            state.alive,
        ),
        stage.time,
        stage.steps,
    )
    return stage


@pytest.mark.parametrize("head", ["direct", "pressure"])
def test_what_torch_trains_is_what_the_kernels_run(stage, head, precision):
    d, radius = stage.scene.discretization.spacing, stage.fluid.kernel.support_radius
    sound = stage.derived.sound_speed
    scales = FeatureScales(radius, d, 2e-4, sound)
    training = Training(head, d, radius, 2e-4, 4, sound, 1.0, "bp", 0, "tube", "")
    torch.manual_seed(1)
    features = stage.features(scales)
    model = Model(
        training,
        features.mean(axis=0)[: 23 if head == "direct" else 25],
        np.maximum(features.std(axis=0), 1e-2)[: 23 if head == "direct" else 25],
        0.7,
    )
    n = stage.particles.count[None]
    sample = Sample(stage, scales, np.zeros((n, 3)), np.ones(n, bool), pairs=head == "pressure")
    with torch.no_grad():
        expected = model.acceleration(sample, stage.fluid.state.rest_density).numpy()
    net = PcNet(model.weights(), stage.fluid, stage.particles.capacity)
    net.accelerate(stage.particles, stage.wall, stage.neighbors, (0.0, 0.0, 0.0))
    found = stage.particles.acceleration.to_numpy()[:n]
    scale = np.abs(expected).max()
    assert scale > 0.0
    assert np.abs(found - expected).max() < CLOSE[precision] * scale


def test_training_learns_and_its_weights_run(tmp_path: Path):
    import subprocess
    import sys

    data, out = tmp_path / "data.h5", tmp_path / "w.npz"
    scene = find_scene("box")  # blood that stands: without pressure it would fall
    folder = tmp_path / "box"
    folder.mkdir()
    surface = (Path(scene.folder) / "lumen.ply").read_bytes()
    (folder / "lumen.ply").write_bytes(surface)
    text = scene.text.replace("spacing = 0.001 ", "spacing = 0.002 ")
    assert text != scene.text
    (folder / "scene.toml").write_text(text)
    vesselflow = [sys.executable, "-m", "app"]
    subprocess.run(
        [*vesselflow, "record", folder, "--heights", "0.012,0.020", "--frames", "60",
         "--out", data],
        check=True, capture_output=True,
    )  # fmt: skip
    losses = []
    for iterations in ("4", "60"):
        subprocess.run(
            [*vesselflow, "train", data, "--out", out, "--iterations", iterations],
            check=True, capture_output=True,
        )  # fmt: skip
        history = msgspec.json.decode(out.with_suffix(".history.json").read_bytes())
        losses.append(history[-1]["loss"])
    with np.load(out) as weights:
        assert weights["weight_0"].shape == (5, 25)
    # Means over all steps so far: the longer training must have spent most of them knowing more.
    assert losses[1] < 0.8 * losses[0]
    result = subprocess.run(
        [*vesselflow, "run", folder, "--until", "0.002", "--model", "pcnet", "--weights", out],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert "leaks 0" in result.stdout
