"""Recordings on disk as one ``.npz`` without pickle.

This file knows bytes and arrays only; `Demonstrations` gives them their meaning.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from torch_ebip.common.files import atomic_write
from torch_ebip.recordings.archives import ARRAYS, open_archive, read_array
from torch_ebip.recordings.layout import Layout, Modality

Array = npt.NDArray[Any]
_REQUIRED = ("values", "lengths", "rate", "dofs", "modality", "unit", "controlled")
_OPTIONAL = {"dof_kind": "U", "dof_centre": "f"}
"""Of recordings that have angles: the kind of each DoF, and its centre, rad, NaN if it has none."""
LIMIT = 1 << 34
"""Bytes that a recording may have, unless a caller says something else; no larger one is written."""
DENSE = 1 << 28
"""Bytes that any archive may unpack to, however small it is."""
SHRUNK = 32
"""How many times an archive may unpack to its own size beyond that: larger recordings that shrink more are stored as
they are, so that a few kilobytes never ask for gigabytes."""
LONGEST_NAME = 1000
"""Characters of the name of a column."""
MOST = 100_000
"""Demonstrations, and DoFs: each is an object of its own, which costs more than its bytes."""


class Recordings(NamedTuple):
    """What a file holds: layout, one of the trajectories [T_i, D] a demonstration, rate in Hz, extra columns [N], and
    what was wrong with it, in sentences."""

    layout: Layout
    trajectories: list[Array]
    rate: float
    columns: dict[str, Array]
    remarks: tuple[str, ...] = ()


def write_npz(path: str | os.PathLike[str], recordings: Recordings) -> None:
    """Write recordings to one compressed ``.npz`` at a path, which `read_npz` reads; atomic, never pickled.

    Raises:
        ValueError: more than `LIMIT` or `MOST`; a column that holds Python objects, has the name of a part of the
            format, or one that is not printable.
    """
    layout = recordings.layout
    arrays: dict[str, Array] = {
        "values": _as_saved(np.concatenate(recordings.trajectories)),
        "lengths": np.array([len(trajectory) for trajectory in recordings.trajectories], dtype=np.int64),
        "rate": np.float64(recordings.rate),  # type: ignore[dict-item]
        "dofs": np.array(layout.dofs),
        "modality": np.array([modality.name for modality in layout.modalities for _ in modality.dofs]),
        "unit": np.array(layout.units),
        "controlled": layout.controlled.numpy(),
    }
    if any(modality.kind != "plain" for modality in layout.modalities):
        arrays["dof_kind"] = np.array([modality.kind for modality in layout.modalities for _ in modality.dofs])
        centres = [m.centre or [np.nan] * len(m.dofs) for m in layout.modalities]
        arrays["dof_centre"] = np.array([angle for centre in centres for angle in centre], dtype=np.float64)
    for name, column in recordings.columns.items():
        if name in arrays or name in (*_OPTIONAL, "file"):
            raise ValueError(f"column {name!r} has the name of a part of the format; rename it")
        if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= LONGEST_NAME:
            raise ValueError(f"column {str(name)[:80]!r}: names must be printable, of 1 to {LONGEST_NAME} characters")
        if column.dtype.kind not in ARRAYS:
            raise ValueError(f"column {name!r} holds Python objects; only numbers and strings can be saved")
        arrays[name] = column
    if max(len(recordings.trajectories), layout.n_dofs) > MOST:
        raise ValueError(
            f"{len(recordings.trajectories)} demonstrations of {layout.n_dofs} DoFs, expected at most {MOST} of each"
        )
    size = sum(array.nbytes + 256 for array in arrays.values())
    if size > LIMIT:
        raise ValueError(f"{size} bytes of recordings, at most {LIMIT}: write them to several files")
    with atomic_write(path) as file:
        _write_arrays(file, arrays, zipfile.ZIP_DEFLATED)
        if size > max(DENSE, SHRUNK * file.tell()):
            file.seek(0)
            file.truncate()
            _write_arrays(file, arrays, zipfile.ZIP_STORED)


def _as_saved(values: Array) -> Array:
    """In double precision if it came so, otherwise in single."""
    return values.astype(np.float64 if values.dtype == np.float64 else np.float32, copy=False)


def _write_arrays(file: IO[bytes], arrays: Mapping[str, Array], method: int) -> None:
    """What numpy's `savez` writes, but for names that are arguments of its own."""
    with zipfile.ZipFile(file, "w", method, allowZip64=True) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                # Nothing is pickled: columns of objects were refused.
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)


def read_npz(path: str | os.PathLike[str], limit: int = LIMIT) -> Recordings:
    """Read what `write_npz` wrote (format: design, section 4).

    Args:
        path: of the file.
        limit: bytes of its arrays, unpacked; more is refused before it is unpacked. So are more than `DENSE` in an
            archive that shrank them to less than 1 / `SHRUNK`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is cut off, is not a ``.npz``, is too large, holds pickled objects, lacks an array, or
            its arrays contradict each other.
    """
    arrays: dict[str, Array] = {}
    with open_archive(path, limit, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)) as (file, archive):
        size, packed = sum(member.file_size for member in archive.infolist()), file.seek(0, os.SEEK_END)
        if size > max(DENSE, SHRUNK * packed):
            raise ValueError(f"{path}: {packed} bytes that unpack to {size}: no recording shrinks like that")
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if name == member.filename:
                raise ValueError(f"{path}: {name[:80]!r} is no array; expected a .npz of recordings")
            try:
                arrays[name] = read_array(archive, member)
            except Exception as error:  # zipfile, zlib, struct, ast and numpy raise their own types on damaged bytes
                raise ValueError(
                    f"{path}: not a readable .npz of recordings (cut off, damaged or pickled): {str(error)[:200]}"
                ) from error
    missing = [name for name in _REQUIRED if name not in arrays]
    if missing:
        raise ValueError(f"{path}: lacks {', '.join(missing)}; expected {', '.join(_REQUIRED)}")
    try:
        return _from_arrays(arrays)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _from_arrays(arrays: Mapping[str, Array]) -> Recordings:
    values, lengths, rate = arrays["values"], arrays["lengths"], arrays["rate"]
    if values.ndim != 2 or values.dtype.kind != "f" or values.dtype.itemsize > 8:
        raise ValueError(f"values must be floats [sum T, D] of at most 64 bits, got {values.dtype} {values.shape}")
    if lengths.ndim != 1 or lengths.dtype.kind not in "iu" or (lengths < 1).any():
        raise ValueError(f"lengths must be counts [N] of samples, got {lengths.dtype} {lengths.shape}")
    if (lengths > len(values)).any() or sum(lengths.tolist()) != len(values):  # numpy's own sum wraps around
        total = sum(lengths.tolist())
        raise ValueError(f"lengths add up to {total}, but values has {len(values)} rows")
    if rate.ndim != 0 or rate.dtype.kind not in "fiu":
        raise ValueError(f"rate must be one number in Hz, got {rate.dtype} {rate.shape}")
    if max(len(lengths), values.shape[1]) > MOST:
        raise ValueError(f"{len(lengths)} demonstrations of {values.shape[1]} DoFs, expected at most {MOST} of each")
    optional = {name: kind for name, kind in _OPTIONAL.items() if name in arrays}
    for name, kind in {"dofs": "U", "modality": "U", "unit": "U", "controlled": "b", **optional}.items():
        if arrays[name].shape != (values.shape[1],):
            raise ValueError(f"{name} has shape {arrays[name].shape}, expected ({values.shape[1]},), one entry a DoF")
        if arrays[name].dtype.kind != kind:
            raise ValueError(f"{name} must hold {_WORDS[kind]}, got {arrays[name].dtype}")
    columns = {name: array for name, array in arrays.items() if name not in (*_REQUIRED, *_OPTIONAL)}
    for name, column in columns.items():
        if column.shape[:1] != lengths.shape:
            raise ValueError(
                f"column {name!r} has shape {column.shape}, expected one row for each of "
                f"{len(lengths)} demonstrations"
            )
    # What torch has: no other byte order, and half precision is none to compute in.
    values = values.astype(np.float64 if values.dtype.itemsize == 8 else np.float32, copy=False)
    trajectories = np.split(values, np.cumsum(lengths)[:-1]) if len(lengths) else []
    return Recordings(_layout(arrays), list(trajectories), float(rate), columns)


_WORDS = {"U": "strings", "b": "booleans", "f": "numbers"}


def _kind_of(name: str, columns: list[int], arrays: Mapping[str, Array]) -> tuple[str, list[float] | None]:
    """Of a modality, by its columns, and the centre of its angles."""
    if "dof_kind" not in arrays:
        return "plain", None
    kinds = {arrays["dof_kind"].tolist()[i] for i in columns}
    if len(kinds) != 1:
        raise ValueError(f"modality {name!r} must be of one kind, got {sorted(kinds)}")
    kind = kinds.pop()
    centre = [float(arrays["dof_centre"][i]) for i in columns] if "dof_centre" in arrays else [np.nan]
    return kind, centre if kind == "angle" and all(map(np.isfinite, centre)) else None


def _layout(arrays: Mapping[str, Array]) -> Layout:
    places: dict[str, list[int]] = {}
    for i, name in enumerate(arrays["modality"].tolist()):
        places.setdefault(name, []).append(i)
    dofs, unit, controlled = (arrays[name].tolist() for name in ("dofs", "unit", "controlled"))
    modalities = []
    for name, columns in places.items():
        if columns != list(range(columns[0], columns[-1] + 1)):
            raise ValueError(f"the columns of modality {name!r} are not side by side: {columns[:10]}")
        units = {unit[i] for i in columns}
        controllers = {controlled[i] for i in columns}
        if len(units) != 1 or len(controllers) != 1:
            raise ValueError(
                f"modality {name!r} must have one unit and one controller, got units "
                f"{sorted(units)}, controlled {sorted(controllers)}"
            )
        kind, centre = _kind_of(name, columns, arrays)
        modalities.append(Modality(name, [dofs[i] for i in columns], units.pop(), controllers.pop(), kind, centre))
    return Layout(modalities)
