"""Readers of STL, PLY and OBJ files, which say where a file is cut or what in it is wrong.

trimesh, which the project uses for other ends, reads as far as it can and stays silent on the rest:
a text file that is cut gives a shorter vessel, and relative OBJ indices are resolved against the
end of the file.  Hence these.  A reader takes the bytes of a file and gives `Polygons`.
"""

from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_sph.geometry.mesh import Floats, Integers

PADDING = b"\0 \t\r\n\x1a"
"""Bytes that copies and old exporters leave behind the end of a file; 1a ends a text in DOS."""


class FormatError(ValueError):
    """What in a file is not as its format asks: a clause without the file's name."""


@dataclass(frozen=True, eq=False)
class Polygons:
    """Polygons as a file has them."""

    points: Floats
    """Vertices in the file's units, (n, 3)."""
    corners: Integers
    """Vertices of one polygon after the other, (sum of sizes,)."""
    sizes: Integers
    """Number of corners of each polygon, (m,)."""


def to_float(word: bytes, place: str) -> float:
    """A number of a text file.

    Raises:
        FormatError: the word is none.
    """
    try:
        return float(word)
    except ValueError:
        raise FormatError(
            f"{place}: {printable(word)} is not a number; allowed: numbers with a decimal point"
        ) from None


def to_floats(words: list[bytes], place: str) -> Floats:
    """Numbers of a text file.

    Raises:
        FormatError: a word is none.
    """
    try:
        return np.array(words, dtype=np.float64)
    except ValueError:
        for word in words:
            to_float(word, place)
        raise


def printable(word: bytes) -> str:
    """A word of a file for a message: quoted, at most 40 characters."""
    return repr(word[:40].decode("utf-8", "replace"))


# STL


def read_stl(data: bytes) -> Polygons:
    """Triangles of an STL file, ASCII or binary, of one or more solids.

    Raises:
        FormatError: the file is cut, or is no STL file.
    """
    start = data.lstrip(b"\xef\xbb\xbf" + PADDING)
    fits = len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")
    # The count of a binary file has a zero among its bytes up to 16 million triangles.
    if not fits and start[:5].lower() == b"solid" and b"\0" not in data[80:84]:
        points = _ascii_stl(start)
    else:
        points = _binary_stl(data)
    count = len(points) // 3
    return Polygons(points, np.arange(3 * count), np.full(count, 3))


def _binary_stl(data: bytes) -> Floats:
    """Corners of the triangles of one binary STL file, or of several joined end to end."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    if len(data) < 84:
        raise FormatError(
            f"the file has {len(data)} bytes, fewer than the header of a binary STL file; "
            "it is cut, or is no STL file"
        )
    blocks, place = [], 0
    while place == 0 or data[place:].strip(PADDING):
        count = int.from_bytes(data[place + 80 : place + 84], "little")
        after = place + 84 + 50 * count
        if len(data) < place + 84 or after > len(data):
            said = int.from_bytes(data[80:84], "little")
            raise FormatError(
                f"the header says {said} triangles, the file holds {(len(data) - 84) // 50}; "
                "it is cut or damaged, or is no STL file"
            )
        blocks.append(np.frombuffer(data, record, count, place + 84)["corners"])
        place = after
    return np.concatenate(blocks).reshape(-1, 3).astype(np.float64)


def _ascii_stl(text: bytes) -> Floats:
    """Corners of the triangles of an ASCII STL file."""
    corners = array("d")
    solid: str | None = None
    solids = 0
    facet = loop = 0  # the line on which each began, 0 outside
    lines = text.replace(b"\0", b" ").replace(b"\x1a", b" ").replace(b"\r", b"\n").split(b"\n")
    if b"endsolid" not in lines[-1].lower() and b"end solid" not in lines[-1].lower():
        lines.pop()  # a line without an end is where the file was cut
    # A carriage return and a line feed are one end of a line.
    step = 2 if b"\r\n" in text[:1000] else 1

    def wrong(text: str) -> FormatError:
        return FormatError(f"line {index // step + 1}: {text}")

    for index, line in enumerate(lines):
        words = line.split()
        while words:
            key = words[0].lower()
            if key == b"end" and len(words) > 1:
                key, words = b"end" + words[1].lower(), words[1:]
            if key == b"vertex":
                if not loop:
                    raise wrong("a vertex outside a facet")
                if len(words) < 4:
                    raise wrong(f"a vertex of {len(words) - 1} numbers; allowed: 3")
                try:
                    corners.extend((float(words[1]), float(words[2]), float(words[3])))
                except ValueError:
                    for word in words[1:4]:
                        to_float(word, f"line {index // step + 1}")
                words = words[4:]
            elif key in (b"endloop", b"endfacet"):
                if loop and len(corners) != loop:
                    raise wrong("a facet without 3 vertices; allowed: triangles")
                if key == b"endfacet":
                    facet = loop = 0
                words = words[1:]
            elif key == b"outer":
                loop, words = len(corners) + 9, words[2:]
            elif key == b"facet":
                if solid is None or facet:
                    where = f"within the facet of line {facet}" if facet else "outside a solid"
                    raise wrong(f"a facet begins {where}")
                facet = index // step + 1
                # Normals are made from the corners: what the file says is not always a number.
                words = words[5:] if len(words) > 1 and words[1].lower() == b"normal" else words[1:]
            elif key == b"solid":
                if solid is not None:
                    raise wrong(f"a solid begins within {solid}; the file is damaged")
                solids += 1
                name = b" ".join(words[1:])[:60].decode("utf-8", "replace")
                solid, words = f"solid {name or f'number {solids}'}", []
            elif key == b"endsolid":
                if solid is None or facet:
                    where = f"within the facet of line {facet}" if facet else "outside a solid"
                    raise wrong(f"a solid ends {where}; the file is damaged")
                solid, words = None, []
            else:
                raise wrong(f"{printable(words[0])} is no word of an STL file")
    if solid is not None:
        raise FormatError(f"the file ends within {solid}; it is cut")
    return np.frombuffer(corners, np.float64).reshape(-1, 3).copy()


# PLY

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    """One kind of rows of a PLY file."""

    name: str
    count: int
    properties: list[tuple[str, str, str]]
    """Name, type and, of a list, the type of its length ('' of a single number)."""


def read_ply(data: bytes) -> Polygons:
    """Polygons of a PLY file, ASCII or binary of either byte order.

    Raises:
        FormatError: the file is cut, its counts are not met, or it is no PLY file.
    """
    order, elements, body = _ply_header(data)
    rows = _PlyRows(body, order)
    points = corners = sizes = None
    for element in elements:
        names = [name for name, _, _ in element.properties]
        lists = [n for n in names if element.name == "face" and n.startswith("vertex_ind")]
        columns, numbers, lengths = _read_element(rows, element, lists[0] if lists else "")
        if element.name == "vertex":
            if not {"x", "y", "z"} <= set(names):
                raise FormatError("its vertices lack x, y or z")
            points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
        elif lists:
            corners, sizes = numbers, lengths
    more = len(rows.body) - rows.at
    if more and not (isinstance(rows.body, bytes) and not rows.body[rows.at :].strip(PADDING)):
        unit = "bytes" if order else "numbers"
        raise FormatError(f"the file holds {more} {unit} more than its header says")
    if points is None or corners is None or sizes is None:
        raise FormatError(f"it has no {'vertices' if points is None else 'faces'}")
    return Polygons(points, corners, sizes)


def _ply_header(data: bytes) -> tuple[str, list[_Element], bytes]:
    """Byte order ('' of text), kinds of rows, and the bytes behind the header."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r", b" "):
        raise FormatError("it does not begin with the word ply, so it is no PLY file")
    order: str | None = None
    elements: list[_Element] = []
    place = 0
    while True:
        ends = [k for k in (data.find(b"\n", place), data.find(b"\r", place)) if k >= 0]
        if not ends:
            raise FormatError("the file ends within its header; it is cut")
        line = data[place : min(ends)]
        place = min(ends) + (2 if data[min(ends) : min(ends) + 2] == b"\r\n" else 1)
        words = line.decode("ascii", "replace").split()
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        if words == ["end_header"]:
            break
        try:
            if words[0] == "format":
                order = _PLY_ORDERS[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
                if elements[-1].count < 0:
                    raise ValueError
            elif words[:2] == ["property", "list"]:
                kinds = _PLY_TYPES[words[3]], _PLY_TYPES[words[2]]
                elements[-1].properties.append((words[4], *kinds))
            elif words[0] == "property":
                elements[-1].properties.append((words[2], _PLY_TYPES[words[1]], ""))
            else:
                raise KeyError
        except (KeyError, IndexError, ValueError):
            raise FormatError(f"its header has the line {printable(line)}, not of PLY") from None
    if order is None:
        raise FormatError("its header has no format line")
    return order, elements, data[place:]


class _PlyRows:
    """Rows of numbers behind the header of a PLY file."""

    def __init__(self, body: bytes, order: str):
        """Take the bytes behind the header, in a byte order, '' of text."""
        text = to_floats(body.strip(PADDING).split(), "its rows") if order == "" else None
        self.body: Floats | bytes = body if text is None else text
        self._order = order
        self.at = 0
        """Bytes read so far, or words of a text."""

    def take(self, kinds: list[str], rows: int) -> list[NDArray] | None:
        """A column (rows,) for each of these types; None where the file ends before."""
        if isinstance(self.body, bytes):
            table = np.dtype([(f"{k}", self._order + kind) for k, kind in enumerate(kinds)])
            end = self.at + rows * table.itemsize
            if end > len(self.body):
                return None
            block = np.frombuffer(self.body, table, rows, self.at)
            columns = [block[f"{k}"] for k in range(len(kinds))]
        else:
            end = self.at + rows * len(kinds)
            if end > len(self.body):
                return None
            columns = list(self.body[self.at : end].reshape(rows, len(kinds)).T)
        self.at = end
        return columns


def _read_element(
    rows: _PlyRows, element: _Element, wanted: str
) -> tuple[dict[str, NDArray], Integers, Integers]:
    """Columns of single numbers by name; numbers and lengths of the list that is wanted."""
    columns: dict[str, list[NDArray]] = {name: [] for name, _, _ in element.properties}
    numbers: list[NDArray] = [np.zeros(0, np.int64)]
    lengths: list[NDArray] = [np.zeros(0, np.int64)]
    done = 0
    while done < element.count:
        start = rows.at
        sizes = _row_sizes(rows, element, done)
        after, rows.at = rows.at, start
        # Most files have lists of one length: then all rows are one table, else one at a time.
        kinds: list[str] = []
        heads = []
        for (_, kind, length), size in zip(element.properties, sizes, strict=True):
            heads.append(len(kinds))
            kinds += [length or kind] + [kind] * size
        table = rows.take(kinds, element.count - done) if done == 0 else None
        lists = [k for k, (_, _, length) in enumerate(element.properties) if length]
        if table is None and not lists:
            raise _cut(element, (len(rows.body) - start) // (after - start))
        if table is None or not all((table[heads[k]] == sizes[k]).all() for k in lists):
            rows.at = start
            table = rows.take(kinds, 1) or []
        for (name, _, _), head, size in zip(element.properties, heads, sizes, strict=True):
            columns[name].append(table[head])
            if name == wanted:
                block = np.stack(table[head + 1 : head + 1 + size] or [table[head][:0]], axis=1)
                numbers.append(block.reshape(-1).astype(np.int64))
                lengths.append(np.full(len(table[head]), size))
        done += len(table[0])
    return (
        {name: np.concatenate(parts or [np.zeros(0)]) for name, parts in columns.items()},
        np.concatenate(numbers),
        np.concatenate(lengths),
    )


def _row_sizes(rows: _PlyRows, element: _Element, number: int) -> list[int]:
    """Lengths of the lists of the next row, 0 of single numbers; it is stepped over."""
    sizes = []
    for name, kind, length in element.properties:
        head = rows.take([length or kind], 1)
        if head is None:
            raise _cut(element, number)
        size = float(head[0][0]) if length else 0.0
        if not (size >= 0 and size == int(size)):
            raise FormatError(f"{name} of {element.name} {number + 1} has the length {size:g}")
        if rows.take([kind] * int(size), 1) is None:
            raise _cut(element, number)
        sizes.append(int(size))
    return sizes


def _cut(element: _Element, rows: int) -> FormatError:
    return FormatError(
        f"the header says {element.count} rows of {element.name}, the file holds {rows}; it is cut"
    )


# OBJ


def read_obj(data: bytes) -> Polygons:
    """Polygons of an OBJ file; colours, normals, materials, groups and lines are left aside.

    A negative index counts back from the vertices that stand before its line.

    Raises:
        FormatError: the file is cut, or a face refers to a vertex that is not there.
    """
    points, corners, sizes, lines = array("d"), array("q"), array("q"), array("q")
    text = data.lstrip(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    rest = b""
    for number, whole in enumerate(text.split(b"\n"), 1):
        line = rest + whole.split(b"#", 1)[0].rstrip()
        rest = b""
        if line.endswith(b"\\"):
            rest = line[:-1] + b" "
            continue
        words = line.split()
        if not words or words[0] not in (b"v", b"f", b"fo"):
            continue
        if len(words) < 4:
            kind = "vertex" if words[0] == b"v" else "face"
            raise FormatError(
                f"line {number}: a {kind} of {len(words) - 1}, at least 3 are needed; "
                "the file is cut or damaged"
            )
        if words[0] == b"v":
            try:
                points.extend((float(words[1]), float(words[2]), float(words[3])))
            except ValueError:
                to_floats(words[1:4], f"line {number}")
            continue
        before = len(points) // 3
        for word in words[1:]:
            try:
                index = int(word.split(b"/", 1)[0])
            except ValueError:
                raise FormatError(
                    f"line {number}: {printable(word)} is no corner of a face; allowed: numbers "
                    "of vertices, such as 7, -1 or 7/2/5"
                ) from None
            # Counted from 1, or back from the last vertex so far.
            place = index - 1 if index > 0 else before + index
            if index == 0 or place < 0:
                raise FormatError(
                    f"line {number}: a face refers to vertex {index}, {before} stand before it"
                )
            corners.append(place)
        sizes.append(len(words) - 1)
        lines.append(number)
    if rest.strip():
        raise FormatError("the file ends within a line that is continued; it is cut")
    count = len(points) // 3
    counts, indices = np.array(sizes, np.int64), np.array(corners, np.int64)
    if len(indices) and indices.max() >= count:
        first = int(np.argmax(indices >= count))
        at = lines[int(np.searchsorted(np.cumsum(counts), first, side="right"))]
        raise FormatError(
            f"line {at}: a face refers to vertex {indices[first] + 1}, the file has {count}"
        )
    return Polygons(np.array(points).reshape(-1, 3), indices, counts)
