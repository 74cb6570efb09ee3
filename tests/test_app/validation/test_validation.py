"""The rows of `vesselflow validate`, each within its tolerance (minutes)."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import pytest

from app.validation.report import Row
from app.validation.validate import CASES, run_case

pytestmark = pytest.mark.validation


def _rows_of(name: str) -> list[Row]:
    case = next(case for case in CASES if case.name == name)
    return run_case(case).rows


@pytest.mark.parametrize("name", [case.name for case in CASES])
def test_every_row_is_within_its_tolerance(name):
    # A case starts Taichi with its own precision, which would end the session's fields.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        rows = pool.submit(_rows_of, name).result()
    assert rows
    missed = [f"{r.quantity}: {r.computed} for {r.theory}" for r in rows if r.verdict == "MISS"]
    assert not missed, "\n".join(missed)
