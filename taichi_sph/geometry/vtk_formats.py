"""Readers of PolyData in VTK's XML (.vtp) and legacy (.vtk) files, as VMTK and ParaView write them.

Polygons and triangle strips are read; lines, vertices and all data on points and cells are not.
meshio does not read .vtp, and the vtk package weighs a hundred times what is needed here.
Layouts: VTK's file formats, https://docs.vtk.org/en/latest/vtk_file_formats/
"""

import base64
import binascii
import re
import xml.etree.ElementTree as ET
import zlib

import numpy as np
from numpy.typing import NDArray

from taichi_sph.geometry.mesh import Floats, Integers
from taichi_sph.geometry.surface_formats import (
    PADDING,
    FormatError,
    Polygons,
    printable,
    to_floats,
)

HINT = "extract its surface (in ParaView: Extract Surface) and save it as .vtp"


def _from_strips(corners: Integers, sizes: Integers) -> tuple[Integers, Integers]:
    """Triangles of triangle strips, every second one turned round."""
    triangles = [np.zeros((0, 3), np.int64)]
    for strip in np.split(corners, np.cumsum(sizes)[:-1]):
        rows = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
        rows[1::2] = rows[1::2, [1, 0, 2]]
        triangles.append(rows)
    table = np.concatenate(triangles)
    return table.reshape(-1), np.full(len(table), 3)


def _join(pieces: list[tuple[Floats, list[tuple[Integers, Integers]]]]) -> Polygons:
    """One set of polygons of several pieces' points and cells."""
    points, corners, sizes = [np.zeros((0, 3))], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    before = 0
    for own, cells in pieces:
        for indices, counts in cells:
            if len(indices) and (indices.min() < 0 or indices.max() >= len(own)):
                wrong = indices.min() if indices.min() < 0 else indices.max()
                raise FormatError(f"a polygon refers to point {wrong} of {len(own)}")
            corners.append(indices + before)
            sizes.append(counts)
        points.append(own)
        before += len(own)
    return Polygons(np.concatenate(points), np.concatenate(corners), np.concatenate(sizes))


# Legacy

_LEGACY_TYPES = {
    "char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2",
    "int": "i4", "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8",
    "vtktypeint64": "i8", "vtktypeuint64": "u8", "vtkidtype": "i4",
    "float": "f4", "double": "f8",
}  # fmt: skip


class _Legacy:
    """A legacy file, read from the front: lines, and arrays behind them."""

    def __init__(self, data: bytes):
        self._data = data
        self._at = 0
        self.binary = False

    def line(self) -> bytes | None:
        """The next line with anything on it; None at the end."""
        while self._at < len(self._data):
            end = self._data.find(b"\n", self._at)
            end = len(self._data) if end < 0 else end
            text = self._data[self._at : end].strip(PADDING)
            self._at = end + 1
            if text:
                return text
        return None

    def array(self, kind: str, count: int, what: str) -> NDArray:
        """So many numbers of a type, big-endian in a binary file."""
        if kind.lower() not in _LEGACY_TYPES:
            raise FormatError(f"{what} are of type {kind}, which is not read")
        number = _LEGACY_TYPES[kind.lower()]
        if self.binary:
            table = np.dtype(">" + number)
            held = max(0, len(self._data) - self._at) // table.itemsize
            if count <= held:
                found = np.frombuffer(self._data, table, count, self._at)
                self._at += count * table.itemsize
                return found
        else:
            # A number with its blank takes two bytes at least, so a wrong count costs no memory.
            held = 0
            if count <= len(self._data) - self._at:
                words, self._at = _words(self._data, self._at, count)
                held = len(words)
                if held == count:
                    return to_floats(words, what) if number[0] == "f" else _integers(words, what)
        raise FormatError(
            f"{count} numbers of {what} are announced, the file holds {held}; it is cut"
        )

    def skip_strings(self, count: int) -> None:
        """Step over strings: in a binary file each has its length before it."""
        for _ in range(count):
            if not self.binary:
                self.line()
                continue
            # The two highest bits of the first byte say how many bytes the length has.
            bytes_of = {3: 1, 2: 2, 1: 4, 0: 8}
            size = bytes_of[self._data[self._at] >> 6] if self._at < len(self._data) else 1
            length = int.from_bytes(self._data[self._at : self._at + size], "big")
            self._at += size + (length & ((1 << (8 * size - 2)) - 1))


def _words(data: bytes, start: int, count: int) -> tuple[list[bytes], int]:
    """So many words from a place on, and the place behind them."""
    # Longer than the words may be: 40 bytes hold any number.
    words = data[start : start + 40 * count].split(None, count)
    if len(words) > count:
        rest = len(words[count])
        return words[:count], min(start + 40 * count, len(data)) - rest
    return words, min(start + 40 * count, len(data))


def _integers(words: list[bytes], what: str) -> Integers:
    try:
        return np.array(words, dtype=np.int64)
    except (ValueError, OverflowError):
        numbers = to_floats(words, what)
        if (np.abs(numbers) < 2**53).all() and (numbers == np.floor(numbers)).all():
            return numbers.astype(np.int64)
        raise FormatError(f"{what} are not whole numbers") from None


def read_vtk(data: bytes) -> Polygons:
    """Polygons of a legacy VTK file with PolyData, ASCII or binary, of versions 1 to 5.1.

    Raises:
        FormatError: the file is cut, or holds something else than PolyData.
    """
    file = _Legacy(data)
    first = file.line() or b""
    version = re.match(rb"# vtk DataFile Version (\d+)\.(\d+)", first, re.IGNORECASE)
    if version is None:
        raise FormatError("it does not begin with '# vtk DataFile Version', so it is no .vtk file")
    head = data.replace(b"\r\n", b"\n").split(b"\n", 3)
    mode = head[2].strip().upper() if len(head) > 3 else b""
    if mode not in (b"ASCII", b"BINARY"):
        raise FormatError(f"its third line is {printable(head[2] if len(head) > 2 else b'')}; "
                          "allowed: ASCII, BINARY")  # fmt: skip
    file = _Legacy(data.replace(b"\r\n", b"\n") if mode == b"ASCII" else data)
    file.binary = mode == b"BINARY"
    # The second line is a title, which may be blank.
    file._at = _after_lines(file._data, 3)
    split_cells = (int(version[1]), int(version[2])) >= (5, 0)
    points: Floats | None = None
    cells: list[tuple[Integers, Integers]] = []
    while (line := file.line()) is not None:
        words = line.decode("utf-8", "replace").split()
        key = words[0].upper()
        try:
            if key == "DATASET":
                if words[1].upper() != "POLYDATA":
                    raise FormatError(f"it holds {words[1]}, no PolyData; {HINT}")
            elif key == "POINTS":
                points = file.array(words[2], 3 * int(words[1]), "POINTS").reshape(-1, 3)
            elif key in ("POLYGONS", "TRIANGLE_STRIPS", "LINES", "VERTICES"):
                found = _legacy_cells(file, key, int(words[1]), int(words[2]), split_cells)
                if key == "TRIANGLE_STRIPS":
                    cells.append(_from_strips(*found))
                elif key == "POLYGONS":
                    cells.append(found)
            elif key == "FIELD":
                _skip_field(file, int(words[2]))
            elif key == "METADATA":
                _skip_metadata(file)
            elif key in ("POINT_DATA", "CELL_DATA"):
                break
            else:
                raise FormatError(f"{printable(line)} is no part of PolyData; the file is damaged")
        except (IndexError, ValueError) as error:
            if isinstance(error, FormatError):
                raise
            raise FormatError(f"the line {printable(line)} is not whole") from None
    if points is None:
        raise FormatError("it has no POINTS; the file is cut or is no PolyData")
    return _join([(points.astype(np.float64), cells)])


def _after_lines(data: bytes, count: int) -> int:
    at = 0
    for _ in range(count):
        at = data.index(b"\n", at) + 1
    return at


def _legacy_cells(
    file: _Legacy, key: str, first: int, second: int, split: bool
) -> tuple[Integers, Integers]:
    """Corners and sizes of one kind of cell."""
    if first < 0 or second < 0:
        raise FormatError(f"{key} has a negative count")
    if split:
        # From version 5 on: offsets, one more than cells, and then the corners of all.
        parts = []
        for name, count in (("OFFSETS", first), ("CONNECTIVITY", second)):
            words = (file.line() or b"").decode("utf-8", "replace").split()
            if not words or words[0].upper() != name:
                raise FormatError(f"{name} of {key} is not there; the file is cut or damaged")
            parts.append(file.array(words[1], count, f"{name} of {key}").astype(np.int64))
        return parts[1], _sizes(parts[0], len(parts[1]), key)
    flat = file.array("int", second, key).astype(np.int64)
    sizes = np.zeros(first, np.int64)
    at = 0
    if first and second % first == 0 and (flat[:: second // first] == second // first - 1).all():
        sizes[:] = second // first - 1
        return flat.reshape(first, -1)[:, 1:].reshape(-1), sizes
    keep = np.ones(second, bool)
    for k in range(first):
        if at >= second or flat[at] < 0:
            raise FormatError(f"{key} holds fewer cells than its {first}; the file is damaged")
        sizes[k] = flat[at]
        keep[at] = False
        at += 1 + int(flat[at])
    if at != second:
        raise FormatError(f"{key} holds {at} numbers, {second} are announced; it is damaged")
    return flat[keep], sizes


def _sizes(offsets: Integers, total: int, what: str) -> Integers:
    """Lengths of cells whose corners begin at offsets, the first at 0, the last end at `total`."""
    sizes = np.diff(offsets)
    if len(offsets) and (offsets[0] != 0 or offsets[-1] != total or (sizes < 0).any()):
        raise FormatError(f"offsets of {what} do not fit its {total} corners; the file is damaged")
    return sizes


def _skip_field(file: _Legacy, count: int) -> None:
    for _ in range(count):
        words = (file.line() or b"").decode("utf-8", "replace").split()
        if words[:1] == ["METADATA"]:
            _skip_metadata(file)
            words = (file.line() or b"").decode("utf-8", "replace").split()
        amount = int(words[1]) * int(words[2])
        if words[3].lower() == "string":
            file.skip_strings(amount)
        elif words[3].lower() == "bit" and file.binary:
            file.array("unsigned_char", (amount + 7) // 8, words[0])
        else:
            file.array("int" if words[3].lower() == "bit" else words[3], amount, words[0])


def _skip_metadata(file: _Legacy) -> None:
    """Step over names and information of an array, which a blank line ends."""
    while file._at < len(file._data):
        end = file._data.find(b"\n", file._at)
        end = len(file._data) if end < 0 else end
        blank = not file._data[file._at : end].strip()
        file._at = end + 1
        if blank:
            return


# XML

_XML_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4",
    "Int64": "i8", "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}  # fmt: skip


def read_vtp(data: bytes) -> Polygons:
    """Polygons of an XML PolyData file: ASCII, binary or appended, zlib or lzma, of any pieces.

    Raises:
        FormatError: the file is cut, or holds something else than PolyData.
    """
    head, appended = data, b""
    at = data.find(b"<AppendedData")
    if at >= 0:
        # Raw numbers are no XML: what is behind the underscore is set aside.
        start = data.find(b"_", data.find(b">", at)) + 1
        head, appended = data[:at] + b"</VTKFile>", data[start:] if start else b""
    try:
        root = ET.fromstring(head.strip(PADDING))
    except ET.ParseError as error:
        raise FormatError(f"it is not whole XML ({error}); the file is cut or damaged") from None
    kind = root.get("type", "")
    if root.tag != "VTKFile" or kind != "PolyData":
        held = f"a {kind}" if root.tag == "VTKFile" else f"an XML file of {root.tag[:40]}"
        raise FormatError(f"it holds {held}, no PolyData; {HINT}")
    raw = b'encoding="raw"' in data[at : data.find(b">", at)] if at >= 0 else False
    arrays = _Arrays(root, appended, raw)
    pieces = []
    for piece in root.iter("Piece"):
        count = _count(piece, "NumberOfPoints")
        coordinates = piece.find("Points/DataArray")
        points = np.zeros((0, 3))
        if count and coordinates is None:
            raise FormatError("a piece has no Points; the file is damaged")
        if coordinates is not None and count:
            points = arrays.read(coordinates, 3 * count, "Points").reshape(-1, 3)
        cells = []
        for name in ("Polys", "Strips"):
            amount = _count(piece, f"NumberOf{name}")
            if amount == 0:
                continue
            parts = {a.get("Name", ""): a for a in piece.findall(f"{name}/DataArray")}
            if not {"connectivity", "offsets"} <= set(parts):
                raise FormatError(f"its {name} lack connectivity or offsets; the file is damaged")
            ends = arrays.read(parts["offsets"], amount, f"offsets of {name}").astype(np.int64)
            total = int(ends[-1])
            corners = arrays.read(parts["connectivity"], total, f"connectivity of {name}")
            found = corners.astype(np.int64), _sizes(np.r_[0, ends], total, name)
            cells.append(_from_strips(*found) if name == "Strips" else found)
        pieces.append((points.astype(np.float64), cells))
    return _join(pieces)


def _count(piece: ET.Element, name: str) -> int:
    text = piece.get(name, "0")
    if not text.strip().isdigit():
        raise FormatError(f"{name} is {printable(text.encode())}; allowed: whole numbers")
    return int(text)


class _Arrays:
    """The arrays of an XML file, decoded one at a time."""

    def __init__(self, root: ET.Element, appended: bytes, raw: bool):
        self._order = ">" if root.get("byte_order", "LittleEndian") == "BigEndian" else "<"
        header = root.get("header_type", "UInt32")
        if header not in ("UInt32", "UInt64"):
            raise FormatError(f"header_type is {printable(header.encode())}")
        self._header = np.dtype(self._order + _XML_TYPES[header])
        compressor = root.get("compressor", "")
        known = {"": None, "vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}
        if compressor not in known:
            raise FormatError(
                f"it is compressed by {compressor[:40]}; allowed: no compression, zlib, lzma"
            )
        self._compressor = known[compressor]
        self._appended, self._raw = appended, raw

    def read(self, element: ET.Element, count: int, what: str) -> NDArray:
        """So many numbers of a DataArray.

        Raises:
            FormatError: it holds fewer, or cannot be decoded.
        """
        kind, form = element.get("type", ""), element.get("format", "ascii")
        if kind not in _XML_TYPES:
            raise FormatError(f"{what} is of type {printable(kind.encode())}")
        text = "".join([element.text or "", *(child.tail or "" for child in element)])
        if form == "ascii":
            words = text.encode().split()
            if len(words) == count:
                whole = _XML_TYPES[kind][0] != "f"
                return _integers(words, what) if whole else to_floats(words, what)
            raise _short(what, count, len(words))
        if form == "appended":
            offset = element.get("offset", "")
            if not offset.isdigit() or int(offset) >= len(self._appended):
                raise FormatError(f"{what} lies beyond the end of the file; it is cut")
            source = self._appended[int(offset) :]
        elif form == "binary":
            source = re.sub(rb"\s+", b"", text.encode("ascii", "replace"))
        else:
            raise FormatError(f"{what} has the format {printable(form.encode())}")
        numbers = self._decode(source, form == "appended" and self._raw, what)
        table = np.dtype(self._order + _XML_TYPES[kind])
        held = len(numbers) // table.itemsize
        if held != count:
            raise _short(what, count, held)
        return np.frombuffer(numbers, table, count)

    def _decode(self, source: bytes, raw: bool, what: str) -> bytes:
        """Bytes of an array: a header of lengths, then the bytes, in blocks if compressed."""
        size = self._header.itemsize
        if self._compressor is None:
            head, after = _take(source, 0, size, raw, what)
            length = int(np.frombuffer(head, self._header)[0])
            if not raw and source[after - 1 : after] != b"=":
                # Lengths and bytes are one text where the first do not end in padding.
                return _take(source, 0, size + length, raw, what)[0][size:]
            return _take(source, after, length, raw, what)[0]
        head, _ = _take(source, 0, 3 * size, raw, what)
        blocks = int(np.frombuffer(head, self._header)[0])
        if blocks > len(source):
            raise FormatError(f"{what} has {blocks} blocks; the file is damaged")
        head, after = _take(source, 0, (3 + blocks) * size, raw, what)
        lengths = np.frombuffer(head, self._header)[3:].astype(np.int64)
        packed, _ = _take(source, after, int(lengths.sum()), raw, what)
        parts, at = [], 0
        for length in lengths.tolist():
            parts.append(self._unpack(packed[at : at + length], what))
            at += length
        return b"".join(parts)

    def _unpack(self, block: bytes, what: str) -> bytes:
        try:
            if self._compressor == "zlib":
                return zlib.decompress(block)
            import lzma

            return lzma.decompress(block)
        except ImportError:
            raise FormatError("it is compressed by lzma, which this Python lacks") from None
        except Exception as error:
            raise FormatError(f"{what} cannot be unpacked ({error}); it is damaged") from None


def _take(source: bytes, at: int, length: int, raw: bool, what: str) -> tuple[bytes, int]:
    """So many bytes from a place on, of base64 unless raw, and the place behind them."""
    after = at + (length if raw else 4 * ((length + 2) // 3))
    if after > len(source):
        raise FormatError(f"{what} goes on beyond the end of the file; it is cut")
    part = source[at:after]
    if raw:
        return part, after
    try:
        return base64.b64decode(part, validate=True)[:length], after
    except binascii.Error as error:
        raise FormatError(f"{what} is not base64 ({error}); the file is damaged") from None


def _short(what: str, count: int, held: int) -> FormatError:
    return FormatError(
        f"{what} should have {count} numbers, the file holds {held}; it is cut or damaged"
    )
