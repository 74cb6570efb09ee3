"""Training: torch's sums are the kernels', and a short training learns. Needs torch, an extra."""

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is an extra: pip install 'vesselflow[train]'")

from app.scenes.library import find_scene  # noqa: E402
from app.training.compare_networks import persistence, ridge  # noqa: E402
from builders import vesselflow  # noqa: E402
from nn.dataset.reader import Dataset  # noqa: E402
from nn.features import PAPER_COUNT, FeatureScales  # noqa: E402
from nn.pcnet import DirectPcNet, make_pcnet  # noqa: E402
from nn.training.rollout import ReplaySimulation  # noqa: E402
from nn.training.runs import INPUTS, Settings, TrainingRuns  # noqa: E402
from nn.training.torch_network import TorchNetwork, TrainingSample  # noqa: E402
from nn.training.train import Progress, train_weights  # noqa: E402
from nn.weights import Training, Weights  # noqa: E402
from taichi_sph.errors import InputError  # noqa: E402
from taichi_sph.geometry.vessel import read_vessel  # noqa: E402

CLOSE = {"f64": 2e-6, "f32": 2e-5}
"""Of the largest acceleration; torch sums in f32."""
ROUNDED = 2.0**-24
"""Of rho/rho_0 in f32: over a step it is as much of R/T^2."""


@pytest.fixture(scope="module")
def stage() -> ReplaySimulation:
    """A small column in the straight tube, a while after it has let go."""
    scene = find_scene("tube")
    grid = msgspec.structs.replace(scene.discretization, spacing=1.25e-3)
    column = msgspec.structs.replace(scene.column, height=0.015, particles=None)
    scene = msgspec.structs.replace(scene, discretization=grid, column=column)
    stage = ReplaySimulation(scene, read_vessel(scene), 0)
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
        stage.simulation.time,
        stage.simulation.steps,
    )
    return stage


@pytest.fixture(scope="module")
def runs(recorded: Path) -> Iterator[TrainingRuns]:
    """One for all trainings: each new one compiles everything again."""
    with Dataset(recorded) as file:
        yield TrainingRuns(file, [0])


@pytest.mark.parametrize(("head", "rounds"), [("direct", 0), ("pressure", 0), ("pressure", 2)])
def test_what_torch_trains_is_what_the_kernels_run(stage, head, rounds, precision):
    d, radius = stage.simulation.scene.discretization.spacing, stage.fluid.kernel.support_radius
    sound = stage.simulation.derived.sound_speed
    scales = FeatureScales(radius, d, 2e-4, sound)
    training = Training(
        head, INPUTS[head], d, radius, 2e-4, 4, rounds, sound, 1.0, 0.05, 17.3, "bp", 0, "tube", ""
    )
    torch.manual_seed(1)
    features = stage.features(scales)[:, training.columns.index]
    model = TorchNetwork(
        training, features.mean(axis=0), np.maximum(features.std(axis=0), 1e-2), 0.7
    )
    n = stage.simulation.particles.count[None]
    sample = TrainingSample(
        stage, scales, np.zeros((n, 3)), np.ones(n, bool), pairs=head == "pressure"
    )
    with torch.no_grad():
        fluid = stage.fluid
        down = torch.tensor((0.0, 0.0 if head == "direct" else -9.81, 0.0))
        density, eta = fluid.rest_density, fluid.rheology.eta
        expected = model.step(sample, density, eta, down).acceleration.numpy()
    net = make_pcnet(model.weights(), stage.fluid, scales, stage.simulation.particles.capacity)
    if isinstance(net, DirectPcNet):
        net.guarded = False
    net.accelerate(
        stage.simulation.particles,
        stage.simulation.wall,
        stage.simulation.neighbors,
        (0.0, -9.81, 0.0),
    )
    found = stage.simulation.particles.acceleration.to_numpy()[:n]
    scale = np.abs(expected).max()
    assert scale > 1e4 * ROUNDED * scales.acceleration
    close = CLOSE[precision] * scale + ROUNDED * scales.acceleration
    assert np.abs(found - expected).max() < close


def one_step_error(runs: TrainingRuns, weights: Weights) -> float:
    """Root mean square error of the acceleration over the held-out run [m/s^2]."""
    run, net, wrong = runs.held[0], runs.pcnet(weights), []
    particles = runs.replay.simulation.particles
    for frame in range(20, len(run), 8):
        runs.put(run, frame)
        runs.replay.simulation.model = net
        net.accelerate(
            particles,
            runs.replay.simulation.wall,
            runs.replay.simulation.neighbors,
            runs.scene.gravity,
        )
        n = particles.count[None]
        identity = particles.identity.to_numpy()[:n]
        valid = run.has_target(frame)[identity]
        found = particles.acceleration.to_numpy()[:n]
        wrong.append(((found - run.target(frame)[identity])[valid] ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(wrong).mean()))


SETTINGS = Settings(iterations=40, validate_every=10)


@pytest.fixture(scope="module")
def trained(runs: TrainingRuns, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a short training."""
    out = tmp_path_factory.mktemp("trained") / "whole.npz"
    _, history = train_weights(runs, out, SETTINGS, report=quiet)
    assert [row["iteration"] for row in history] == [10, 20, 30, 40]
    return out


def quiet(_: Progress) -> None:
    """Say nothing."""


@pytest.mark.validation
def test_training_learns_and_its_weights_run(runs: TrainingRuns, trained: Path):
    weights = Weights.load(trained)
    learned = one_step_error(runs, weights)
    # What needs no training: a straight line through the 23 features, and nothing at all.
    straight = one_step_error(runs, ridge(runs, Settings(head="direct")))
    nothing = one_step_error(runs, persistence(runs, Settings(head="direct")))
    assert learned < 0.7 * min(straight, nothing)
    figures = runs.rollout(runs.pcnet(weights), runs.held[0])
    assert figures["survived"] == 1.0
    # Blood that stands has compression from its own weight, g h/c^2 = 0.1 %, and from the layers'
    # settling; it must not collapse.
    assert figures["compression_p99"] < 0.1


@pytest.mark.validation
def test_the_command_trains_and_its_weights_run(box: Path, recorded: Path, tmp_path: Path):
    out, picture = tmp_path / "w.npz", tmp_path / "w.png"
    vesselflow("train", recorded, "--out", out, "--iterations", "4", "--plot", picture)
    told = msgspec.json.decode(out.with_suffix(".history.json").read_bytes())
    assert told["validations"][-1]["iteration"] == 4
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert not list(tmp_path.glob("*.checkpoint*"))
    output = vesselflow("run", box, "--until", "0.002", "--model", "pcnet", "--weights", out)
    assert "leaks 0" in output


class KilledError(Exception):
    """Stands for whatever ends a training early."""


@pytest.mark.validation
def test_a_training_that_is_cut_short_goes_on_to_the_same_weights(runs, trained, tmp_path):
    cut = tmp_path / "cut.npz"

    def kill(at: Progress) -> None:
        if at.iteration == 20:
            raise KilledError

    with pytest.raises(KilledError):
        train_weights(runs, cut, SETTINGS, report=kill)
    checkpoint = tmp_path / "cut.npz.checkpoint"
    other = Settings(iterations=40, validate_every=10, seed=1)
    with pytest.raises(InputError, match=r"cut.npz.checkpoint: holds a training with seed 0"):
        train_weights(runs, cut, other, report=quiet)
    weights, history = train_weights(runs, cut, SETTINGS, report=quiet)
    assert not checkpoint.exists()
    assert [row["iteration"] for row in history] == [10, 20, 30, 40]
    expected = Weights.load(trained)
    for (w, b), (w_0, b_0) in zip(weights.layers, expected.layers, strict=True):
        np.testing.assert_array_equal(w, w_0)
        np.testing.assert_array_equal(b, b_0)
    checkpoint.write_bytes(b"PK")
    with pytest.raises(InputError, match="not a checkpoint, or a cut one"):
        train_weights(runs, cut, SETTINGS, report=quiet)


@pytest.mark.validation
def test_a_rollout_keeps_time_where_steps_are_shorter_than_frames(runs):
    """The physics takes four steps a frame; rolled out from the first frame it is the recording."""
    figures = runs.rollout(runs.replay.physics, runs.held[0])
    assert figures["survived"] == 1.0
    # Of a way of some tenths of a spacing; behind in time by half it would be 0.75 off.
    assert figures["path_error"] < 0.1


@pytest.mark.validation
def test_ridge_finds_a_straight_line(runs, monkeypatch):
    """Targets that are linear in the features, with an offset, are met nearly exactly."""
    features, _ = runs.examples(32)
    spread = features[:, :PAPER_COUNT].std(axis=0, keepdims=True).T.clip(1e-3)
    line = np.random.default_rng(0).normal(size=(PAPER_COUNT, 3)) / spread
    target = (features[:, :PAPER_COUNT] @ line + 3.0) * runs.scales.acceleration
    monkeypatch.setattr(runs, "examples", lambda _: (features, target))
    weights = ridge(runs, Settings(head="direct"))
    found = weights.evaluate(features[:, :PAPER_COUNT]) * runs.scales.acceleration
    # The penalty is a thousandth of a feature's variance.
    assert np.abs(found - target).max() < 0.02 * np.abs(target - target.mean(axis=0)).max()


@pytest.mark.validation
def test_persistence_gives_back_the_previous_acceleration(runs):
    weights = persistence(runs, Settings(head="direct"))
    features, _ = runs.examples(1)
    np.testing.assert_allclose(
        weights.evaluate(features[:, :PAPER_COUNT]), features[:, :3], rtol=1e-4, atol=1e-9
    )
