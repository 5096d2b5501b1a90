"""Recordings on disk: one ``.npz`` without pickle, or a folder of CSV files with a description.

This file knows bytes and arrays only; `Demonstrations` gives them their meaning.
"""

from __future__ import annotations

import csv
import json
import os
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from torch_ebip.files import atomic_write
from torch_ebip.layout import Layout, Modality

if sys.version_info >= (3, 11):
    import tomllib
else:  # pragma: no cover
    import tomli as tomllib

Array = npt.NDArray[Any]
_REQUIRED = ("values", "lengths", "rate", "dofs", "modality", "unit", "controlled")


class Recordings(NamedTuple):
    """What a file holds: layout, one of the trajectories [T_i, D] a demonstration, rate in Hz, extra columns [N]."""

    layout: Layout
    trajectories: list[Array]
    rate: float
    columns: dict[str, Array]


def write_npz(path: str | os.PathLike[str], recordings: Recordings) -> None:
    """Write recordings to one compressed ``.npz`` at a path; atomic, never pickled."""
    layout = recordings.layout
    arrays: dict[str, Array] = {
        "values": np.concatenate(recordings.trajectories).astype(np.float32),
        "lengths": np.array([len(trajectory) for trajectory in recordings.trajectories], dtype=np.int64),
        "rate": np.float64(recordings.rate),  # type: ignore[dict-item]
        "dofs": np.array(layout.dofs),
        "modality": np.array([modality.name for modality in layout.modalities for _ in modality.dofs]),
        "unit": np.array(layout.units),
        "controlled": layout.controlled.numpy(),
    }
    for name, column in recordings.columns.items():
        if name in arrays or name == "file":
            raise ValueError(f"column {name!r} has the name of a part of the format; rename it")
        if column.dtype.hasobject:
            raise ValueError(f"column {name!r} holds Python objects; only numbers and strings can be saved")
        arrays[name] = column
    # Nothing is pickled: columns of objects were refused above.
    with atomic_write(path) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_npz(path: str | os.PathLike[str]) -> Recordings:
    """Read what `write_npz` wrote (format: design, section 4).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is cut off, is not a ``.npz``, holds pickled objects, lacks an array, or its
            arrays contradict each other.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise
    except (ValueError, EOFError, OSError, zipfile.BadZipFile, KeyError, NotImplementedError) as error:
        raise ValueError(
            f"{path}: not a readable .npz of recordings (cut off, damaged or pickled): {error}"
        ) from error
    except Exception as error:  # zlib and struct raise their own types on damaged bytes
        raise ValueError(f"{path}: damaged: {error}") from error
    missing = [name for name in _REQUIRED if name not in arrays]
    if missing:
        raise ValueError(f"{path}: lacks {', '.join(missing)}; expected {', '.join(_REQUIRED)}")
    return _from_arrays(path, arrays)


def _from_arrays(path: str | os.PathLike[str], arrays: Mapping[str, Array]) -> Recordings:
    values, lengths, rate = arrays["values"], arrays["lengths"], arrays["rate"]
    if values.ndim != 2 or values.dtype.kind != "f":
        raise ValueError(f"{path}: values must be floats [sum T, D], got {values.dtype} {values.shape}")
    if lengths.ndim != 1 or lengths.dtype.kind not in "iu" or (lengths < 0).any():
        raise ValueError(f"{path}: lengths must be counts [N], got {lengths.dtype} {lengths.shape}")
    if int(lengths.sum()) != len(values):
        raise ValueError(f"{path}: lengths add up to {int(lengths.sum())}, but values has {len(values)} rows")
    if rate.ndim != 0 or rate.dtype.kind not in "fiu":
        raise ValueError(f"{path}: rate must be one number in Hz, got {rate.dtype} {rate.shape}")
    for name in ("dofs", "modality", "unit", "controlled"):
        if arrays[name].shape != (values.shape[1],):
            raise ValueError(
                f"{path}: {name} has shape {arrays[name].shape}, expected ({values.shape[1]},), one entry a DoF"
            )
    columns = {name: array for name, array in arrays.items() if name not in _REQUIRED}
    for name, column in columns.items():
        if column.shape[:1] != lengths.shape:
            raise ValueError(
                f"{path}: column {name!r} has shape {column.shape}, expected one row for each of "
                f"{len(lengths)} demonstrations"
            )
    trajectories = np.split(values, np.cumsum(lengths)[:-1]) if len(lengths) else []
    try:
        layout = _layout(arrays)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return Recordings(layout, list(trajectories), float(rate), columns)


def _layout(arrays: Mapping[str, Array]) -> Layout:
    modality = [str(name) for name in arrays["modality"]]
    modalities = []
    for name in dict.fromkeys(modality):
        columns = [i for i, other in enumerate(modality) if other == name]
        if columns != list(range(columns[0], columns[-1] + 1)):
            raise ValueError(f"the columns of modality {name!r} are not side by side: {columns}")
        units = {str(arrays["unit"][i]) for i in columns}
        controlled = {bool(arrays["controlled"][i]) for i in columns}
        if len(units) != 1 or len(controlled) != 1:
            raise ValueError(
                f"modality {name!r} must have one unit and one controller, got units "
                f"{sorted(units)}, controlled {sorted(controlled)}"
            )
        dofs = [str(arrays["dofs"][i]) for i in columns]
        modalities.append(Modality(name, dofs, units.pop(), controlled.pop()))
    return Layout(modalities)


def read_folder(path: str | os.PathLike[str]) -> Recordings:
    """Read a folder of CSV files, one a demonstration, described by ``layout.toml`` or ``layout.json``.

    The description gives ``rate`` (Hz) and a list ``modalities`` of tables with ``name``, ``dofs``, ``unit``
    and optionally ``controlled``; each CSV file has a header with at least those DoFs (other columns are
    ignored) and a row a sample; an empty cell or ``nan`` was not measured. Files are taken in the order of
    their names, which are kept as the column ``demo_id``.

    Raises:
        FileNotFoundError: no folder, no description, or no CSV file in it.
        ValueError: a description or a file that does not say what is expected; names file, line, column.
    """
    folder = Path(path)
    rate, layout = _read_description(folder)
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise FileNotFoundError(f"{folder}: no .csv files in this folder")
    trajectories = [_read_csv(file, layout) for file in files]
    return Recordings(layout, trajectories, rate, {"demo_id": np.array([file.stem for file in files])})


def _read_description(folder: Path) -> tuple[float, Layout]:
    toml, js = folder / "layout.toml", folder / "layout.json"
    if not toml.exists() and not js.exists():
        raise FileNotFoundError(f"{folder}: neither layout.toml nor layout.json")
    source = toml if toml.exists() else js
    text = source.read_text(encoding="utf-8")
    try:
        description = tomllib.loads(text) if source is toml else json.loads(text)
        rate = float(description["rate"])
        modalities = [
            Modality(entry["name"], entry["dofs"], entry["unit"], entry.get("controlled", False))
            for entry in description["modalities"]
        ]
    except KeyError as error:
        raise ValueError(f"{source}: lacks {error}") from error
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{source}: {error}") from error
    return rate, Layout(modalities)


def _read_csv(file: Path, layout: Layout) -> Array:
    with file.open(newline="", encoding="utf-8") as stream:
        rows = csv.reader(stream)
        header = [cell.strip() for cell in next(rows, [])]
        missing = [dof for dof in layout.dofs if dof not in header]
        if missing:
            raise ValueError(f"{file}: the header lacks {', '.join(missing)}")
        picked = [header.index(dof) for dof in layout.dofs]
        samples = []
        for row in rows:
            if len(row) != len(header):
                raise ValueError(f"{file}:{rows.line_num}: {len(row)} cells, the header has {len(header)}")
            samples.append([_number(row[i], file, rows.line_num, header[i]) for i in picked])
    return np.array(samples, dtype=np.float32).reshape(len(samples), layout.n_dofs)


def _number(cell: str, file: Path, line: int, column: str) -> float:
    try:
        return float(cell) if cell.strip() else float("nan")
    except ValueError:
        raise ValueError(f"{file}:{line}: column {column!r}: {cell!r} is not a number") from None
