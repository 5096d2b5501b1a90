"""One CSV file as people have them: a header, a row a sample, and whatever their program writes between cells.

Commas, semicolons, tabs and bars are told apart by the header; where it is not a comma, a comma in a number is its
decimal point, as Excel writes them in half of Europe. A byte order mark and empty lines at the end are passed over.
"""

from __future__ import annotations

import csv
import io
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from torch_ebip.recordings.resampling import Array

LONGEST_ROW = 1 << 24
"""Characters of a row: a million columns."""
DELIMITERS = ",;\t|"
"""That are looked for in a header, the first of those that find the most columns."""


class Table(NamedTuple):
    """What a file says.

    Attributes:
        values: [T, D], NaN where a cell was empty.
        times: [T], in the file's unit; None if it has no such column.
    """

    values: Array
    times: Array | None


def read_table(file: Path, stream: IO[bytes], dofs: Sequence[str], time: Sequence[str] = ()) -> Table:
    """The columns of some DoFs.

    Args:
        file: its name, for errors.
        stream: open at its beginning.
        dofs: D names that the header must have; other columns are passed over.
        time: names of which one, if it is no DoF, is the column of times.

    Raises:
        ValueError: names file, line and column.
    """
    lines, wanted = _Lines(stream), set(dofs)
    samples = array("d")
    reader, before, wrong = None, 0, 0
    try:
        first = _header(lines)
        before = max(first.count("\n"), 1)
        delimiter = max(DELIMITERS, key=lambda each: _found(first, each, wanted))
        header = _cells(first, delimiter)
        picked = _places(header, dofs)
        timed = next((header.index(name) for name in time if name in header and name not in wanted), None)
        if timed is not None:
            picked.append(timed)
        point = "." if delimiter == "," else ","
        lines.taken = 0
        reader = csv.reader(lines, delimiter=delimiter)
        for row in reader:
            lines.taken = 0
            if not any(cell.strip() for cell in row) and len(row) != len(header):
                wrong = wrong or before + reader.line_num
                continue
            if wrong:
                raise ValueError("an empty line between samples; a sample without values has its empty cells")
            if len(row) != len(header):
                raise ValueError(f"{len(row)} cells, the header has {len(header)}")
            samples.extend([_number(row[i], header[i], point) for i in picked])
    except (ValueError, OSError, csv.Error) as error:
        line = wrong or (max(before, 1) if reader is None else before + reader.line_num)
        raise ValueError(f"{file}:{line}: {error}") from error
    found = np.frombuffer(samples, dtype=np.float64).reshape(-1, len(picked))
    return Table(found[:, : len(dofs)], None if timed is None else found[:, -1])


def _header(lines: _Lines) -> str:
    """The first row: a quoted cell may hold the end of a line."""
    parts, quotes = [], 0
    for line in lines:
        parts.append(line)
        quotes += line.count('"')
        if quotes % 2 == 0:
            break
    return "".join(parts).removeprefix("\ufeff")


class _Lines:
    """Lines of a text; its reader sets back `taken` after each row, which must not be longer than `LONGEST_ROW`."""

    def __init__(self, stream: IO[bytes]) -> None:
        self.taken = 0
        self._text = io.TextIOWrapper(stream, encoding="utf-8", newline="")

    def __iter__(self) -> Iterator[str]:
        while line := self._text.readline(LONGEST_ROW + 1 - self.taken):
            self.taken += len(line)
            if self.taken > LONGEST_ROW:
                raise ValueError(f"a row of more than {LONGEST_ROW} characters")
            yield line


def _cells(header: str, delimiter: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader(io.StringIO(header, newline=""), delimiter=delimiter), [])]


def _found(header: str, delimiter: str, wanted: set[str]) -> int:
    """How many of the columns that are wanted a delimiter finds."""
    try:
        return len(wanted.intersection(_cells(header, delimiter)))
    except csv.Error:  # a cell that is far too long
        return 0


def _places(header: list[str], dofs: Sequence[str]) -> list[int]:
    """Where in a header the DoFs are."""
    wanted = set(dofs)
    places: dict[str, int] = {}
    for i, name in enumerate(header):
        if name in wanted and places.setdefault(name, i) != i:
            raise ValueError(f"the header names {name!r} more than once")
    missing = [dof for dof in dofs if dof not in places]
    if missing:
        raise ValueError(f"the header lacks {', '.join(name[:80] for name in missing[:10])}")
    return [places[dof] for dof in dofs]


def _number(cell: str, column: str, point: str) -> float:
    """Of a cell in which the decimal point is written so."""
    text = cell.strip() if point == "." or "." in cell else cell.strip().replace(point, ".")
    try:
        return float(text) if text else float("nan")
    except ValueError:
        raise ValueError(f"column {column!r}: {cell[:40]!r} is not a number") from None
