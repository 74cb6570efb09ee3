"""Surface files as bytes, in the layouts that the formats' own programs write."""

import base64
import struct
import zlib
from collections.abc import Sequence

import numpy as np

from taichi_sph.geometry.mesh import Floats, Integers

Mesh = tuple[Floats, Integers]

AROUND, RINGS, RADIUS, LENGTH = 12, 7, 4.0, 40.0
VOLUME = 0.5 * AROUND * np.sin(2 * np.pi / AROUND) * RADIUS**2 * LENGTH
"""Of the prism of 12 sides that `tube` is, in cubic units of the file."""


def tube(capped: bool = True) -> Mesh:
    """Tube of 168 triangles, 8 wide and 40 long, along z, with fans for caps."""
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    rings = [
        np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), np.full(AROUND, z)], 1)
        for z in np.linspace(0, LENGTH, RINGS)
    ]
    faces = []
    for k in range(RINGS - 1):
        for j in range(AROUND):
            a, b = k * AROUND + j, k * AROUND + (j + 1) % AROUND
            faces += [(a, b, b + AROUND), (a, b + AROUND, a + AROUND)]
    last, middle = AROUND * (RINGS - 1), AROUND * RINGS
    if capped:
        rings.append(np.array([[0, 0, 0], [0, 0, LENGTH]], float))
        faces += [(middle, (j + 1) % AROUND, j) for j in range(AROUND)]
        faces += [(middle + 1, last + j, last + (j + 1) % AROUND) for j in range(AROUND)]
    return np.concatenate(rings), np.array(faces)


def quads() -> tuple[Floats, list[list[int]]]:
    """The tube of four-sided polygons, with polygons of 12 sides for caps."""
    vertices, _ = tube(capped=False)
    polygons = [
        [k * AROUND + j, k * AROUND + (j + 1) % AROUND]
        + [(k + 1) * AROUND + (j + 1) % AROUND, (k + 1) * AROUND + j]
        for k in range(RINGS - 1)
        for j in range(AROUND)
    ]
    first = list(range(AROUND))
    return vertices, [*polygons, first[::-1], [AROUND * (RINGS - 1) + j for j in first]]


def binary_stl(vertices: Floats, faces: Integers, header: bytes = b"") -> bytes:
    rows = np.zeros(len(faces), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    rows["v"] = vertices[faces]
    return header.ljust(80)[:80] + struct.pack("<I", len(faces)) + rows.tobytes()


def ascii_stl(
    vertices: Floats, faces: Integers, name: str = "aorta", form: str = "%.9g", end: str = ""
) -> str:
    lines = [f"solid {name}"]
    for corners in vertices[faces]:
        lines += ["  facet normal 0 0 0", "    outer loop"]
        lines += ["      vertex " + " ".join(form % x for x in corner) for corner in corners]
        lines += ["    endloop", "  endfacet"]
    return "\n".join([*lines, end or f"endsolid {name}"]) + "\n"


def four_solids() -> str:
    """The tube as inlet, two lengths of wall and outlet."""
    vertices, faces = tube()
    parts = {"inlet": (144, 156), "wall_proximal": (0, 96), "wall_distal": (96, 144)}
    parts["outlet"] = (156, 168)
    return "".join(ascii_stl(vertices, faces[a:b], name) for name, (a, b) in parts.items())


def v_lines(vertices: Floats) -> str:
    return "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices)


def obj(vertices: Floats, polygons: Sequence[Sequence[int]] | Integers, form: str = "%d") -> str:
    """Every corner as a form of its number, which may stand in it more than once."""
    spots = form.count("%d")
    lines = ["f " + " ".join(form % ((int(i) + 1,) * spots) for i in p) + "\n" for p in polygons]
    return v_lines(vertices) + "".join(lines)


def ply(
    vertices: Floats, polygons: Sequence[Sequence[int]] | Integers, form: str = "ascii",
    number: str = "double", colours: bool = False,
) -> bytes:  # fmt: skip
    """A PLY file in one of its three forms."""
    head = f"ply\nformat {form} 1.0\ncomment made by a test\nelement vertex {len(vertices)}\n"
    head += "".join(f"property {number} {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue") if colours)
    head += f"element face {len(polygons)}\nproperty list uchar int vertex_indices\nend_header\n"
    if form == "ascii":
        tail = " 200 10 10" * colours
        body = "".join(f"{x:.17g} {y:.17g} {z:.17g}{tail}\n" for x, y, z in vertices)
        body += "".join(" ".join(map(str, [len(p), *p])) + "\n" for p in polygons)
        return (head + body).encode()
    order = "<" if form == "binary_little_endian" else ">"
    kind = {"float": "f", "double": "d"}[number]
    rows = [struct.pack(f"{order}3{kind}", *v) + b"\xc8\x0a\x0a" * colours for v in vertices]
    rows += [struct.pack(f"{order}B{len(p)}i", len(p), *(int(i) for i in p)) for p in polygons]
    return head.encode() + b"".join(rows)


# VTK

_NUMBERS = {"Float32": "f4", "Float64": "f8", "Int32": "i4", "Int64": "i8", "UInt8": "u1"}


def encode_array(numbers: np.ndarray, header: str, compressed: bool, raw: bool) -> bytes:
    """Bytes of one array as VTK lays them out: lengths, then data, in blocks if compressed."""
    data = numbers.tobytes()
    order = ">" if numbers.dtype.byteorder == ">" else "<"
    size = np.dtype(order + {"UInt32": "u4", "UInt64": "u8"}[header])
    if not compressed:
        head = np.array([len(data)], size).tobytes()
        return head + data if raw else base64.b64encode(head + data)
    block = 512
    blocks = [zlib.compress(data[k : k + block]) for k in range(0, len(data), block)]
    head = np.array(
        [len(blocks), block, len(data) % block, *(len(b) for b in blocks)], size
    ).tobytes()
    body = b"".join(blocks)
    return head + body if raw else base64.b64encode(head) + base64.b64encode(body)


def vtp(
    pieces: Sequence[Mesh], form: str = "ascii", number: str = "Float32", index: str = "Int64",
    header: str = "UInt32", order: str = "LittleEndian", compressed: bool = False, raw: bool = True,
    strips: bool = False,
) -> bytes:  # fmt: skip
    """An XML PolyData file with normals on points, a number on cells and a line beside the faces.

    Args:
        pieces: meshes, one to a piece.
        form: ascii, binary or appended.
        number: type of the coordinates.
        index: type of the corners.
        header: type of the lengths before binary data.
        order: LittleEndian or BigEndian.
        compressed: by zlib.
        raw: appended data as they are, not as base64.
        strips: every pair of triangles of a quad as a strip of four.
    """
    appended: list[bytes] = []

    def array(name: str, kind: str, numbers: np.ndarray) -> str:
        place = f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="3" format="{form}"'
        way = "<" if order == "LittleEndian" else ">"
        values = np.ascontiguousarray(numbers).astype(way + _NUMBERS[kind])
        if form == "ascii":
            text = " ".join(map(repr, values.reshape(-1).tolist()))
            # As VTK describes a range: an element behind the numbers.
            key = '<InformationKey name="RANGE" length="1"><Value>0</Value></InformationKey>'
            return f"{place}>\n{text}\n{key}\n</DataArray>"
        coded = encode_array(values, header, compressed, raw and form == "appended")
        if form == "binary":
            return f"{place}>\n  {coded.decode()}\n</DataArray>"
        offset = sum(len(part) for part in appended)
        appended.append(coded)
        return f'{place} offset="{offset}"/>'

    compressor = ' compressor="vtkZLibDataCompressor"' * compressed
    text = (
        f'<?xml version="1.0"?>\n<VTKFile type="PolyData" version="1.0" byte_order="{order}" '
        f'header_type="{header}"{compressor}>\n<PolyData>\n'
    )
    for vertices, faces in pieces:
        cells, size, kind = faces, 3, "Polys"
        if strips:
            # (a, b, c), (a, c, d) of a quad: the strip b, c, a, d.
            cells, size, kind = faces.reshape(-1, 6)[:, [1, 2, 0, 5]], 4, "Strips"
        text += f'<Piece NumberOfPoints="{len(vertices)}" NumberOfVerts="0" NumberOfLines="1"'
        text += f' NumberOf{kind}="{len(cells)}">\n<PointData Normals="n">'
        text += array("n", "Float32", vertices) + "</PointData><CellData>"
        text += array("ModelFaceID", "UInt8", np.ones(len(cells) + 1)) + "</CellData>"
        text += "<Points>" + array("Points", number, vertices) + "</Points>"
        text += "<Lines>" + array("connectivity", index, np.arange(2))
        text += array("offsets", index, np.array([2])) + f"</Lines><{kind}>"
        text += array("connectivity", index, cells)
        text += array("offsets", index, size * np.arange(1, len(cells) + 1)) + f"</{kind}></Piece>"
    text += "\n</PolyData>\n"
    data = text.encode()
    if form == "appended":
        data += f'<AppendedData encoding="{"raw" if raw else "base64"}">\n _'.encode()
        data += b"".join(appended) + b"\n</AppendedData>\n"
    return data + b"</VTKFile>\n"


def vtk(
    vertices: Floats, faces: Integers, binary: bool = False, version: str = "4.2",
    number: str = "float", strips: bool = False,
) -> bytes:  # fmt: skip
    """A legacy PolyData file with a field before, a line beside and data behind the faces."""

    def numbers(values: np.ndarray, kind: str) -> bytes:
        if binary:
            return np.ascontiguousarray(values).astype(kind).tobytes() + b"\n"
        return " ".join(map(repr, np.asarray(values).reshape(-1).tolist())).encode() + b" \n"

    def cells(key: str, table: np.ndarray) -> bytes:
        count, size = table.shape
        if version < "5":
            head = f"{key} {count} {count * (size + 1)}\n".encode()
            return head + numbers(np.insert(table, 0, size, axis=1), ">i4")
        head = f"{key} {count + 1} {count * size}\nOFFSETS vtktypeint64\n".encode()
        head += numbers(size * np.arange(count + 1), ">i8") + b"CONNECTIVITY vtktypeint64\n"
        return head + numbers(table, ">i8")

    data = f"# vtk DataFile Version {version}\n\n{'BINARY' if binary else 'ASCII'}\n".encode()
    data += b"DATASET POLYDATA\nFIELD FieldData 1\nTimeValue 1 1 double\n"
    data += numbers(np.array([1.5]), ">f8") + f"POINTS {len(vertices)} {number}\n".encode()
    data += numbers(vertices, {"float": ">f4", "double": ">f8"}[number])
    data += b"METADATA\nINFORMATION 0\n\n"
    data += cells("LINES", np.array([[0, 1]]))
    if strips:
        data += cells("TRIANGLE_STRIPS", faces.reshape(-1, 6)[:, [1, 2, 0, 5]])
    else:
        data += cells("POLYGONS", faces)
    data += f"CELL_DATA {len(faces)}\nSCALARS ModelFaceID int 1\nLOOKUP_TABLE default\n".encode()
    return data + numbers(np.ones(len(faces)), ">i4")
