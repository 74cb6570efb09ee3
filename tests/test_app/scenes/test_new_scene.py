"""A user's own surface made into a scene folder."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from app.scenes.new_scene import create_scene
from meshes import LENGTH, RADIUS, cylinder
from places import SHARED
from taichi_sph.assemble import initial_state
from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.surface_file import load_surface
from taichi_sph.geometry.vessel import Vessel, read_vessel
from taichi_sph.scene import Scene, read_scene

REAL = SHARED / "vessels"
AWAY = np.array([120.0, -40.0, 300.0])


def write_stl(path: Path, capped: bool = True, scale: float = 1e3, turn: bool = False) -> Path:
    """The test tube, far from the origin, in millimetres."""
    vertices, faces = cylinder(capped)
    tube = trimesh.Trimesh(
        vertices * scale + AWAY * scale * 1e-3, faces[:, ::-1] if turn else faces, process=False
    )
    path.write_bytes(tube.export(file_type="stl"))
    return path


def read_back(folder: Path) -> tuple[Scene, Vessel, np.ndarray]:
    scene = read_scene(folder / "scene.toml")
    vessel = read_vessel(scene)
    return scene, vessel, initial_state(scene, vessel).blood


@pytest.mark.parametrize("capped", [True, False])
@pytest.mark.parametrize(("scale", "unit"), [(1e3, "millimetres"), (1.0, "metres")])
def test_a_tube_becomes_a_scene(tmp_path: Path, capped: bool, scale: float, unit: str) -> None:
    text = create_scene(write_stl(tmp_path / "my.stl", capped, scale), tmp_path / "out")
    assert f"assumed {unit}" in text
    assert ("2 open ends" in text) is not capped
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "README.md",
        "lumen.ply",
        "scene.toml",
    ]
    readme = (tmp_path / "out" / "README.md").read_text()
    assert all(line.strip() in readme for line in text.splitlines()[1:])
    vertices, faces = load_surface(tmp_path / "out" / "lumen.ply")
    assert mesh.is_closed(faces)
    assert np.abs(vertices.min(axis=0) + vertices.max(axis=0)).max() < 1e-7
    assert np.ptp(vertices[:, 2]) == pytest.approx(LENGTH, rel=1e-4)
    scene, vessel, blood = read_back(tmp_path / "out")
    assert [o.name for o in vessel.openings] == ["opening_1", "opening_2"]
    assert all(o.is_open for o in vessel.openings)
    assert vessel.volume == pytest.approx(np.pi * RADIUS**2 * LENGTH, rel=5e-3)
    assert vessel.narrowest / scene.discretization.spacing > 5.9
    assert 2000 < len(blood) < 7000
    assert vessel.signed_distance(blood).max() < 0
    top = vessel.openings[0]
    assert np.array(scene.gravity) @ top.normal == pytest.approx(-9.81, rel=1e-3)
    assert f"{len(blood)} blood particles" in text


def test_inside_out_is_turned_round_and_said(tmp_path: Path) -> None:
    text = create_scene(write_stl(tmp_path / "my.stl", turn=True), tmp_path / "out")
    assert "pointed inwards; turned round" in text
    assert read_back(tmp_path / "out")[1].volume > 0


def test_triangles_that_turn_different_ways_are_made_to_agree(tmp_path: Path) -> None:
    vertices, faces = cylinder(capped=False)
    faces[::3] = faces[::3, ::-1]
    path = tmp_path / "my.ply"
    mesh.write_ply(path, vertices, faces)
    assert "made to agree" in create_scene(path, tmp_path / "out")
    assert read_back(tmp_path / "out")[1].volume > 0


def test_crumbs_are_left_out_and_a_second_vessel_is_refused(tmp_path: Path) -> None:
    vertices, faces = cylinder()
    crumb = trimesh.creation.icosphere(subdivisions=1, radius=1e-4)
    path = tmp_path / "my.ply"
    mesh.write_ply(
        path,
        np.concatenate([vertices, crumb.vertices + [0.02, 0, 0]]),
        np.concatenate([faces, crumb.faces + len(vertices)]),
    )
    assert "1 small loose piece," in create_scene(path, tmp_path / "out")
    mesh.write_ply(
        path,
        np.concatenate([vertices, vertices + np.array([0.02, 0, 0])]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    with pytest.raises(InputError, match="2 separate pieces"):
        create_scene(path, tmp_path / "two")
    assert not (tmp_path / "two").exists()


@pytest.mark.parametrize(
    ("unit", "length"), [("centimetres", 1.8), ("inches", 1.5), ("centimetres", 1.1)]
)
def test_a_size_that_no_vessel_has_is_asked_about(tmp_path: Path, unit: str, length: float) -> None:
    path = write_stl(tmp_path / "my.stl", scale=length / LENGTH)
    with pytest.raises(InputError) as error:
        create_scene(path, tmp_path / "out")
    text = str(error.value)
    assert "which in metres is no vessel" in text
    assert "give --scale" in text and f"for {unit} (" in text
    assert f"({10 * length:.3g} mm across, opening of radius {10 * length / 6:.3g} mm" in text
    assert not (tmp_path / "out").exists()
    scale = {"centimetres": 0.01, "inches": 0.0254}[unit]
    create_scene(path, tmp_path / "out", scale=scale)
    assert read_back(tmp_path / "out")[1].volume == pytest.approx(
        np.pi * (length * scale) ** 3 / 36, rel=5e-3
    )


def test_centimetres_are_offered_where_they_would_do(tmp_path: Path) -> None:
    vertices, faces = cylinder()
    # An aorta of 34.5 cm, 2.3 cm wide, in centimetres.
    path = tmp_path / "aorta.ply"
    mesh.write_ply(path, vertices / LENGTH * 34.5 * [0.1, 0.1, 1.0] * [2.0, 2.0, 1.0], faces)
    text = create_scene(path, tmp_path / "out")
    assert "assumed millimetres, for the surface is 34.5 units across" in text
    assert "--scale 0.01 if these are centimetres (345 mm across, opening of radius 11.5 mm" in text
    # A tube of 30 mm, 1 cm wide: in centimetres its opening has a radius of 5 cm, 2.4 litres.
    assert "are centimetres" not in create_scene(write_stl(tmp_path / "my.stl"), tmp_path / "other")


def test_a_speck_far_away_does_not_decide_the_units(tmp_path: Path) -> None:
    vertices, faces = cylinder()
    speck = trimesh.creation.icosphere(subdivisions=1, radius=1e-4)
    path = tmp_path / "my.ply"
    mesh.write_ply(
        path,
        1e3 * np.concatenate([vertices, speck.vertices + [3.0, 0, 0]]),
        np.concatenate([faces, speck.faces + len(vertices)]),
    )
    text = create_scene(path, tmp_path / "out")
    assert "assumed millimetres, for the surface is 30 units across" in text
    assert "1 small loose piece," in text


def test_scale_and_spacing_are_taken(tmp_path: Path) -> None:
    path = write_stl(tmp_path / "my.stl")
    text = create_scene(path, tmp_path / "out", scale=2e-3, spacing=1.5e-3)
    assert "as given" in text
    scene, vessel, _ = read_back(tmp_path / "out")
    assert scene.discretization.spacing == 1.5e-3
    assert vessel.openings[0].radius == pytest.approx(2 * RADIUS, rel=5e-3)


def test_the_largest_opening_is_the_first_and_carries_the_column(tmp_path: Path) -> None:
    vertices, faces = cylinder()
    # A cone: twice as wide at the bottom as at the top.
    vertices[:, :2] *= 0.75 - 0.5 * vertices[:, 2:] / LENGTH
    path = tmp_path / "cone.ply"
    mesh.write_ply(path, vertices, faces)
    create_scene(path, tmp_path / "out")
    scene, vessel, _ = read_back(tmp_path / "out")
    first, second = vessel.openings
    assert first.radius == pytest.approx(2 * second.radius, rel=0.01)
    assert first.centre[2] < 0
    assert scene.column.opening == "opening_1"
    assert scene.gravity[2] == pytest.approx(9.81)


def test_the_folder_is_named_after_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    create_scene(write_stl(tmp_path / 'my "véssel".stl'))
    scene = read_scene(tmp_path / 'my "véssel"' / "scene.toml")
    assert scene.title == 'my "véssel"'


def closed_ball(path: Path) -> None:
    path.write_bytes(trimesh.creation.icosphere(radius=10.0).export(file_type="stl"))


def holed(path: Path) -> None:
    vertices, faces = cylinder()
    side = np.flatnonzero(np.ptp(vertices[faces][:, :, 2], axis=1) > 1e-9)
    mesh.write_ply(path, vertices, np.delete(faces, side[200], axis=0))


def tiny(path: Path) -> None:
    write_stl(path, scale=1e-6)


@pytest.mark.parametrize(
    ("make", "suffix", "words"),
    [
        (closed_ball, ".stl", "no opening found"),
        (holed, ".ply", "3 edges"),
        (tiny, ".stl", "give --scale"),
        (lambda path: path.write_bytes(b"no mesh"), ".stl", "my.stl"),
        (lambda path: None, ".stl", "cannot read the surface"),
    ],
)
def test_what_cannot_be_used_is_refused_and_leaves_nothing(
    tmp_path: Path, make, suffix: str, words: str
) -> None:
    path = tmp_path / f"my{suffix}"
    make(path)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError) as error:
        create_scene(path, tmp_path / "out")
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert sorted(tmp_path.iterdir()) == before


def test_bad_options_are_refused(tmp_path: Path) -> None:
    path = write_stl(tmp_path / "my.stl")
    (tmp_path / "taken").mkdir()
    with pytest.raises(InputError, match="taken: already exists"):
        create_scene(path, tmp_path / "taken")
    with pytest.raises(InputError, match=r"nowhere.out: cannot make .* No such file"):
        create_scene(path, tmp_path / "nowhere" / "out")
    with pytest.raises(InputError, match=r"--scale: 1 makes .* 30 m across"):
        create_scene(path, tmp_path / "out", scale=1.0)
    with pytest.raises(InputError, match=r"--spacing: -1 is not a length"):
        create_scene(path, tmp_path / "out", spacing=-1.0)
    with pytest.raises(InputError, match=r"--scale: nan is not a length"):
        create_scene(path, tmp_path / "out", scale=float("nan"))
    with pytest.raises(InputError, match=r"spacing: 0\.004 m puts 2\.5"):
        create_scene(path, tmp_path / "out", spacing=4e-3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["my.stl", "taken"]


@pytest.mark.parametrize(
    "name", ["aortoiliac", pytest.param("carotid_siphon", marks=pytest.mark.validation)]
)
@pytest.mark.parametrize("kind", ["capped", "wall"])
def test_real_surfaces_become_scenes(tmp_path: Path, name: str, kind: str) -> None:
    path = REAL / f"{name}_{kind}.stl"
    if not path.exists():
        pytest.skip(f"{path}: the real surfaces are not part of the project")
    text = create_scene(path, tmp_path / "out")
    assert "assumed millimetres" in text
    _, vessel, blood = read_back(tmp_path / "out")
    radii = {"aortoiliac": [7.61, 4.30, 4.26], "carotid_siphon": [2.01, 1.57, 1.555]}[name]
    assert [1e3 * o.radius for o in vessel.openings] == pytest.approx(radii, rel=0.01)
    volume = {"aortoiliac": 10158.4, "carotid_siphon": 1479.4}[name]
    assert vessel.volume * 1e9 == pytest.approx(volume, rel=1e-3)
    assert 2500 < len(blood) < 7000
    assert vessel.count_leaks(blood) == 0
