"""The structure of the packages, held from their syntax trees: nothing is imported here."""

import ast
from collections.abc import Callable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from places import ROOT

ROOMS = (
    "taichi_sph.errors",
    "taichi_sph.system",
    "taichi_sph.runtime",
    "taichi_sph.scene",
    "taichi_sph.waveform",
    "taichi_sph.scene_files",
    "taichi_sph.geometry",
    "taichi_sph.particles",
    "taichi_sph.fluid",
    "taichi_sph.boundary",
    "taichi_sph.integrator",
    "taichi_sph.settling",
    "taichi_sph.derived",
    "taichi_sph.diagnostics",
    "taichi_sph.state",
    "taichi_sph.assemble",
    "taichi_sph.simulation",
    "taichi_sph.models",
    "taichi_sph",
    "nn.features",
    "nn.weights",
    "nn.pcnet",
    "nn.dataset",
    "nn.training",
    "nn",
    "app",
    "app.files",
    "app.locks",
    "app.progress",
    "app.jobs",
    "app.scenes",
    "app.models",
    "app.view",
    "app.run",  # its table of outputs makes the view
    "app.control",  # replays by the same loop and outputs
    "app.training",
    "app.studies",
    "app.validation",
    "app.bench",
    "app.run_scene",  # wires all that a run may have: model, view, session, advice
    "app.cli",
    "app.__main__",
)
"""Files and folders in order: one imports itself and what stands before it."""

WITHOUT_TAICHI = ("taichi_sph.errors", "taichi_sph.system", "taichi_sph.scene",
                  "taichi_sph.waveform", "taichi_sph.scene_files",
                  "taichi_sph.geometry")  # fmt: skip

ONLY_IN = {
    "rerun": ("app.view.rerun_view", "app.view.rerun_streams"),
    "torch": ("nn.training.torch_network", "nn.training.train"),
    "click": ("app.cli",),
    "viser": ("app.control.page",),
}


def module_of(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {
    module_of(file): ast.parse(file.read_text(encoding="utf-8"))
    for package in ("taichi_sph", "nn", "app")
    for file in sorted((ROOT / package).rglob("*.py"))
}
assert SOURCES, "no source files found"


def imports(tree: ast.AST) -> Iterator[str]:
    """Full names of all that a file imports, inside functions too; relative ones with dots."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            names = (f"{module}.{alias.name}" for alias in node.names)
            yield from (name if name in SOURCES else module for name in names)


def calls(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func)


def decorators(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            yield from (ast.unparse(d) for d in node.decorator_list)


def room_of(module: str) -> str:
    """The entry of ROOMS that a module belongs to: the longest that its name begins with."""
    fitting = [room for room in ROOMS if module == room or module.startswith(f"{room}.")]
    return max(fitting, key=len)


def breaks_the_order(importer: str, imported: str) -> bool:
    here, there = room_of(importer), room_of(imported)
    # The public names of a package are those of its rooms: nobody inside may ask for them.
    return here != there and ROOMS.index(here) < ROOMS.index(there)


def offenders(wrong: Callable[[str, ast.AST], bool]) -> list[str]:
    return [module for module, tree in SOURCES.items() if wrong(module, tree)]


def test_every_file_has_its_place() -> None:
    unplaced = {"taichi_sph", "nn", "app"}
    assert not [m for m in SOURCES if room_of(m) in unplaced and m not in unplaced]


def test_imports_are_absolute() -> None:
    assert not offenders(lambda _, tree: any(n.startswith(".") for n in imports(tree)))


def test_imports_point_one_way() -> None:
    wrong = [
        f"{module} -> {name}"
        for module, tree in SOURCES.items()
        for name in imports(tree)
        if name in SOURCES and breaks_the_order(module, name)
    ]
    assert not wrong


def test_no_file_imports_itself_by_a_detour() -> None:
    graph = {m: {n for n in imports(tree) if n in SOURCES and n != m} for m, tree in
             SOURCES.items()}  # fmt: skip
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"a circle: {' -> '.join(error.args[1])}")


def test_each_folder_says_what_it_is_for_in_one_sentence() -> None:
    for module, tree in SOURCES.items():
        if (ROOT / Path(*module.split("."))).is_dir():
            sentence = ast.get_docstring(tree) or ""
            assert sentence.split("\n")[0].endswith("."), module


def test_what_a_scene_and_its_surface_need_is_no_taichi() -> None:
    def wrong(module: str, tree: ast.AST) -> bool:
        return room_of(module) in WITHOUT_TAICHI and "taichi" in {
            n.split(".")[0] for n in imports(tree)
        }

    assert not offenders(wrong)


@pytest.mark.parametrize("library", ONLY_IN)
def test_a_heavy_library_is_imported_in_its_own_file(library: str) -> None:
    def wrong(module: str, tree: ast.AST) -> bool:
        allowed = {module, module.rpartition(".")[0]} & set(ONLY_IN[library])
        return not allowed and library in {n.split(".")[0] for n in imports(tree)}

    assert not offenders(wrong)


def test_taichi_is_started_in_one_file() -> None:
    starts = offenders(lambda _, tree: bool({"ti.init", "taichi.init"} & set(calls(tree))))
    assert starts == ["taichi_sph.runtime"]


def test_a_file_with_kernels_keeps_its_annotations() -> None:
    # Taichi reads the types of a kernel's arguments from its annotations.
    def wrong(_: str, tree: ast.AST) -> bool:
        has_kernels = bool({"ti.kernel", "ti.func"} & set(decorators(tree)))
        return has_kernels and "__future__" in imports(tree)

    assert not offenders(wrong)


def test_only_the_program_prints() -> None:
    assert not offenders(
        lambda module, tree: "print" in set(calls(tree)) and not module.startswith("app")
    )


def test_the_rules_above_would_notice() -> None:
    tree = ast.parse(
        "import rerun as rr\n"
        "from ..app import files\n"
        "def f():\n    from app.view import rerun_view\n    ti.init(arch=ti.cpu)\n"
        "@ti.kernel\ndef k(x: ti.template()): pass\n"
    )
    assert set(imports(tree)) == {"rerun", "..app", "app.view.rerun_view"}
    assert "ti.init" in set(calls(tree))
    assert list(decorators(tree)) == ["ti.kernel"]
    assert breaks_the_order("taichi_sph.geometry.mesh", "taichi_sph.fluid.wcsph")
    assert breaks_the_order("app.studies.chart", "app.cli")
    assert not breaks_the_order("app.cli", "app.studies.chart")
    assert room_of("app.control.page") == "app.control" and room_of("app") == "app"
