"""One Taichi per session: `ti.init` is global, and starting it again compiles all anew."""

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")

import pytest

from taichi_sph.runtime import start


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
