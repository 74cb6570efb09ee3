"""Surface files: what is sound is read, what is cut or wrong is refused in one sentence."""

from pathlib import Path

import numpy as np
import pytest

from surface_bytes import (
    RADIUS,
    VOLUME,
    ascii_stl,
    binary_stl,
    four_solids,
    obj,
    ply,
    quads,
    tube,
    v_lines,
    vtk,
    vtp,
)
from taichi_sph.errors import InputError
from taichi_sph.geometry import mesh
from taichi_sph.geometry.surface_file import load_surface

V, F = tube()
STL = ascii_stl(V, F)
BINARY = binary_stl(V, F, b"aorta")
OBJ = obj(V, F)
TEXT_PLY, BINARY_PLY = ply(V, F), ply(V, F, "binary_little_endian", "float")
FORMS = {
    ".stl": [STL.encode(), BINARY],
    ".ply": [TEXT_PLY, BINARY_PLY, ply(V, F, "binary_big_endian")],
    ".obj": [OBJ.encode()],
    ".vtp": [vtp([(V, F)]), vtp([(V, F)], "binary"), vtp([(V, F)], "appended", compressed=True)],
    ".vtk": [vtk(V, F), vtk(V, F, True), vtk(V, F, True, "5.1")],
}


def load(folder: Path, kind: str, data: bytes | str) -> tuple[np.ndarray, np.ndarray]:
    path = folder / f"my{kind}"
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return load_surface(path)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    return mesh.enclosed_volume(vertices, faces)


def assert_is_the_tube(found: tuple[np.ndarray, np.ndarray], triangles: int = 168) -> None:
    vertices, faces = found
    assert len(faces) == triangles
    # Single precision has 24 bits.
    assert volume(vertices, faces) == pytest.approx(VOLUME, rel=1e-6)


def refusal(folder: Path, kind: str, data: bytes | str) -> str:
    with pytest.raises(InputError) as error:
        load(folder, kind, data)
    text = str(error.value)
    assert f"my{kind}" in text
    assert "\n" not in text
    return text


@pytest.mark.parametrize("kind", FORMS)
def test_every_form_of_a_format_gives_the_same_tube(tmp_path: Path, kind: str) -> None:
    for data in FORMS[kind]:
        found = load(tmp_path, kind, data)
        assert_is_the_tube(found)
        # Corners in the order of the file: scenes keep their bits.
        assert np.abs(found[0][found[1]] - V[F]).max() < 1e-6 * 40
        assert_is_the_tube(load(tmp_path, kind.upper(), data))


@pytest.mark.parametrize("kind", FORMS)
def test_a_file_cut_anywhere_is_refused_or_whole(tmp_path: Path, kind: str) -> None:
    random = np.random.default_rng(0)
    for data in FORMS[kind]:
        places = random.integers(1, len(data) - 1, 40)
        refused = 0
        for place in [*places, len(data) - 2, len(data) // 2]:
            try:
                found = load(tmp_path, kind, data[:place])
            except InputError as error:
                assert "my" + kind in str(error) and "\n" not in str(error)
                refused += 1
                continue
            # No OBJ file says how long it is: what was read of one cut between lines has a hole;
            # a text cut within its last number has a wrong edge.  Both are refused as surfaces.
            if kind == ".stl" or mesh.is_closed(found[1]):
                assert_is_the_tube(found)
            else:
                assert kind == ".obj" or data == TEXT_PLY
        assert refused > 25 or (kind == ".obj" and refused > 20)


@pytest.mark.parametrize("kind", [".stl", ".ply", ".obj", ".vtp", ".vtk"])
def test_padding_behind_the_end_is_no_fault(tmp_path: Path, kind: str) -> None:
    for data in FORMS[kind]:
        for padding in (b"\0" * 500, b" " * 90, b"\r\n\r\n", b"\n\x1a", b"\0"):
            assert_is_the_tube(load(tmp_path, kind, data + padding))


# STL


@pytest.mark.parametrize(
    "text",
    [
        ascii_stl(V, F, end="end solid aorta"),
        ascii_stl(V, F, end="endsolid"),
        ascii_stl(V, F, end="ENDSOLID other name"),
        ascii_stl(V, F, ""),
        ascii_stl(V, F, "facet vertex endsolid 7"),
        ascii_stl(V, F, "véssel"),
        STL.replace("\n", "\r\n"),
        STL.replace("\n", "\r"),
        STL.replace("\n", "\n\n"),
        STL.upper(),
        STL.rstrip("\n"),
        "\ufeff\n\n   " + STL,
        STL.replace("outer loop\n", "outer loop ").replace("endloop\n", "endloop "),
        STL.replace("normal 0 0 0", "normal nan -nan(ind) -1.#IND"),
        STL.replace("endfacet", "end facet").replace("endloop", "end loop"),
        four_solids(),
    ],
)
def test_odd_but_whole_text_stl_is_read(tmp_path: Path, text: str) -> None:
    assert_is_the_tube(load(tmp_path, ".stl", text))


def test_odd_but_whole_binary_stl_is_read(tmp_path: Path) -> None:
    assert_is_the_tube(load(tmp_path, ".stl", binary_stl(V, F, b"solid aorta")))
    assert_is_the_tube(load(tmp_path, ".stl", binary_stl(V, F, b"solid aorta") + b"\0" * 100))
    parts = binary_stl(V, F[:80], b"solid wall") + binary_stl(V, F[80:], b"rest")
    assert_is_the_tube(load(tmp_path, ".stl", parts))


def test_a_cut_text_stl_names_the_solid(tmp_path: Path) -> None:
    whole = four_solids()
    at = whole.index("solid wall_distal")
    text = refusal(tmp_path, ".stl", whole[: whole.index("facet", at + 3000)])
    assert "the file ends within solid wall_distal; it is cut" in text
    text = refusal(tmp_path, ".stl", whole[: whole.index("vertex", at + 3000)])
    assert "the file ends within solid wall_distal; it is cut" in text
    text = refusal(tmp_path, ".stl", ascii_stl(V, F, "").removesuffix("endsolid \n"))
    assert "within solid number 1; it is cut" in text
    # Cut, and another file joined to it.
    assert "begins within solid aorta" in refusal(
        tmp_path, ".stl", STL.removesuffix("endsolid aorta\n") + STL
    )


@pytest.mark.parametrize("header", [b"aorta", b"solid aorta"])
def test_a_binary_stl_whose_length_does_not_fit_says_both_counts(
    tmp_path: Path, header: bytes
) -> None:
    data = binary_stl(V, F, header)
    half = refusal(tmp_path, ".stl", data[: len(data) // 2])
    assert "the header says 168 triangles, the file holds 83" in half
    longer = refusal(tmp_path, ".stl", data + data[184:384])
    assert "the header says 168 triangles, the file holds 172" in longer
    assert "fewer than the header" in refusal(tmp_path, ".stl", data[:60].replace(b"solid", b""))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (STL.replace("vertex 4 0 0", "vertex 4,0 0 0", 1), "line 4: '4,0' is not a number"),
        (STL.replace("vertex 4 0 0", "vertex 4 0", 1), "a vertex of 2 numbers"),
        (STL.replace("vertex 4 0 0", "vertex nan 0 0"), "not finite"),
        (STL.replace("vertex 4 0 0\n", "vertex 4 0 0\n vertex 4 0 1\n", 1), "without 3 vertices"),
        (STL.replace("endfacet", "endface", 1), "line 8: 'endface' is no word of an STL file"),
        ("<html><body>404 not found</body></html>" * 5, "it is cut or damaged, or is no STL"),
        (b"", "it is cut, or is no STL file"),
        ("solid empty\nendsolid empty\n", "the surface has no triangles"),
    ],
)
def test_what_is_wrong_in_an_stl_file_is_said(
    tmp_path: Path, text: bytes | str, words: str
) -> None:
    assert words in refusal(tmp_path, ".stl", text)


# PLY


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("number", ["float", "double"])
@pytest.mark.parametrize("colours", [False, True])
def test_polygons_and_colours_of_a_ply_file(
    tmp_path: Path, form: str, number: str, colours: bool
) -> None:
    vertices, polygons = quads()
    data = ply(vertices, polygons, form, number, colours)
    assert_is_the_tube(load(tmp_path, ".ply", data), 2 * 72 + 2 * 10)


def test_a_ply_file_says_which_count_is_not_met(tmp_path: Path) -> None:
    for data in FORMS[".ply"]:
        more = data.replace(b"element face 168", b"element face 170")
        text = refusal(tmp_path, ".ply", more)
        assert "the header says 170 rows of face, the file holds 168; it is cut" in text
        fewer = data.replace(b"element face 168", b"element face 100")
        assert "more than its header says" in refusal(tmp_path, ".ply", fewer)
        half = data[: data.index(b"end_header") + 300]
        assert "the header says 86 rows of vertex, the file holds" in refusal(
            tmp_path, ".ply", half
        )
        assert "ends within its header" in refusal(tmp_path, ".ply", data[:60])
        huge = data.replace(b"element vertex 86", b"element vertex 86000000000")
        assert "rows of vertex" in refusal(tmp_path, ".ply", huge)
    assert "no PLY file" in refusal(tmp_path, ".ply", STL)
    assert "lack x, y or z" in refusal(
        tmp_path, ".ply", TEXT_PLY.replace(b"double z", b"double height")
    )
    assert "refers to vertex 86" in refusal(
        tmp_path, ".ply", TEXT_PLY.replace(b"\n3 84 1 0", b"\n3 86 1 0")
    )


# OBJ


def test_relative_indices_count_back_from_their_line(tmp_path: Path) -> None:
    each = "".join(v_lines(V[corners]) + "f -3 -2 -1\n" for corners in F)
    assert_is_the_tube(load(tmp_path, ".obj", each))
    after = v_lines(V) + "".join(f"f {a} {b} {c}\n" for a, b, c in F - len(V))
    assert_is_the_tube(load(tmp_path, ".obj", after))
    mixed = v_lines(V) + "".join(f"f {a + 1} {b - len(V)} {c + 1}\n" for a, b, c in F)
    assert_is_the_tube(load(tmp_path, ".obj", mixed))


@pytest.mark.parametrize(
    "text",
    [
        obj(V, F, "%d/1/7"),
        obj(V, F, "%d//7"),
        obj(V, F, "%d/3"),
        obj(V, F).replace("f ", "f \\\n  "),
        obj(V, F).replace("\n", " # said\r\n"),
        "mtllib lost.mtl\no wall\ng a b\ns off\n" + obj(V, F).replace("f 85", "usemtl none\nf 85"),
        v_lines(V).replace("\n", " 0.5 0.25 1\n") + obj(V[:0], F),
        v_lines(V).replace("\n", " 1.0\n") + obj(V[:0], F),
        obj(V[:0], F) + v_lines(V),
        obj(V, F) + "l 1 2 3\np 4\nvt 0 0\nvn 0 0 1\nvp 1\ncstype bezier\n",
    ],
)
def test_every_way_to_write_an_obj_file(tmp_path: Path, text: str) -> None:
    assert_is_the_tube(load(tmp_path, ".obj", text))


def test_polygons_of_an_obj_file(tmp_path: Path) -> None:
    assert_is_the_tube(load(tmp_path, ".obj", obj(*quads())), 164)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (OBJ + "f 1 2\n", "line 255: a face of 2, at least 3 are needed"),
        (OBJ + "v 1 2\n", "line 255: a vertex of 2"),
        (OBJ + "f 1 2 999\n", "line 255: a face refers to vertex 999, the file has 86"),
        (OBJ + "f 1 2 -87\n", "line 255: a face refers to vertex -87, 86 stand before it"),
        (OBJ + "f 0 1 2\n", "line 255: a face refers to vertex 0"),
        (OBJ + "f 1 2 x\n", "line 255: 'x' is no corner of a face"),
        (OBJ + "v 1 2,5 3\n", "line 255: '2,5' is not a number"),
        (OBJ + "f 1 2 \\", "continued; it is cut"),
        (v_lines(V), "the surface has no triangles"),
        (BINARY, "the surface has no triangles"),
    ],
)
def test_what_is_wrong_in_an_obj_file_is_said(
    tmp_path: Path, text: str | bytes, words: str
) -> None:
    assert words in refusal(tmp_path, ".obj", text)


def test_polygons_that_do_not_bulge_are_cut_within_their_rim(tmp_path: Path) -> None:
    # A comb and an arrow, in a slanted plane: a fan from the first corner leaves them.
    comb = np.array([[0, 0], [5, 0], [5, 4], [4, 1], [3, 4], [2, 1], [1, 4], [0, 1]], float)
    arrow = np.array([[0, 0], [2, 3], [0, 1], [-2, 3]], float)
    for flat, area in ((comb, 12.5), (arrow, 2.0)):
        for start in range(len(flat)):
            turned = np.roll(flat, start, axis=0)
            points = turned @ np.array([[1.0, 0, 0.5], [0, 1.0, -0.25]])
            stretch = np.linalg.norm(np.cross([1.0, 0, 0.5], [0, 1.0, -0.25]))
            vertices, faces = load(tmp_path, ".obj", obj(points, [range(len(flat))]))
            vectors = mesh.face_vectors(vertices, faces)
            assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(area * stretch)
            assert np.linalg.norm(vectors.sum(axis=0)) == pytest.approx(area * stretch)
    crossed = np.array([[0, 0, 0], [2, 2, 0], [4, 0, 0], [4, 2, 0], [1, -1, 0], [0, 2, 0]], float)
    assert "crosses itself" in refusal(tmp_path, ".obj", obj(crossed, [range(6)]))


# VTK


@pytest.mark.parametrize("number", ["Float32", "Float64"])
@pytest.mark.parametrize(
    ("form", "compressed", "raw"),
    [
        ("ascii", False, True),
        ("binary", False, True),
        ("binary", True, True),
        ("appended", False, True),
        ("appended", False, False),
        ("appended", True, True),
        ("appended", True, False),
    ],
)
def test_xml_polydata_in_all_its_layouts(
    tmp_path: Path, form: str, compressed: bool, raw: bool, number: str
) -> None:
    halves = [mesh.drop_unused(V, F[:96]), mesh.drop_unused(V, F[96:])]
    for index, header, order in (
        ("Int32", "UInt32", "LittleEndian"),
        ("Int64", "UInt64", "LittleEndian"),
        ("Int64", "UInt32", "BigEndian"),
    ):
        layout = (form, number, index, header, order, compressed, raw)
        assert_is_the_tube(load(tmp_path, ".vtp", vtp([(V, F)], *layout)))
        assert_is_the_tube(load(tmp_path, ".vtp", vtp(halves, *layout)))
        wall = load(tmp_path, ".vtp", vtp([(V, F[:144])], *layout, strips=True))
        assert np.array_equal(np.sort(wall[1].reshape(-1, 6)), np.sort(F[:144].reshape(-1, 6)))
        assert mesh.is_winding_consistent(np.concatenate([wall[1], F[144:]]))


@pytest.mark.parametrize("version", ["2.0", "3.0", "4.2", "5.1"])
@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("number", ["float", "double"])
def test_legacy_polydata_of_every_version(
    tmp_path: Path, version: str, binary: bool, number: str
) -> None:
    assert_is_the_tube(load(tmp_path, ".vtk", vtk(V, F, binary, version, number)))
    wall = load(tmp_path, ".vtk", vtk(V, F[:144], binary, version, number, strips=True))
    assert mesh.is_winding_consistent(np.concatenate([wall[1], F[144:]]))
    if not binary:
        data = vtk(V, F, binary, version, number)
        assert_is_the_tube(load(tmp_path, ".vtk", data.replace(b"\n", b"\r\n")))


def test_polygons_of_vtk_files(tmp_path: Path) -> None:
    vertices, polygons = quads()
    head = f"# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA\nPOINTS {len(vertices)} float\n"
    rows = v_lines(vertices).replace("v ", "")
    size = sum(len(p) + 1 for p in polygons)
    cells = "".join(" ".join(map(str, [len(p), *p])) + "\n" for p in polygons)
    text = f"{head}{rows}POLYGONS {len(polygons)} {size}\n{cells}"
    assert_is_the_tube(load(tmp_path, ".vtk", text), 164)


@pytest.mark.parametrize(
    ("kind", "data", "words"),
    [
        (".vtp", vtp([(V, F)]).replace(b"PolyData", b"UnstructuredGrid"), "a UnstructuredGrid"),
        (".vtk", vtk(V, F).replace(b"POLYDATA", b"UNSTRUCTURED_GRID"), "UNSTRUCTURED_GRID"),
        (".vtp", vtp([(V, F)])[:3000], "not whole XML"),
        (".vtp", vtp([(V, F)]).replace(b'Points="86"', b'Points="90"'), "should have 270 numbers"),
        (
            ".vtp",
            vtp([(V, F)], "binary", compressed=True).replace(b"ZLib", b"LZ4"),
            "compressed by vtkLZ4DataCompressor; allowed: no compression, zlib, lzma",
        ),
        (".vtp", vtp([(V, F)], "appended")[:-2000], "the end of the file; it is cut"),
        (".vtp", vtp([(V[:80], F)]), "refers to point 85 of 80"),
        (".vtk", vtk(V, F)[:900], "258 numbers of POINTS are announced, the file holds"),
        (".vtk", vtk(V, F, True)[:900], "258 numbers of POINTS are announced, the file holds"),
        (".vtk", vtk(V[:80], F), "refers to point 85 of 80"),
        (".vtk", vtk(V, F).replace(b"ASCII", b"UTF8"), "allowed: ASCII, BINARY"),
        (".vtk", STL, "so it is no .vtk file"),
        (".vtp", STL, "not whole XML"),
        (".vtu", b"", "ParaView: Extract Surface"),
        (".off", b"OFF", "allowed: STL, PLY, OBJ, VTP, VTK"),
        (".glb", b"glTF", "allowed: STL, PLY, OBJ, VTP, VTK"),
        ("", b"solid", "not a readable (none) surface"),
    ],
)
def test_what_is_no_polydata_is_refused(
    tmp_path: Path, kind: str, data: bytes | str, words: str
) -> None:
    assert words in refusal(tmp_path, kind, data)


def test_a_file_that_cannot_be_opened_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.stl").mkdir()
    for name in ("folder.stl", "absent.ply"):
        with pytest.raises(InputError, match=f"{name}: cannot read the surface"):
            load_surface(tmp_path / name)


def test_far_away_and_mirrored_keeps_its_size(tmp_path: Path) -> None:
    away = V * [-1, 1, 1] + [1e5, -1e5, 3e4]
    vertices, faces = load(tmp_path, ".stl", binary_stl(away, F))
    # A float has a grain of 0.008 there.
    assert volume(vertices, faces) == pytest.approx(-VOLUME, rel=5e-3)
    assert np.ptp(vertices[:, 0]) == pytest.approx(2 * RADIUS, abs=0.02)
