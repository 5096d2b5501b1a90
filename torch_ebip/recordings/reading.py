"""Recordings of any format that is known, by what a path is."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch_ebip.recordings.bags import is_bag, read_bags
from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.frames import read_csv
from torch_ebip.recordings.hdf5 import read_hdf5
from torch_ebip.recordings.lerobot import read_lerobot
from torch_ebip.recordings.mapping import field_map

MAPPING = "mapping.toml"
"""In a folder, or beside a file, where nobody says another."""


def read(
    path: str | os.PathLike[str], mapping: str | os.PathLike[str] | Mapping[str, Any] | None = None
) -> Demonstrations:
    """Read recordings: ``.npz``, a folder of CSV files beside a ``layout.toml``, one ``.csv`` of many interactions, a
    LeRobot data set, an HDF5 file (``.hdf5``, ``.h5``), a ROS bag, or a folder of bags, one an interaction.

    Args:
        path: of the file or folder.
        mapping: which of its fields is what, see `mapping.field_map`; default: ``mapping.toml`` in the folder, or
            beside the file. ``.npz`` and folders of CSV files need none.

    Raises:
        FileNotFoundError: no such file or folder, or no mapping where one is needed.
        ImportError: a library for it is not installed: ``pip install 'torch-ebip[recordings]'``, ``[bags]``.
        ValueError: a format that is not known; a file that does not say what is expected; names it.

    Example:
        >>> from torch_ebip.recordings import read
        >>> read("nothing.npz")
        Traceback (most recent call last):
        FileNotFoundError: nothing.npz: no such file or folder
    """
    place = Path(path)
    if not os.path.lexists(place):
        raise FileNotFoundError(f"{place}: no such file or folder")
    bags = is_bag(place) or (place.is_dir() and any(is_bag(each) for each in place.iterdir()))
    if place.is_dir() and not bags and not (place / "meta" / "info.json").exists():
        return Demonstrations.load_folder(place)
    if place.suffix == ".npz":
        return Demonstrations.load(place)
    readers = {".csv": read_csv, ".hdf5": read_hdf5, ".h5": read_hdf5}
    reader = read_bags if bags else read_lerobot if place.is_dir() else readers.get(place.suffix.lower())
    if reader is None:
        known = ".npz, .csv, .hdf5, .h5, .bag, .mcap, .db3"
        raise ValueError(f"{place}: {place.suffix or 'no suffix'} is no format that is known: {known}")
    if mapping is None:
        mapping = (place if place.is_dir() else place.parent) / MAPPING
        if not mapping.exists():
            raise FileNotFoundError(f"{mapping}: no mapping says which fields of {place.name} are what")
    return reader(place, field_map(mapping))
