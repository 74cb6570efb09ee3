import ast

import pytest

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


@pytest.mark.parametrize("package", ["taichi_sph", "nn", "app"])
def test_a_package_says_that_it_has_types(package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()
