import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("taichi_sph", "nn", "app")
MAY_IMPORT = {
    "taichi_sph": {"taichi_sph"},
    "nn": {"taichi_sph", "nn"},
    "app": {"taichi_sph", "nn", "app"},
}
ONLY_IN = {
    "rerun": {"app/view.py"},
    "torch": {"nn/train.py"},
    "click": {"app/cli.py"},
    "viser": {"app/page.py"},
}
FILES = sorted(f for package in PACKAGES for f in (ROOT / package).rglob("*.py"))
assert FILES, "no source files found"

all_files = pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))


def imports(tree: ast.AST) -> Iterator[str]:
    """Full names of all modules that a file imports, inside functions too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield "." * node.level + (node.module or "")


def calls(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func)


def decorators(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            yield from (ast.unparse(d) for d in node.decorator_list)


@all_files
def test_imports_point_from_the_program_to_the_physics(file: Path) -> None:
    package = file.relative_to(ROOT).parts[0]
    names = list(imports(ast.parse(file.read_text())))
    assert not [n for n in names if n.startswith(".")], "imports are absolute"
    ours = {n.split(".")[0] for n in names} & set(PACKAGES)
    assert ours <= MAY_IMPORT[package]


@all_files
def test_heavy_libraries_are_imported_in_their_own_files_only(file: Path) -> None:
    name = str(file.relative_to(ROOT))
    imported = {n.split(".")[0] for n in imports(ast.parse(file.read_text()))}
    assert not [library for library, homes in ONLY_IN.items()
                if library in imported and name not in homes]  # fmt: skip


@all_files
def test_taichi_is_started_in_one_file(file: Path) -> None:
    starts = any(name in ("ti.init", "taichi.init") for name in calls(ast.parse(file.read_text())))
    assert starts == (file == ROOT / "taichi_sph" / "runtime.py")


@all_files
def test_a_file_with_kernels_keeps_its_annotations(file: Path) -> None:
    # Taichi reads the types of a kernel's arguments from its annotations.
    tree = ast.parse(file.read_text())
    has_kernels = bool({"ti.kernel", "ti.func"} & set(decorators(tree)))
    assert not (has_kernels and "__future__" in imports(tree))


@all_files
def test_only_the_program_prints(file: Path) -> None:
    prints = "print" in calls(ast.parse(file.read_text()))
    assert not prints or file.relative_to(ROOT).parts[0] == "app"


def test_the_rules_above_would_notice() -> None:
    tree = ast.parse(
        "import rerun as rr\n"
        "def f():\n    from app import view\n    ti.init(arch=ti.cpu)\n"
        "@ti.kernel\ndef k(x: ti.template()): pass\n"
    )
    assert set(imports(tree)) == {"rerun", "app"}
    assert "ti.init" in calls(tree)
    assert list(decorators(tree)) == ["ti.kernel"]
