import json

import msgspec
import pytest

from app.bench import columns
from app.bench.benchmark import BenchOptions, run_bench
from app.bench.control_cost import FRAMES, measure_overhead
from app.jobs.process import in_own_process
from app.scenes.library import scene_path, weights_for
from browser import needs_viser
from taichi_sph.errors import InputError
from taichi_sph.scene import read_scene


def test_a_row_holds_the_quartiles_and_the_cost_of_a_particle():
    row = columns.row_of("case", 1000, 10, [4e-3, 1e-3, 2e-3, 3e-3, 5e-3], 1e-5)
    assert (row.step_ms_low, row.step_ms, row.step_ms_high) == pytest.approx((2.0, 3.0, 4.0))
    assert row.microseconds_per_particle_step == pytest.approx(3.0)
    assert row.real_time_factor == pytest.approx(1e-5 / 3e-3)


@pytest.mark.validation
def test_a_column_is_measured_in_a_process_of_its_own_and_has_the_size_asked_for():
    row = in_own_process(columns.measure_column, 6, 8, "cpu", 1)
    assert row.blood_particles == 6 * 6 * 8
    assert row.proxy_particles == pytest.approx(4 * 6 * 18 + 36, rel=0.02)  # five walls, s = d
    assert row.step_ms > 0.0
    assert row.memory_mib > 50.0


@needs_viser
@pytest.mark.validation
def test_what_control_costs_is_measured_with_a_hand_and_an_eye_on_the_run(tmp_path):
    scene = msgspec.structs.replace(read_scene(scene_path("tube")), frame_interval=1e-3)
    found = in_own_process(measure_overhead, scene, weights_for(scene), "cpu", 1, tmp_path, 2)
    assert found.blood_particles == 3920
    assert found.latency_ms > 0.0
    assert found.pictures > 0.0
    log = [json.loads(line) for line in (tmp_path / "session.jsonl").read_text().splitlines()]
    moved = [row["do"]["command"] for row in log if "do" in row]
    assert set(moved) == {"tool"}
    assert sum("frame" in row for row in log) == 3 * FRAMES  # those acted on, the first compiles


def test_a_peer_that_is_not_installed_is_one_sentence(monkeypatch):
    monkeypatch.setattr("app.studies.splishsplash.has_peer", lambda: False)
    with pytest.raises(InputError, match=r"^--peer: pysplishsplash is not installed"):
        run_bench(BenchOptions((), peer=True))


@pytest.mark.validation
def test_too_short_a_time_is_one_sentence(capsys):
    with pytest.raises(InputError, match=r"^--until 1e-05: the first 10 steps of PcNet compile"):
        run_bench(BenchOptions(((scene_path("tube"), None),), until=1e-5))
    assert "measuring tube, physics and PcNet" in capsys.readouterr().err


def test_figures_go_to_json(tmp_path):
    out = tmp_path / "bench.json"
    run_bench(BenchOptions((), json_file=out))
    result = json.loads(out.read_text())
    assert result["rows"] == []
    assert result["machine"]["precision"] == "f32"
    assert set(result) == {
        "machine", "table", "rows", "starts", "passes", "limits", "real_time", "control",
    }  # fmt: skip
