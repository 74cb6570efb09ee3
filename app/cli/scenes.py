"""`scenes`, `info` and `new`."""

import os
from pathlib import Path

import click

from app.cli import options
from app.cli.options import output_path


@click.command()
def scenes() -> None:
    """List the shipped scenes."""
    from app.files import console
    from app.scenes.library import scenes_table

    console().print(scenes_table())


@click.command()
@options.scene
def info(scene: str) -> None:
    """Check a scene's vessel and print the numbers that follow from the scene."""
    from app.files import console
    from app.scenes.library import find_scene, info_tables

    out = console()
    for table in info_tables(find_scene(scene)):
        out.print(table)


@click.command()
@click.argument("surface", type=click.Path(path_type=Path))
@click.option(
    "--out", type=output_path, metavar="FOLDER", help="Folder to make.  [default: the file's name]"
)
@click.option(
    "--scale",
    type=float,
    metavar="METRES",
    help="Metres per unit of the file.  [default: guessed from the size]",
)
@click.option(
    "--spacing",
    type=float,
    metavar="METRES",
    help="Distance between blood particles [m].  [default: fits the narrowest place]",
)
@click.option(
    "--smooth", is_flag=True, help="Smooth the surface: needed of one straight from voxels."
)
def new(
    surface: Path, out: Path | None, scale: float | None, spacing: float | None, smooth: bool
) -> None:
    """Make a scene folder of a vessel's surface (STL, PLY, OBJ, VTP, VTK), capped or open."""
    from app.scenes.library import shipped
    from app.scenes.new_scene import create_scene

    click.echo(create_scene(surface, out, scale, spacing, smooth))
    folder = Path(surface.stem) if out is None else out
    if folder.name in shipped() and folder.parent.resolve() == Path.cwd():
        click.echo(
            f"{folder.name}: a shipped scene has this name too; write .{os.sep}{folder.name} "
            "for this one"
        )
