"""Zip archives from strangers, as ``.npz`` and checkpoints are: looked through before anything is unpacked."""

from __future__ import annotations

import math
import os
import struct
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from torch_ebip.common.files import open_file

DIRECTORY_LIMIT = 1 << 22
"""Bytes of an archive's list of members: some ten thousands of them."""
_END, _END64, _LOCATOR, _FIRST = b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07", b"PK\x03\x04"
ARRAYS = "biufcUSmM"
"""Kinds of arrays that are read: numbers, strings and times."""


@contextmanager
def open_archive(
    path: str | os.PathLike[str], limit: int, methods: Collection[int]
) -> Iterator[tuple[IO[bytes], zipfile.ZipFile]]:
    """Open a zip archive that is one from its first byte to its last; the file itself, and its members.

    Args:
        path: of the archive.
        limit: bytes of all its members together, as its directory declares them; no more is ever unpacked.
        methods: of compression that are allowed.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not such an archive, or more than the limit in it. Damage to a member shows only when it is
            read, as any exception.
    """
    with open_file(path, limit + DIRECTORY_LIMIT) as file:
        _check_ends(path, file)
        try:
            archive = zipfile.ZipFile(file)
        except Exception as error:  # zipfile and struct raise their own types on damaged bytes
            raise ValueError(f"{path}: a damaged zip archive: {error}") from error
        with archive:
            members = archive.infolist()
            names = [member.filename for member in members]
            if len(set(names)) != len(names):
                raise ValueError(f"{path}: two members of one name in the archive")
            if any(member.compress_type not in methods or member.flag_bits & 1 for member in members):
                raise ValueError(f"{path}: members that are encrypted or compressed in a way that is not used here")
            size = sum(member.file_size for member in members)
            if size > limit:
                raise ValueError(f"{path}: {size} bytes unpacked, expected at most {limit}")
            yield file, archive


def _check_ends(path: str | os.PathLike[str], file: IO[bytes]) -> None:
    """Neither garbage around the archive, in which different readers see different archives, nor a huge directory.

    `zipfile` reads the directory at once, whatever its size.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - 98))
    tail = file.read(98)
    file.seek(0)
    if file.read(4) != _FIRST or tail[-22:-18] != _END or tail[-2:] != b"\0\0":
        raise ValueError(f"{path}: not a zip archive, or one that is cut off")
    length, start = struct.unpack("<II", tail[-10:-2])
    end = size - 22
    if tail[-42:-38] == _LOCATOR:  # the same in 64 bits: a record, and where it is
        end = size - 98
        (place,) = struct.unpack("<Q", tail[-34:-26])
        if tail[:4] != _END64 or place != end:
            raise ValueError(f"{path}: a zip archive with a damaged end")
        length, start = struct.unpack("<QQ", tail[40:56])
    if start + length != end:
        raise ValueError(f"{path}: a zip archive with a damaged end, or with something before it")
    if length > DIRECTORY_LIMIT:
        raise ValueError(f"{path}: {length} bytes of names of members, expected at most {DIRECTORY_LIMIT}")
    file.seek(0)


def read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray[Any]:
    """An array of numbers, strings or times; nothing is allocated before its header agrees with its size.

    Args:
        archive: as `open_archive` opened it.
        member: of it, an array [...] in numpy's format.

    Raises:
        ValueError: another kind of array, or a header that says something else than what follows.
        Exception: whatever `zipfile` and `zlib` raise on damaged bytes.
    """
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
        elif version == (2, 0):
            shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
        else:
            raise ValueError(f"{member.filename}: format {version} of arrays, expected (1, 0) or (2, 0)")
        if dtype.hasobject:
            raise ValueError(f"{member.filename}: pickled objects")
        if dtype.kind not in ARRAYS or dtype.itemsize == 0:
            raise ValueError(f"{member.filename}: neither numbers nor strings but {dtype}")
        expected = stream.tell() + math.prod(shape) * dtype.itemsize
        if min(shape, default=0) < 0 or expected != member.file_size:
            raise ValueError(
                f"{member.filename}: {member.file_size} bytes, expected {expected} for {shape} of {dtype}"
            )
        stream.seek(0)
        array = np.lib.format.read_array(stream, allow_pickle=False)
        stream.read(1)  # at the end, the sum is checked
    if dtype.kind == "U" and array.size:
        array = array.astype(dtype.newbyteorder("="))
        if np.ascontiguousarray(array).reshape(-1).view(np.uint32).max() > 0x10FFFF:
            raise ValueError(f"{member.filename}: characters that do not exist")
    return array
