"""Recordings on disk as a folder of CSV files, one a demonstration, beside a description of their layout."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torch_ebip.common.files import open_file
from torch_ebip.recordings.arrays import MOST, Array, Recordings
from torch_ebip.recordings.layout import Layout
from torch_ebip.recordings.resampling import Array as FloatArray
from torch_ebip.recordings.streams import gridded
from torch_ebip.recordings.tables import Table, read_table
from torch_ebip.recordings.toml import entry, modality_of, read_description
from torch_ebip.recordings.units import in_si

CSV_LIMIT = 1 << 27
"""Bytes of all CSV files together, unless a caller says something else: some twenty seconds of reading."""
TIMES = ("time", "timestamp", "t")
"""Names of a column of times, where the description names none."""


def read_folder(path: str | os.PathLike[str], limit: int = CSV_LIMIT) -> Recordings:
    """Read a folder of CSV files, one a demonstration, described by ``layout.toml`` or ``layout.json``.

    The description gives ``rate`` (Hz) and a list ``modalities`` of tables with ``name``, ``dofs``, ``unit``
    and optionally ``controlled`` and ``kind``; each CSV file has a header with at least those DoFs (other columns are
    ignored) and a row a sample; an empty cell or ``nan`` was not measured. Files are taken in the order of
    their names, which are kept as the column ``demo_id``. Of delimiters, decimal commas and byte order marks see
    `tables`.

    A column ``time``, ``timestamp`` or ``t``, or the one that ``time`` in the description names (``""`` for none),
    says when each row was taken, in ``time_unit`` (``"s"``). Where rows are not as far apart as ``rate`` says, they
    are put onto a grid of ``rate``, with NaN in gaps of more than ``max_gap`` seconds: see
    `Demonstrations.from_streams`. Without ``rate`` it is that of the rows.

    Args:
        path: of the folder.
        limit: bytes of all CSV files together.

    Raises:
        FileNotFoundError: no folder, no description, or no CSV file in it.
        ValueError: a description or a file that does not say what is expected; names file, line, column.
    """
    folder = Path(path)
    description = _read_description(folder)
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise FileNotFoundError(f"{folder}: no .csv files in this folder")
    if len(files) > MOST:
        raise ValueError(f"{folder}: {len(files)} .csv files, expected at most {MOST}")
    tables = []
    for file in files:
        with open_file(file, None) as stream:
            limit -= stream.seek(0, os.SEEK_END)
            if limit < 0:
                size = stream.seek(0, os.SEEK_END)
                raise ValueError(
                    f"{file}: {size} bytes, expected at most {limit + size} more in this folder (see `limit`)"
                )
            stream.seek(0)
            tables.append(read_table(file, stream, description.layout.dofs, description.time))
    names = np.array([file.stem for file in files])
    trajectories, rate, remarks = _evenly(description, files, tables)
    return Recordings(description.layout, trajectories, rate, {"demo_id": names}, remarks)


class Description(NamedTuple):
    """Of the files of a folder.

    Attributes:
        layout: what columns are.
        rate: rows a second, Hz; None: that of their times.
        time: column of the times, if there is one: its name, or several of which one may be there.
        seconds: of a unit of time.
        max_gap: s, see `Demonstrations.from_streams`; None: its default.
    """

    layout: Layout
    rate: float | None
    time: tuple[str, ...]
    seconds: float
    max_gap: float | None


def _evenly(
    description: Description, files: list[Path], tables: list[Table]
) -> tuple[list[Array], float, tuple[str, ...]]:
    """Trajectories [T, D] on one grid, its rate, and what was wrong with times."""
    rate, layout, seconds = description.rate, description.layout, description.seconds
    for file, table in zip(files, tables, strict=True):
        if table.times is None and rate is None:
            raise ValueError(f"{file}: no column of times, and the description has no rate")
        if table.times is not None:
            _in_seconds(file, table.times * seconds, rate)
    if rate is not None and all(_as_they_are(table, rate, seconds) for table in tables):
        return [table.values.astype(np.float32) for table in tables], rate, ()
    streams = []
    for table in tables:
        times = np.arange(len(table.values)) / (rate or 1.0) if table.times is None else table.times * seconds
        streams.append({m.name: (times, table.values[:, layout.slice(m.name)]) for m in layout.modalities})
    try:
        made = gridded(layout, streams, rate, description.max_gap)
    except ValueError as error:
        raise ValueError(
            f"{files[0].parent}: {error} (interactions are files in the order of their names)"
        ) from error
    remarks = made.remarks
    if rate is not None:
        uneven = [
            file.name for file, table in zip(files, tables, strict=True) if not _as_they_are(table, rate, seconds)
        ]
        some = ", ".join(uneven[:3]) + (", ..." if uneven[3:] else "")
        remarks = (
            f"rows of {len(uneven)} of {len(files)} files ({some}) are not {1 / rate:.4g} s apart by their times: "
            f"put onto a grid of {rate:g} Hz",
            *remarks,
        )
    warnings.warn(f"{files[0].parent}: " + "; ".join(remarks), stacklevel=4)
    return [trajectory.astype(np.float32) for trajectory in made.trajectories], made.rate, remarks


def _as_they_are(table: Table, rate: float, seconds: float) -> bool:
    """Whether rows are as far apart as a rate in Hz says, to a tenth of a step each."""
    if table.times is None:
        return True
    place = (table.times - table.times[0]) * seconds * rate
    return bool((np.abs(place - np.arange(len(place))) < 0.1).all())


def _in_seconds(file: Path, times: FloatArray, rate: float | None) -> None:
    """Refuse times that are none, or that seem to be of another unit."""
    if not np.isfinite(times).all():
        raise ValueError(f"{file}: {int((~np.isfinite(times)).sum())} of {len(times)} times are missing or no number")
    if rate is None or len(times) < 2:
        return
    ratio = float(np.median(np.abs(np.diff(times)))) * rate
    for unit, factor in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if factor / 10 < ratio < factor * 10:
            raise ValueError(
                f"{file}: rows are {ratio / rate:.4g} apart by their times, at a rate of {rate:g} Hz: are these "
                f"{unit}? Say time_unit = {unit!r} in the description"
            )


def _read_description(folder: Path) -> Description:
    toml, js = folder / "layout.toml", folder / "layout.json"
    source = toml if os.path.lexists(toml) else js
    if not os.path.lexists(source):
        raise FileNotFoundError(f"{folder}: neither layout.toml nor layout.json")
    description = read_description(source)
    try:
        modalities = [modality_of(table) for table in entry(description, "modalities", list)]
        unit, seconds = in_si(entry(description, "time_unit", str) if "time_unit" in description else "s")
        if unit != "s":
            raise ValueError(f"time_unit must be a unit of time, got {description['time_unit'][:40]!r}")
        named = entry(description, "time", str) if "time" in description else None
        if named is not None and not named:
            time: tuple[str, ...] = ()
        else:
            time = TIMES if named is None else (named,)
        timed = "rate" not in description and (time and "time" in description)
        return Description(
            Layout(modalities),
            None if timed else float(entry(description, "rate", float, int)),
            time,
            seconds,
            float(entry(description, "max_gap", float, int)) if "max_gap" in description else None,
        )
    except KeyError as error:
        raise ValueError(f"{source}: lacks {error}") from error
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{source}: {error}") from error
