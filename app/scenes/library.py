"""Scenes: the shipped ones, the user's own, and what one amounts to."""

import difflib
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from rich.table import Table
from rich.text import Text

from app.scenes.driving import driving
from taichi_sph.errors import InputError
from taichi_sph.scene import Scene, read_scene

if TYPE_CHECKING:
    from taichi_sph.assemble import InitialState
    from taichi_sph.derived import Derived
    from taichi_sph.geometry.findings import Finding
    from taichi_sph.geometry.vessel import Vessel


WEIGHTS = "pcnet.npz"
"""File of the network's weights in the folder of a scene."""


def vessels_folder() -> Path:
    """Folder of the shipped vessels: inside the installed package, else in the source tree.

    Raises:
        InputError: the installation has none.
    """
    here = Path(__file__).resolve().parent
    for folder in (here / "vessels", here.parents[1] / "assets" / "vessels"):
        if folder.is_dir():
            return folder
    raise InputError(f"{here}: this installation has no vessels; install vesselflow again")


def shipped() -> dict[str, Path]:
    """Scene files that come with the program, by name, in alphabetical order."""
    files = sorted(vessels_folder().glob("*/*.toml"))
    return dict(sorted((f.parent.name if f.stem == "scene" else f.stem, f) for f in files))


def scene_path(given: str) -> Path:
    """The file of a scene given by the name of a shipped one, by its file or by its folder.

    Raises:
        InputError: there is no such scene, or two.
    """
    known = shipped()
    if given in known:
        if holds_another_scene(Path(given), known[given]):
            raise InputError(
                f"{given}: a shipped scene and a folder here; write .{os.sep}{given} for the "
                f"folder, {known[given]} for the shipped one"
            )
        return known[given]
    path = Path(given)
    if path.is_dir():
        path = path / "scene.toml"
        if not path.is_file():
            raise InputError(f"{given}: the folder has no scene.toml")
    elif not path.exists():
        plain = {name.casefold(): name for name in known}
        close = difflib.get_close_matches(given.casefold(), plain, n=1)
        hint = f"did you mean {plain[close[0]]}?" if close else f"shipped are {', '.join(known)}"
        raise InputError(f"{given}: neither a shipped scene nor a scene file or folder; {hint}")
    elif path.suffix != ".toml":
        raise InputError(
            f"{given}: a scene is a .toml file; `vesselflow new {given}` makes one of a surface"
        )
    return path


def holds_another_scene(folder: Path, shipped_file: Path) -> bool:
    """Whether a folder has scenes, and is not that of a shipped one."""
    # A file system that does not tell large letters from small finds the folder under either.
    is_own = folder.is_dir() and folder.resolve() == shipped_file.parent.resolve()
    return not is_own and any(folder.glob("*.toml"))


def find_scene(given: str) -> Scene:
    """Read a scene, given as for `scene_path`.

    Raises:
        InputError: there is no such scene, or its file has a mistake.
    """
    return read_scene(scene_path(given))


def with_column(scene: Scene, particles: int | None, height: float | None) -> Scene:
    """The scene with another column, where one is asked for.

    Raises:
        InputError: both are asked for.
    """
    if particles is None and height is None:
        return scene
    if particles is not None and height is not None:
        raise InputError("--particles and --height: give one of the two")
    column = msgspec.structs.replace(scene.column, particles=particles, height=height, full=False)
    return msgspec.structs.replace(scene, column=column)


def varied(scene: Scene, height: float | None, spacing: float | None) -> Scene:
    """The scene with another column [m] or spacing [m], where one is asked for, named by it."""
    name = scene.name
    if spacing is not None:
        grid = msgspec.structs.replace(scene.discretization, spacing=spacing)
        scene = msgspec.structs.replace(scene, discretization=grid)
        name += f"-d{1e3 * spacing:g}mm"
    if height is not None:
        name += f"-{1e3 * height:g}mm"
    return msgspec.structs.replace(with_column(scene, None, height), name=name)


def weights_for(scene: Scene) -> Path:
    """Weights to pour a scene with: those beside it, or the aorta's, which serve any vessel."""
    own = Path(scene.folder) / WEIGHTS
    return own if own.is_file() else shipped()["aortoiliac"].parent / WEIGHTS


def scenes_table() -> Table:
    """The shipped scenes, one a row."""
    table = Table(box=None, pad_edge=False)
    table.add_column("scene", no_wrap=True)
    table.add_column("spacing", justify="right", no_wrap=True)
    table.add_column("duration", justify="right", no_wrap=True)
    table.add_column("title")
    for name, path in shipped().items():
        scene = read_scene(path)
        spacing = f"{1e3 * scene.discretization.spacing:.3g} mm"
        table.add_row(name, spacing, f"{scene.duration:g} s", scene.title)
    return table


def measure(scene: Scene) -> tuple["Vessel", "list[Finding]", "InitialState", "Derived"]:
    """Read, check, sample and fill the vessel of a scene; the work behind `vesselflow info`.

    Raises:
        InputError: the surface cannot be used, or the column does not fit.
    """
    from taichi_sph.assemble import initial_state
    from taichi_sph.derived import derive
    from taichi_sph.geometry.findings import (
        Finding,
        check_gaps,
        check_gravity,
        check_outlets,
        check_vessel,
    )
    from taichi_sph.geometry.vessel import read_vessel

    vessel = read_vessel(scene)
    spacing, column = scene.discretization.spacing, scene.column
    start = initial_state(scene, vessel)
    findings = check_vessel(vessel) + check_outlets(vessel)
    findings += check_gaps(start.wall, spacing, start.setback)
    if not column.full and not scene.openings[column.opening].driven:
        findings += check_gravity(vessel, column.opening, scene.gravity)
    if start.left_out:
        text = f"{start.left_out} sites of the lattice hold no blood: too near to a wall's proxy"
        findings.append(Finding(True, text))
    derived = derive(scene, vessel, len(start.blood), len(start.proxies))
    return vessel, findings, start, derived


_OK, _NOTE = Text("ok", style="green"), Text("note", style="yellow")


def _two_columns(title: str) -> Table:
    table = Table(
        title=title, title_justify="left", box=None, pad_edge=False, show_header=False, min_width=60
    )
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    return table


def _sound_speed(scene: Scene, derived: "Derived") -> str:
    if derived.quiet_speed is None:
        return f"{derived.sound_speed:.3g} m/s"
    ratio = scene.discretization.sound_speed_ratio
    return (
        f"{ratio * derived.quiet_speed:.3g} m/s, or {ratio:g} times the largest "
        f"speed; {derived.sound_speed:.3g} m/s while a wound is open"
    )


def delivered_viscosity(scene: Scene) -> str | None:
    """How much more viscous a shipped scene's blood is than it asks for, by each model.

    From the rows of `vesselflow validate viscosity --json`, kept beside the scenes; None of a
    scene that is not there, or is not as it was shipped.
    """
    file = vessels_folder() / "viscosity.json"
    known = shipped()
    if scene.name not in known or scene.text != known[scene.name].read_text(encoding="utf-8"):
        return None
    found = []
    for row in json.loads(file.read_text(encoding="utf-8"))["rows"]:
        case, _, _ = row["quantity"].partition(":")
        name, _, model = case.partition(", ")
        if name == scene.name:
            felt, asked = (float(row[key].split()[0]) for key in ("computed", "theory"))
            found.append(f"{felt / asked:.3g} ({model})")
    return ", ".join(found) or None


def info_tables(scene: Scene) -> list[Table]:
    """What a scene amounts to: the vessel's check, then the numbers that follow from it.

    Raises:
        InputError: as `measure`.
    """
    vessel, findings, start, derived = measure(scene)
    wall = start.wall
    checks = _two_columns(f"{scene.name}: {scene.title}\nsurface {vessel.label}")
    for finding in findings:
        checks.add_row(_OK if finding.good else _NOTE, finding.text)

    grid, viscous = scene.discretization, delivered_viscosity(scene)
    numbers = _two_columns("\nderived numbers")
    for name, value in (
        ("blood particles", f"{derived.blood_particles}"),
        ("proxy particles", f"{derived.proxy_particles}"),
        ("spacing", f"{1e3 * grid.spacing:.4g} mm"),
        ("support radius", f"{1e3 * derived.support_radius:.4g} mm"),
        ("across narrowest opening", f"{derived.particles_across_narrowest:.1f} particles"),
        ("expected speed", f"{derived.expected_speed:.3g} m/s"),
        ("sound speed", _sound_speed(scene, derived)),
        ("time step", f"{1e3 * derived.step:.3g} ms"),
        ("steps, about", f"{scene.duration / derived.step:.0f} for {scene.duration:g} s"),
        ("Reynolds number", f"{derived.reynolds_number:.3g}"),
        *([] if viscous is None else [("viscosity, over what is asked for", viscous)]),
        (
            "proxy spacing reached",
            f"{wall.nearest_mean:.3f} of {1e3 * grid.wall_spacing_ratio * grid.spacing:.4g} mm, "
            f"spread {wall.nearest_spread:.3f}, least {wall.nearest_least:.3f}",
        ),
    ):
        numbers.add_row(name, value)
    drives = driving(scene, vessel)
    if not drives:
        return [checks, numbers]
    driven = _two_columns("\nwhat drives the blood")
    for drive in drives:
        driven.add_row(drive.name, drive.text)
        for question in drive.questions:
            driven.add_row(_NOTE, question)
    return [checks, driven, numbers]
