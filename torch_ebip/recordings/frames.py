"""Recordings in tables of columns, one row a sample: data frames, and one CSV file of many interactions."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from torch_ebip.common.files import open_file
from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.folders import CSV_LIMIT
from torch_ebip.recordings.mapping import FieldMap, Source, field_map
from torch_ebip.recordings.resampling import Array

HINT = "tables of columns need pandas: pip install 'torch-ebip[recordings]'"
Rows = dict[str, Any]
"""Columns by name, [T] or [T, d] each."""


def from_frame(frame: Any, mapping: str | os.PathLike[str] | Mapping[str, Any]) -> Demonstrations:
    """Demonstrations of a data frame, a row a sample.

    Args:
        frame: with a column for each field of the mapping, its ``time`` (s; without one rows are ``rate`` apart), its
            ``episode`` (without one all of it is one interaction) and its ``label``.
        mapping: see `mapping.field_map`.

    Raises:
        ValueError: a column that is not there, or holds no numbers; an interaction of one sample; see
            `Demonstrations.from_streams`.

    Example:
        >>> import pandas
        >>> frame = pandas.DataFrame({"take": [1, 1, 2, 2], "x": [0.0, 1.0, 0.0, 2.0], "q": [0.0, 0.5, 0.0, 0.4]})
        >>> hand = {"name": "hand", "dofs": ["x"], "unit": "m"}
        >>> arm = {"name": "arm", "dofs": ["q"], "unit": "rad", "controlled": True}
        >>> from_frame(frame, {"rate": 10, "episode": "take", "modalities": [hand, arm]})
        Demonstrations(2 of 2 to 2 samples at 10 Hz, 2 DoFs: hand, arm)
    """
    found = field_map(mapping)
    columns = {str(name): frame[name].to_numpy() for name in frame.columns}
    return of_rows(columns, found, "the frame")


def to_frame(demonstrations: Demonstrations) -> Any:
    """A pandas frame: columns ``episode``, ``time`` (s from the beginning of each), one a DoF, and ``label``.

    Args:
        demonstrations: N of them.

    Raises:
        ImportError: pandas is not installed.
    """
    try:
        import pandas
    except ImportError as error:
        raise ImportError(HINT) from error
    lengths = demonstrations.lengths.numpy()
    columns: Rows = {
        "episode": np.repeat(np.arange(len(lengths)), lengths),
        "time": np.concatenate([np.arange(length) / demonstrations.rate for length in lengths]),
    }
    values = np.concatenate([trajectory.cpu().numpy() for trajectory in demonstrations])
    columns |= {dof: values[:, i] for i, dof in enumerate(demonstrations.layout.dofs)}
    if demonstrations.labels is not None:
        columns["label"] = np.repeat(np.array(demonstrations.labels), lengths)
    return pandas.DataFrame(columns)


def read_csv(path: str | os.PathLike[str], mapping: FieldMap, limit: int = CSV_LIMIT) -> Demonstrations:
    """One CSV file of many interactions; delimiters and byte order marks are found by pandas.

    Args:
        path: of the file.
        mapping: with ``episode``, and so on.
        limit: its bytes at most.

    Raises:
        ImportError: pandas is not installed.
        ValueError: see `from_frame`; a file that is too large, or no table.
    """
    try:
        import pandas
    except ImportError as error:
        raise ImportError(HINT) from error
    with open_file(path, limit) as stream:
        try:
            frame = pandas.read_csv(stream, sep=None, engine="python", encoding="utf-8-sig", skipinitialspace=True)
        except (ValueError, pandas.errors.ParserError) as error:
            raise ValueError(f"{path}: no table: {str(error)[:200]}") from error
    return of_rows({str(name).strip(): frame[name].to_numpy() for name in frame.columns}, mapping, str(path))


def of_rows(columns: Rows, mapping: FieldMap, where: str) -> Demonstrations:
    """Demonstrations of columns.

    Args:
        columns: [T] each, or [T, d] of lists of numbers.
        mapping: which of them are what.
        where: they are from, for errors.

    Raises:
        ValueError: see `from_frame`.
    """
    interactions, names, labels = [], [], []
    for name, rows in _episodes(columns, mapping, where):
        said = f"{where}, episode {name}"
        count = int(rows.sum())
        if count < 2:
            raise ValueError(f"{said}: {count} sample, at least 2 are needed")
        times = _times(columns, rows, mapping, said)
        interactions.append({s.modality.name: (times, _values(columns, rows, s, said)) for s in mapping.sources})
        names.append(str(name))
        if mapping.label is not None:
            labels.append(str(_column(columns, mapping.label, said)[rows][0]))
    try:
        return Demonstrations.from_streams(
            mapping.layout, interactions, mapping.rate, mapping.max_gap, how=mapping.how, span=mapping.span,
            columns={"demo_id": np.array(names)}, labels=labels or None,
        )  # fmt: skip
    except ValueError as error:
        raise ValueError(f"{where}: {error} (interaction 0 is episode {names[0]})") from error


def _episodes(columns: Rows, mapping: FieldMap, where: str) -> Iterator[tuple[Any, Any]]:
    """Name and rows, bool [T], of each interaction, in the order in which they come."""
    if mapping.episode is None:
        yield 0, np.ones(len(next(iter(columns.values()), [])), dtype=np.bool_)
        return
    which = _column(columns, mapping.episode, where)
    names, first = np.unique(which.astype(str), return_index=True)
    for name in names[np.argsort(first)]:
        yield name, which.astype(str) == name


def _column(columns: Rows, name: str, where: str) -> Any:
    if name not in columns:
        raise ValueError(f"{where}: no column {name!r}; there are {', '.join(sorted(columns)[:12])}")
    return columns[name]


def _times(columns: Rows, rows: Any, mapping: FieldMap, where: str) -> Array:
    if mapping.time is not None:
        times: Array = _numbers(_column(columns, mapping.time, where)[rows], mapping.time, where)
        return times
    if mapping.rate is None:
        raise ValueError(f"{where}: the mapping has neither a column of `time` nor a `rate`")
    return np.arange(int(rows.sum())) / mapping.rate


def _values(columns: Rows, rows: Any, source: Source, where: str) -> Array:
    """[T, d] of a modality."""
    if not source.source:
        return np.stack([_numbers(_column(columns, str(f), where)[rows], str(f), where) for f in source.fields], -1)
    column = [np.asarray(row) for row in _column(columns, source.source, where)[rows]]
    if len({row.shape for row in column}) > 1:
        raise ValueError(f"{where}: rows of {source.source} hold different numbers of numbers")
    lists: Array = _numbers(np.stack(column), source.source, where).reshape(len(column), -1)
    for field in source.fields:
        if not isinstance(field, int) or not 0 <= field < lists.shape[1]:
            raise ValueError(f"{where}: {source.source} has {lists.shape[1]} numbers, no field {field!r}")
    found: Array = lists[:, [int(field) for field in source.fields]]
    return found


def _numbers(values: Any, name: str, where: str) -> Any:
    """In their own precision; of other kinds in double precision."""
    found = np.asarray(values)
    if found.dtype.kind == "f":
        return found
    try:
        return found.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: column {name!r} holds no numbers: {error}") from error
