"""Files: opened only if they are what they should be, written so that a reader never sees half of one."""

from __future__ import annotations

import io
import json
import math
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

LARGEST_JSON = 1 << 28
"""Bytes."""


def open_file(path: str | os.PathLike[str], limit: int | None) -> IO[bytes]:
    """Open a regular file, or a link to one, for reading bytes. Never waits, as opening a FIFO otherwise does.

    Args:
        path: of the file.
        limit: bytes; a larger file is refused; None for what is read piece by piece.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a folder, FIFO or device, a loop of links, a file that may not be read or is too large.
    """
    try:
        # The flags do not exist on every system; a file that is only a file does not need them.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)
        file = io.BufferedReader(io.FileIO(path, opener=lambda path, _: os.open(path, flags)))  # refuses folders
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise ValueError(f"{path}: cannot be opened: {error}") from error
    status = os.fstat(file.fileno())
    if stat.S_ISREG(status.st_mode) and 0 < status.st_size <= (status.st_size if limit is None else limit):
        return file
    file.close()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"{path}: expected a regular file, got a device or a pipe")
    if status.st_size > 0:
        raise ValueError(f"{path}: {status.st_size} bytes, expected at most {limit}")
    # Files of /proc say that they are empty and are not, or are waited for: they are taken at their word.
    return io.BytesIO()


def read_text(path: str | os.PathLike[str], limit: int) -> str:
    """The text of a UTF-8 file of at most so many bytes.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: see `open_file`; or it is not UTF-8.
    """
    with open_file(path, limit) as file:
        try:
            return file.read(limit).decode("utf-8")
        except (OSError, ValueError) as error:
            raise ValueError(f"{path}: not readable as text in UTF-8: {error}") from error


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """Open a binary file that appears under ``path`` only once it is complete and on the disk.

    The bytes go to a temporary file in the same folder (created if missing), which replaces ``path`` when
    the block ends without an exception and is removed when it does not. A process that is killed meanwhile leaves
    that file, ``.NAME.*.part``, and ``path`` as it was.

    Raises:
        OSError: the folder cannot be created or written; ``path`` itself is left as it was.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    try:
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(temporary)):
            error.filename = str(target)  # a full disk does not say which file it refused
        raise


def read_json(path: str | os.PathLike[str]) -> Any:
    """What `write_json` wrote at a path.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no JSON, or cannot be read.
    """
    text = read_text(path, LARGEST_JSON)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not what a run writes, or damaged: {error}") from error


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Write content as JSON to a path, atomically; numbers that are not finite become null."""
    with atomic_write(path) as file:
        file.write((json.dumps(finite(content), indent=1, allow_nan=False) + "\n").encode())


def finite(content: Any) -> Any:
    """Content that JSON can say: dictionaries, lists and plain values, None where a number is not finite."""
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
