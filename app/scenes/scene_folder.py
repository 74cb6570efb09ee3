"""The folder of a scene: lumen.ply, scene.toml and README.md, whole or not at all."""

import json
import os
import shutil
import tempfile
from pathlib import Path

from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.mesh import Floats, Integers
from taichi_sph.geometry.vessel import read_vessel
from taichi_sph.scene import OpeningTable, parse_scene


def _numbers(values: Floats | tuple[float, ...], digits: int) -> str:
    return "[" + ", ".join(f"{value:.{digits}f}" for value in values) + "]"


def scene_text(
    title: str, tables: dict[str, OpeningTable], gravity: Floats, spacing: float, height: float
) -> str:
    """The scene file, SI units."""
    lines = [
        "# SI units.  Made by `vesselflow new`; README.md says what it assumed.",
        f"title = {json.dumps(title, ensure_ascii=False)}",
        "duration = 0.5          # [s]",
        "frame_interval = 0.005  # [s]",
        f"gravity = {_numbers(gravity, 4)}  # [m/s^2]",
        "",
        "[vessel]",
        'surface = "lumen.ply"',
        "scale = 1.0             # metres per unit of the file",
    ]
    for name, table in tables.items():
        lines += ["", f"[openings.{name}]", f"centre = {_numbers(table.centre, 7)}"]
        other = "capped" if table.state == "open" else "open"
        lines += [f'state = "{table.state}"           # or "{other}"']
    lines += ["", "[column]", 'opening = "opening_1"', f"height = {height:.6g}  # [m]"]
    lines += ["", "[blood]", "density = 1060.0        # [kg/m^3]"]
    lines += ['rheology = { model = "casson" }']
    lines += ["", "[discretization]", f"spacing = {spacing:.6g}  # [m]"]
    return "\n".join(lines) + "\n"


def readme_text(title: str, source: str, notes: list[str]) -> str:
    """What was found and assumed, for the folder's README.md."""
    lines = [f"# {title}", "", f"Made by `vesselflow new` from `{source}`.  The surface is that"]
    lines += ["file's, in metres; its source and licence are for you to note here.", ""]
    return "\n".join([*lines, "Found and assumed:", "", *(f"- {note}" for note in notes)]) + "\n"


def publish(folder: Path, vertices: Floats, faces: Integers, text: str, readme: str) -> None:
    """Write the files beside their place, read them back, then move the folder there at once.

    Raises:
        InputError: the folder cannot be made.
    """
    temporary = None
    try:
        parent = folder.absolute().parent
        temporary = Path(tempfile.mkdtemp(prefix=".vesselflow-", dir=parent))
        mesh.write_ply(temporary / "lumen.ply", vertices, faces, "lumen, metres")
        (temporary / "scene.toml").write_text(text, encoding="utf-8")
        (temporary / "README.md").write_text(readme, encoding="utf-8")
        read_vessel(parse_scene(text, str(folder / "scene.toml"), temporary, folder.name))
        temporary.chmod(0o755)
        os.rename(temporary, folder)
        temporary = None
    except OSError as error:
        raise InputError(
            f"{folder}: cannot make the scene folder: {error.strerror or error}"
        ) from None
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
