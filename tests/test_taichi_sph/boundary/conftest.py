"""Two tubes for all tests of boundaries, each compiled once: one driven, one that bleeds."""

import pytest

from bleeding_tube import make_bleeding_tube
from builders import Setup
from driven_tube import FLOW, VISCOSITY, drive, make_tube
from taichi_sph.boundary.tool_surface import ToolSurface
from taichi_sph.simulation import Simulation
from tool_stage import globe, sample_surface, tool_stage


@pytest.fixture(scope="package")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Simulation:
    """A tube of viscous blood."""
    return make_tube(tmp_path_factory.mktemp("tube"), VISCOSITY)


@pytest.fixture
def driven(tube: Simulation) -> Simulation:
    """The tube as at its start."""
    tube.time = 0.0
    tube.reset()
    drive(tube, "top", flow=FLOW)
    drive(tube, "bottom", pressure=0.0)
    return tube


@pytest.fixture(scope="package")
def bleeding_tube(tmp_path_factory: pytest.TempPathFactory) -> Simulation:
    """A tube under pressure, with a tool."""
    return make_bleeding_tube(tmp_path_factory.mktemp("bleeding"))


@pytest.fixture
def sim(bleeding_tube: Simulation) -> Simulation:
    """The tube that bleeds, as at its start."""
    bleeding_tube.time = 0.0
    bleeding_tube.reset()
    return bleeding_tube


@pytest.fixture(scope="package")
def surface(tmp_path_factory: pytest.TempPathFactory) -> ToolSurface:
    """A ball, sampled."""
    return sample_surface(tmp_path_factory.mktemp("tool"), globe())


@pytest.fixture
def stage(surface: ToolSurface) -> Setup:
    """Blood round the ball in the round vessel, the ball in the middle and at rest."""
    return tool_stage(surface)
