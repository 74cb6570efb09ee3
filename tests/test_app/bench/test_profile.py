import numpy as np
import pytest

from app.bench import profile as passes
from app.jobs.process import in_own_process
from app.scenes.library import find_scene, varied, weights_for
from builders import D, ball, sphere


def test_candidates_are_the_particles_of_the_cells_around():
    stage = sphere()
    stage.put(ball(np.random.default_rng(2), 4 * D))
    stage.build()
    n, grid = stage.particles.count[None], stage.neighbors.grid
    x = stage.particles.position.to_numpy()[:n]
    cell = np.floor((x - np.array(grid.lower)) / np.array(grid.cell)).astype(int)
    apart = np.abs(cell[:, None] - cell[None])
    expected = (apart <= np.array(grid.reach)).all(axis=-1).sum()
    assert passes.candidates(stage.particles, stage.neighbors) == expected
    assert expected > n


@pytest.mark.validation
def test_passes_go_over_the_lists_and_stay_below_the_limit_of_arithmetic(tmp_path):
    scene = varied(find_scene("aortoiliac"), 0.006, 1.8e-3)
    found, limits = in_own_process(passes.measure_passes, scene, weights_for(scene), "cpu", 1)
    by_name = {each.name: each for each in found}
    assert set(passes.WORK) | {"neighbour search"} <= set(by_name)
    lists = {by_name[name].pairs for name in passes.WORK}
    assert len(lists) == 1 and 0 < lists.pop() < by_name["neighbour search"].pairs
    for each in found:
        # Counted by hand: ten times too many would show here.
        assert each.milliseconds > 0.0 and each.operations < limits.operations
    passes.draw(found, limits, tmp_path / "passes.png")
    assert (tmp_path / "passes.png").read_bytes()[:4] == b"\x89PNG"
