"""A reader of MAT files of version 5 to 7 that no damaged file can crash.

`scipy.io.loadmat` trusts the tags in the file: one flipped bit can end the whole process with a
segmentation fault (18 of the 640 bytes of a small file have such a bit). This reader checks every
size and type before it uses them. The tests compare its results with scipy's.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.serialisation.sizes import Budget

HEADER = 128
"""Bytes before the first variable."""
INT32, UINT32, MATRIX, COMPRESSED = 5, 6, 14, 15
CELL, STRUCT, OBJECT, CHAR, OPAQUE = 1, 2, 3, 4, 17
COMPLEX = 0x0800
STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
"""How numbers are stored, by the type in a tag."""
TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
"""How texts are stored, by the type in a tag."""
NUMBERS = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"
}  # fmt: skip
"""The type of the numbers of an array, by its class in MATLAB."""


BYTES_PER_LETTER = 8
"""The largest size of a letter in memory, as a text and in an array of texts."""
BYTES_PER_OBJECT = 256
"""The size in memory of a cell, a field or a text, with what refers to it."""


class Damaged(ValueError):
    """The file violates the format."""


class NewerMat(ValueError):
    """The file is of version 7.3, which is HDF5."""


@dataclass(frozen=True)
class Opaque:
    """Something that only MATLAB can decode, such as a `timeseries` object."""

    kind: str


def read_mat5(data: bytes, budget: Budget, names: Collection[str] | None = None) -> dict[str, Any]:
    """The variables in the bytes of a MAT file (only those in `names`).

    What the file declares counts in `budget` before it is allocated.

    Returns
    -------
    dict of str to value
        Numbers become arrays of their MATLAB type, texts arrays of str (one per row), cells object
        arrays, a struct a dict (an array of structs an object array), and anything else an
        `Opaque`.

    Raises
    ------
    NewerMat
        The file is of version 7.3.
    Damaged, ValueError, struct.error, zlib.error
        The file violates the format.
    InputError
        The variables are larger than the budget.

    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:HEADER])
    if data[:4] == b"\x89HDF" or (order and struct.unpack(f"{order}H", data[124:126])[0] >= 0x200):
        raise NewerMat
    if order is None:
        raise Damaged("no header of a MAT file")
    variables: dict[str, Any] = {}
    for kind, payload in _elements(memoryview(data)[HEADER:], order):
        if kind == COMPRESSED:
            inner = list(_elements(memoryview(_inflated(payload, order, budget)), order))
            if len(inner) != 1:
                raise Damaged("a compressed element that is not one variable")
            kind, payload = inner[0]
        if kind != MATRIX:
            raise Damaged(f"an element of type {kind} among the variables")
        name, value = _Matrix(payload, order, budget).read(names)
        if name in variables:
            raise Damaged(f"the variable {name} comes twice")
        if name and (names is None or name in names):  # MATLAB's own storage has no name
            variables[name] = value
    return variables


def _inflated(payload: memoryview, order: str, budget: Budget) -> bytes:
    """The one element in a compressed element, whose size is in its first bytes."""
    stream = zlib.decompressobj()
    tag = stream.decompress(payload, 8)
    if len(tag) < 8:
        raise Damaged("a compressed element that is cut off")
    # Of a small element there is no more; of others the size is the tag's second number.
    kind, size = struct.unpack(f"{order}II", tag)
    rest = 0 if kind >> 16 else size
    budget.take(rest)
    data = tag + (stream.decompress(stream.unconsumed_tail, rest) if rest else b"")
    if stream.decompress(stream.unconsumed_tail, 1) or not stream.eof:
        raise Damaged("a compressed element of another size than it declares")
    return data


def _elements(buffer: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and content of each element in `buffer`."""
    at = 0
    while at < len(buffer):
        if at + 8 > len(buffer):
            raise Damaged("an element that is cut off")
        kind, size = struct.unpack_from(f"{order}II", buffer, at)
        if kind >> 16:  # up to four bytes may share the tag's place
            kind, size, start, step = kind & 0xFFFF, kind >> 16, at + 4, 8
            if size > 4:
                raise Damaged("a small element that is not small")
        else:
            start, step = at + 8, 8 + (size if kind == COMPRESSED else -(-size // 8) * 8)
        if start + size > len(buffer):
            raise Damaged("an element that is cut off")
        yield kind, buffer[start : start + size]
        at += step


class _Matrix:
    """One array of any class: a walk through the elements that it consists of."""

    def __init__(self, payload: memoryview, order: str, budget: Budget) -> None:
        self._size = len(payload)
        self._budget = budget
        self._order = order
        self._parts = _elements(payload, order)

    def read(self, names: Collection[str] | None = None) -> tuple[str, Any]:
        """Name and value; the value of a variable that is not in `names` is None."""
        if not self._size:
            return "", np.zeros((0, 0))
        flags = self._numbers(UINT32)
        if len(flags) != 2:
            raise Damaged("array flags of a wrong size")
        kind = int(flags[0]) & 0xFF
        if kind == OPAQUE:
            name = self._text()
            self._text()  # the object system, MCOS or java
            return name, Opaque(self._text())
        sizes = [int(size) for size in self._numbers(INT32)]
        if len(sizes) < 2 or min(sizes) < 0:
            raise Damaged(f"an array of shape {sizes}")
        name = self._text()
        if names is not None and name not in names:
            return name, None
        if kind in NUMBERS:
            value: Any = self._table(kind, sizes, bool(int(flags[0]) & COMPLEX))
        elif kind == CHAR:
            value = self._rows(sizes)
        elif kind == CELL:
            value = self._children(math.prod(sizes)).reshape(sizes, order="F")
        elif kind == STRUCT:
            value = self._structs(sizes)
        else:
            value = Opaque({OBJECT: "object", 5: "sparse", 16: "function"}.get(kind, f"{kind}"))
        return name, value

    def _next(self) -> tuple[int, memoryview]:
        part = next(self._parts, None)
        if part is None:
            raise Damaged("an array that is cut off")
        return part

    def _numbers(self, wanted: int | None = None) -> NDArray:
        kind, payload = self._next()
        if kind not in STORED or wanted not in (None, kind):
            raise Damaged(f"an element of type {kind} in place of numbers")
        return np.frombuffer(payload, self._order + STORED[kind])

    def _text(self) -> str:
        kind, payload = self._next()
        if kind not in TEXTS:
            raise Damaged(f"an element of type {kind} in place of a text")
        wide = TEXTS[kind].startswith(("utf-16", "utf-32"))
        codec = TEXTS[kind] + ({"<": "-le", ">": "-be"}[self._order] if wide else "")
        self._budget.take(BYTES_PER_LETTER * len(payload))
        return bytes(payload).decode(codec)

    def _table(self, kind: int, sizes: list[int], is_complex: bool) -> NDArray:
        parts = [self._numbers() for _ in range(1 + is_complex)]
        if any(len(part) != math.prod(sizes) for part in parts):
            raise Damaged(f"{len(parts[0])} numbers for an array of shape {sizes}")
        # MATLAB stores whole numbers in as few bytes as they need, whatever their class.
        size = np.dtype(NUMBERS[kind]).itemsize * math.prod(sizes)
        self._budget.take(size + is_complex * 4 * size)
        table = parts[0].astype(NUMBERS[kind])
        return (table + 1j * parts[1] if is_complex else table).reshape(sizes, order="F")

    def _rows(self, sizes: list[int]) -> NDArray:
        # An empty text may come without its element.
        text = self._text() if math.prod(sizes) else ""
        rows = math.prod(sizes[:-1])
        self._budget.take(BYTES_PER_OBJECT * rows if text else 0)
        if rows == 1 and text:
            return np.array([text])
        if len(text) != math.prod(sizes):
            raise Damaged(f"{len(text)} letters for texts of shape {sizes}")
        return np.array([text[row::rows] for row in range(rows)] if text else [], dtype=np.str_)

    def _children(self, count: int) -> NDArray:
        if 8 * count > self._size:  # an array takes 8 bytes at least
            raise Damaged(f"{count} parts in {self._size} bytes")
        self._budget.take(BYTES_PER_OBJECT * count)
        made = np.empty(count, dtype=object)
        for i in range(count):
            kind, payload = self._next()
            if kind != MATRIX:
                raise Damaged(f"an element of type {kind} in place of an array")
            made[i] = _Matrix(payload, self._order, self._budget).read()[1]
        return made

    def _structs(self, sizes: list[int]) -> Any:
        width = self._numbers(INT32)
        kind, payload = self._next()
        if len(width) != 1 or width[0] < 1 or kind not in TEXTS:
            raise Damaged("a struct without field names")
        letters, step = bytes(payload), int(width[0])
        fields = [
            letters[i : i + step].split(b"\0")[0].decode() for i in range(0, len(letters), step)
        ]
        count, size = math.prod(sizes), len(fields)
        self._budget.take(BYTES_PER_OBJECT * count)
        values = self._children(count * size)
        made = np.empty(count, dtype=object)
        for i in range(count):
            made[i] = dict(zip(fields, values[i * size : (i + 1) * size], strict=True))
        return made[0] if count == 1 else made.reshape(sizes, order="F")
