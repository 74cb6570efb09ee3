"""`vesselflow ladder`: its figures from rows that are known, and one rung from data to figures."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="torch is an extra: pip install 'vesselflow[train]'")

from app.training.compare_networks import GROUPS, RUNGS, main, summarise
from nn.features import NAMES
from taichi_sph.errors import InputError


def row(rung: str, seed: int, survived: float, path_error: float) -> dict[str, object]:
    """A measured row."""
    return {
        "rung": rung,
        "data": "d.h5",
        "substeps": 8,
        "sound_speed": 10.0,
        "seed": seed,
        "training_seconds": 60.0,
        "survived": survived,
        "path_error": path_error,
        "drained_error": 0.01,
        "compression_p99": 0.05,
    }


def test_a_line_has_medians_and_counts_the_dead():
    last, first = RUNGS[-1].name, RUNGS[0].name
    rows = [row(last, 0, 1.0, 0.1), row(last, 1, 0.25, 0.3), row(last, 2, 1.0, 0.2)]
    lines = summarise([*rows, row(first, 0, 0.5, 0.9)])
    assert [line.rung for line in lines] == [first, last]
    dead, mixed = lines
    assert (dead.alive, dead.seeds, dead.survived) == (0, 1, 0.5)
    assert (mixed.alive, mixed.seeds) == (2, 3)
    assert mixed.path_error == 0.2
    assert mixed.survived == 1.0


def test_one_rung_is_measured_and_what_is_measured_is_not_repeated(box: Path, tmp_path: Path):
    data, out, picture = box / "data.h5", tmp_path / "ladder.json", tmp_path / "ladder.png"
    code = (
        "from pathlib import Path; import json;"
        "from app.training.compare_networks import Task, measure, RUNGS;"
        "rung = next(rung for rung in RUNGS if rung.name == 'pressure, no input');"
        f"print(json.dumps(measure(Task(Path({str(data)!r}), rung, 0, 6, 'cpu'))))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    )
    found = json.loads(result.stdout.splitlines()[-1])
    assert found["survived"] == 1.0
    assert 0.0 < found["compression_p99"] < 0.3
    rows = [
        found | {"rung": rung.name, "seed": seed}
        for rung in RUNGS
        for seed in range(1 if rung.fit else 2)
    ]
    out.write_text(json.dumps({"iterations": 6, "rows": rows}))
    before = out.read_bytes()
    main([data], out, 2, 6, False, 1, picture, "cpu")  # nothing is left to measure
    assert out.read_bytes() == before
    assert picture.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InputError, match="holds trainings of 6 iterations, asked for are 7"):
        main([data], out, 2, 7, False, 1, None, "cpu")
    for text in ("{", '{"rows": []}'):
        out.write_text(text)
        with pytest.raises(InputError, match="not the figures of a ladder"):
            main([data], out, 2, 6, False, 1, None, "cpu")
        assert out.read_text() == text


def test_every_feature_is_left_out_once():
    assert sorted(name for group in GROUPS.values() for name in group) == sorted(NAMES)
