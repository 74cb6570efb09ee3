"""`vesselflow ladder`: its figures from rows that are known, and one rung from data to figures."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="torch is an extra: pip install 'vesselflow[train]'")

from app.jobs.process import in_own_process
from app.training.compare_networks import (
    GROUPS,
    VARIANTS,
    Job,
    Row,
    main,
    measure,
    read_figures,
    summarise,
)
from nn.features import NAMES
from taichi_sph.errors import InputError


def row(variant: str, seed: int, survived: float, path_error: float) -> Row:
    """A measured row."""
    return Row(variant, "d.h5", 8, 10.0, seed, 60.0, survived, path_error, 0.01, 0.05)


def test_a_line_has_medians_and_counts_the_dead():
    last, first = VARIANTS[-1].name, VARIANTS[0].name
    rows = [row(last, 0, 1.0, 0.1), row(last, 1, 0.25, 0.3), row(last, 2, 1.0, 0.2)]
    lines = summarise([*rows, row(first, 0, 0.5, 0.9)])
    assert [line.rung for line in lines] == [first, last]
    dead, mixed = lines
    assert (dead.alive, dead.seeds, dead.survived) == (0, 1, 0.5)
    assert (mixed.alive, mixed.seeds) == (2, 3)
    assert mixed.path_error == 0.2
    assert mixed.survived == 1.0


@pytest.mark.validation
def test_one_variant_is_measured_and_what_is_measured_is_not_repeated(
    recorded: Path, tmp_path: Path
):
    data, out, picture = recorded, tmp_path / "ladder.json", tmp_path / "ladder.png"
    (found,) = in_own_process(measure, Job(data, data.name, "pressure, no input", 0, 6, "cpu"))
    assert found.survived == 1.0
    assert 0.0 < found.compression_p99 < 0.3
    rows = [
        asdict(replace(found, rung=variant.name, seed=seed))
        for variant in VARIANTS
        for seed in range(1 if variant.fit else 2)
    ]
    out.write_text(json.dumps({"iterations": 6, "rows": rows}))
    before = out.read_bytes()
    main([data], out, 2, 6, False, 1, picture, "cpu")  # nothing is left to measure
    assert out.read_bytes() == before
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_figures_of_something_else_are_refused(tmp_path: Path):
    out = tmp_path / "ladder.json"
    out.write_text('{"iterations": 6, "rows": []}')
    assert read_figures(out, 6) == []
    with pytest.raises(InputError, match="holds trainings of 6 iterations, asked for are 7"):
        read_figures(out, 7)
    for text in ("{", '{"rows": []}', '{"iterations": 6, "rows": [{"rung": 1}]}', "[]"):
        out.write_text(text)
        with pytest.raises(InputError, match="not the figures of a ladder"):
            read_figures(out, 6)


def test_every_feature_is_left_out_once():
    assert sorted(name for group in GROUPS.values() for name in group) == sorted(NAMES)
