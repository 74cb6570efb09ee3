import ast
import os
import subprocess
import sys

import pytest

import nn
import taichi_sph
from places import ROOT


def test_type_checkers_see_every_public_name_where_it_is_made() -> None:
    """The names that are imported when asked for are those that type checkers read."""
    tree = ast.parse((ROOT / "taichi_sph" / "__init__.py").read_text())
    seen = {
        alias.asname: f"{node.module}.{alias.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("taichi_sph")
        for alias in node.names
    }
    assert set(seen) == set(taichi_sph.__all__)
    for name, home in seen.items():
        value = getattr(taichi_sph, str(name))
        assert f"{value.__module__}.{value.__qualname__}" == home


def test_a_name_that_is_not_public_is_not_there() -> None:
    with pytest.raises(AttributeError, match="no attribute 'sphere'"):
        _ = taichi_sph.sphere
    assert set(taichi_sph.__all__) <= set(dir(taichi_sph))


PACKAGES = ("taichi_sph", "nn", "app")


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_says_that_it_has_types(package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()


ENGINE = ROOT / "docs" / "engine.py"


def test_an_engine_needs_the_public_names_only() -> None:
    imported = {
        (str(node.module), alias.name)
        for node in ast.walk(ast.parse(ENGINE.read_text()))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    ours = {(module, name) for module, name in imported if module.split(".")[0] in PACKAGES}
    public = {("taichi_sph", name) for name in taichi_sph.__all__} | {
        ("nn", name) for name in nn.__all__
    }
    assert ours <= public and len(ours) > 3
    assert callable(nn.load_pcnet)


@pytest.mark.validation
@pytest.mark.parametrize("weights", [True, False])
def test_the_loop_of_an_engine_runs(weights: bool) -> None:
    folder = ROOT / "assets" / "vessels" / "aortoiliac"
    options = [str(folder / "pcnet.npz"), "0.05"] if weights else []
    command = [sys.executable, str(ENGINE), str(folder / "scene.toml"), *options]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    frames = done.stdout.splitlines()
    assert len(frames) == (10 if weights else 40)
    assert all(" mN" in line and " 0 particles" not in line for line in frames)
