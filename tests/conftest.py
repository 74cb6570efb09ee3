"""One Taichi per session: `ti.init` is global, and starting it again compiles all anew."""

import functools
import os

from places import VESSELS

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")

from pathlib import Path

import pytest

from builders import vesselflow
from taichi_sph import runtime as taichi_runtime

start = taichi_runtime.start


@functools.wraps(start)
def _already_started(*_: object, **__: object) -> None:
    """Nothing: a command called in this process finds Taichi started, and all fields stay."""


taichi_runtime.start = _already_started


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--arch", default="cpu", choices=["cpu", "gpu"], help="where to compute")
    parser.addoption("--precision", default="f64", choices=["f32", "f64"], help="of numbers")
    parser.addoption("--bounds", action="store_true", help="check bounds of field accesses (slow)")


@pytest.fixture(scope="session", autouse=True)
def runtime(request: pytest.FixtureRequest) -> None:
    option = request.config.getoption
    start(option("--arch"), option("--precision"), debug=option("--bounds"), random_seed=0)


@pytest.fixture(scope="session")
def precision(request: pytest.FixtureRequest) -> str:
    return request.config.getoption("--precision")


@pytest.fixture(scope="session")
def rtol(precision: str) -> float:
    """Relative rounding error of a sum of some tens of terms."""
    return {"f64": 1e-12, "f32": 2e-5}[precision]


@pytest.fixture(scope="session")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a coarse box scene, blood that stands in it."""
    shipped = VESSELS / "box"
    folder = tmp_path_factory.mktemp("box")
    (folder / "lumen.ply").write_bytes((shipped / "lumen.ply").read_bytes())
    text = (shipped / "scene.toml").read_text()
    coarse = text.replace("spacing = 0.001 ", "spacing = 0.002 ")
    assert coarse != text
    (folder / "scene.toml").write_text(coarse)
    return folder


@pytest.fixture(scope="session")
def recorded(box: Path) -> Path:
    """A dataset of three columns in the coarse box."""
    data = box / "data.h5"
    vesselflow("record", box, "--heights", "0.012,0.020,0.016", "--frames", "60",
               "--substeps", "4", "--out", data)  # fmt: skip
    return data
