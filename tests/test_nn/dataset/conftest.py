"""Where a dataset of the tests lies, and whether it has features."""

from pathlib import Path

import pytest

from dataset_runs import FEATURES


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "data.h5"


@pytest.fixture(params=[0, FEATURES], ids=["plain", "with features"])
def width(request: pytest.FixtureRequest) -> int:
    return request.param
