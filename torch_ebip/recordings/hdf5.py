"""HDF5 files as robomimic lays them out: a group an episode, a data set a stream."""

from __future__ import annotations

import json
import os
import re
from typing import Any

import numpy as np

from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.mapping import FieldMap, Source

HINT = "HDF5 files need h5py: pip install 'torch-ebip[recordings]'"
DATA_LIMIT = 1 << 33
"""Bytes of all data sets that are read."""


def read_hdf5(path: str | os.PathLike[str], mapping: FieldMap) -> Demonstrations:
    """The episodes of a file: groups under ``data``, or at the top, in the order of their numbers.

    Args:
        path: of the file.
        mapping: ``source`` is a data set within an episode, [T, ...], such as ``"obs/eef_pos"``, ``fields`` places in
            a row. ``time`` names one of times, s; without it rows are ``rate`` apart, by default robomimic's
            ``control_freq``. ``label`` names an attribute of the episode.

    Raises:
        ImportError: h5py is not installed.
        FileNotFoundError: there is no such file.
        ValueError: no HDF5 file, one that is cut off; a data set or an attribute that is not there.
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError(HINT) from error
    if not os.path.lexists(path):
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            return _read(file, mapping, str(path), h5py)
    except OSError as error:
        raise ValueError(f"{path}: no HDF5 file, or cut off: {str(error)[:200]}") from error


def _read(file: Any, mapping: FieldMap, where: str, h5py: Any) -> Demonstrations:
    top = file["data"] if isinstance(file.get("data"), h5py.Group) else file
    names = sorted((name for name in top if isinstance(top.get(name), h5py.Group)), key=_by_number)
    if not names:
        raise ValueError(f"{where}: no groups of episodes")
    rate = mapping.rate or _control_rate(top)
    room, interactions, labels = DATA_LIMIT, [], []
    for name in names:
        said = f"{where}, {name}"
        streams = {}
        for source in mapping.sources:
            values, size = _values(top[name], source, said, h5py)
            room -= size
            if room < 0:
                raise ValueError(f"{said}: more than {DATA_LIMIT} bytes in this file")
            if len(values) < 2:
                raise ValueError(f"{said}: {len(values)} samples of {source.source}, at least 2 are needed")
            if mapping.time is not None:
                times = _set(top[name], mapping.time, said, h5py)[()]
            elif rate is not None:
                times = np.arange(len(values)) / rate
            else:
                raise ValueError(f"{where}: nothing says how fast: the mapping has neither `time` nor `rate`")
            streams[source.modality.name] = times, values
        interactions.append(streams)
        if mapping.label is not None:
            if mapping.label not in top[name].attrs:
                raise ValueError(f"{said}: no attribute {mapping.label!r}")
            label = top[name].attrs[mapping.label]
            labels.append(label.decode() if isinstance(label, bytes) else str(label))
    try:
        return Demonstrations.from_streams(
            mapping.layout, interactions, rate if mapping.time is None else mapping.rate, mapping.max_gap,
            how=mapping.how, span=mapping.span, columns={"demo_id": np.array(names)}, labels=labels or None,
        )  # fmt: skip
    except ValueError as error:
        raise ValueError(f"{where}: {error} (interaction 0 is {names[0]})") from error


def _by_number(name: str) -> list[Any]:
    """demo_2 before demo_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _set(group: Any, name: str, where: str, h5py: Any) -> Any:
    """A data set of numbers."""
    found = group.get(name)
    if not isinstance(found, h5py.Dataset):
        there: list[str] = []
        group.visititems(lambda key, item: there.append(key) if isinstance(item, h5py.Dataset) else None)
        raise ValueError(f"{where}: no data set {name!r}; there are {', '.join(there[:12])}")
    if found.dtype.kind not in "fiu" or found.ndim < 1:
        raise ValueError(f"{where}: {name} holds no numbers, but {found.dtype} {found.shape}")
    return found


def _values(group: Any, source: Source, where: str, h5py: Any) -> tuple[Any, int]:
    """[T, d] of a modality, and how many bytes were read for it."""
    if not source.source:
        raise ValueError(f"{where}: {source.modality.name} needs a `source`, the name of a data set")
    found = _set(group, source.source, where, h5py)
    width = int(np.prod(found.shape[1:], dtype=np.int64))
    for field in source.fields:
        if not isinstance(field, int) or not 0 <= field < width:
            raise ValueError(f"{where}: a row of {source.source} has {width} numbers, no field {field!r}")
    size = found.size * found.dtype.itemsize
    if size > DATA_LIMIT:
        raise ValueError(f"{where}: {source.source} has {size} bytes, expected at most {DATA_LIMIT}")
    return found[()].reshape(len(found), width)[:, list(source.fields)], size


def _control_rate(top: Any) -> float | None:
    """robomimic's, of the attribute ``env_args``."""
    try:
        return float(json.loads(top.attrs["env_args"])["env_kwargs"]["control_freq"])
    except (KeyError, TypeError, ValueError, RecursionError):
        return None
