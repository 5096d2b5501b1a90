"""Recordings on disk as a folder of CSV files, one a demonstration, beside a description of their layout."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import sys
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from torch_ebip.common.files import open_file, read_text
from torch_ebip.recordings.arrays import MOST, Array, Recordings
from torch_ebip.recordings.layout import Layout, Modality

DESCRIPTION_LIMIT = 1 << 20
"""Bytes of a description."""
CSV_LIMIT = 1 << 27
"""Bytes of all CSV files together, unless a caller says something else: some twenty seconds of reading."""
LONGEST_ROW = 1 << 24
"""Characters of a row: a million columns."""
# Time and memory of Python's reader grow with the square of the parts of a dotted key.
_DOTTED = re.compile(r"""(?:\.[ \t]*(?:[\w-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')[ \t]*){16}""")


def read_folder(path: str | os.PathLike[str], limit: int = CSV_LIMIT) -> Recordings:
    """Read a folder of CSV files, one a demonstration, described by ``layout.toml`` or ``layout.json``.

    The description gives ``rate`` (Hz) and a list ``modalities`` of tables with ``name``, ``dofs``, ``unit``
    and optionally ``controlled``; each CSV file has a header with at least those DoFs (other columns are
    ignored) and a row a sample; an empty cell or ``nan`` was not measured. Files are taken in the order of
    their names, which are kept as the column ``demo_id``.

    Args:
        path: of the folder.
        limit: bytes of all CSV files together.

    Raises:
        FileNotFoundError: no folder, no description, or no CSV file in it.
        ValueError: a description or a file that does not say what is expected; names file, line, column.
    """
    folder = Path(path)
    rate, layout = _read_description(folder)
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise FileNotFoundError(f"{folder}: no .csv files in this folder")
    if len(files) > MOST:
        raise ValueError(f"{folder}: {len(files)} .csv files, expected at most {MOST}")
    trajectories = []
    for file in files:
        with open_file(file, None) as stream:
            limit -= stream.seek(0, os.SEEK_END)
            if limit < 0:
                size = stream.seek(0, os.SEEK_END)
                raise ValueError(
                    f"{file}: {size} bytes, expected at most {limit + size} more in this folder (see `limit`)"
                )
            stream.seek(0)
            trajectories.append(_read_csv(file, stream, layout))
    return Recordings(layout, trajectories, rate, {"demo_id": np.array([file.stem for file in files])})


def _read_description(folder: Path) -> tuple[float, Layout]:
    toml, js = folder / "layout.toml", folder / "layout.json"
    source = toml if os.path.lexists(toml) else js
    if not os.path.lexists(source):
        raise FileNotFoundError(f"{folder}: neither layout.toml nor layout.json")
    text = read_text(source, DESCRIPTION_LIMIT)
    try:
        if source is toml and _DOTTED.search(text):
            raise ValueError("a key of more than 16 parts")
        description = _parse_toml(text) if source is toml else json.loads(text)
        rate = _entry(description, "rate", float, int)
        modalities = [_modality(entry) for entry in _entry(description, "modalities", list)]
        return float(rate), Layout(modalities)
    except KeyError as error:
        raise ValueError(f"{source}: lacks {error}") from error
    except (ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"{source}: {error}") from error


def _parse_toml(text: str) -> Any:
    """Imported here: before Python 3.11 it is a library of its own, which a robot does without."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:  # pragma: no cover
        import tomli as tomllib
    return tomllib.loads(text)


def _modality(entry: Any) -> Modality:
    dofs = _entry(entry, "dofs", list)
    if not all(isinstance(dof, str) for dof in dofs):
        raise ValueError("dofs must be a list of names")
    controlled = _entry(entry, "controlled", bool) if "controlled" in entry else False
    return Modality(_entry(entry, "name", str), dofs, _entry(entry, "unit", str), controlled)


def _entry(table: Any, name: str, *kinds: type) -> Any:
    """An entry of a table, of exactly these types: a boolean is no number. KeyError if it is not there."""
    if not isinstance(table, dict):
        raise ValueError(f"expected a table with {name!r}, got {str(table)[:80]}")
    if type(table[name]) not in kinds:
        raise ValueError(f"{name} must be of type {kinds[0].__name__}, got {str(table[name])[:80]!r}")
    return table[name]


def _read_csv(file: Path, stream: IO[bytes], layout: Layout) -> Array:
    lines = _Lines(stream)
    rows = csv.reader(lines)
    dofs = layout.dofs
    samples = array("f")
    try:
        header = [cell.strip() for cell in next(rows, [])]
        picked = _places(header, dofs)
        lines.taken = 0
        for row in rows:
            if len(row) != len(header):
                raise ValueError(f"{len(row)} cells, the header has {len(header)}")
            samples.extend([_number(row[i], header[i]) for i in picked])
            lines.taken = 0
    except (ValueError, OSError, csv.Error) as error:
        raise ValueError(f"{file}:{rows.line_num}: {error}") from error
    return np.frombuffer(samples, dtype=np.float32).reshape(-1, len(dofs))


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


def _places(header: list[str], dofs: tuple[str, ...]) -> list[int]:
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


def _number(cell: str, column: str) -> float:
    try:
        return float(cell) if cell.strip() else float("nan")
    except ValueError:
        raise ValueError(f"column {column!r}: {cell[:40]!r} is not a number") from None
