"""A session on disk: one JSON value a line, written as things happen, so that a crash loses the last line at most.

The first line says which session it was; then ``["push", sensor, time, values]``, ``["advance", now]``,
``["forecast", now, horizons, mean]`` and ``["restart", start]`` in the order in which they were taken in. Numbers are
written with all their digits.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import torch

from torch_ebip.common.files import open_file

FORMAT = 2
READABLE = (1, 2)
"""Formats that are understood; the first knew no ``restart``."""
KIND = "torch_ebip session"
LONGEST_LINE = 1 << 24
"""Characters; a longer line is not one of ours."""


class SessionLog:
    """Writes a session. A disk that fails ends the recording, with a warning, and not the session.

    Args:
        path: of a new file.
        header: says which session it is.

    Raises:
        FileExistsError: there is such a file already; nothing is overwritten.
        OSError: it cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], header: Mapping[str, Any]) -> None:
        self.path = Path(path)
        first = json.dumps({"kind": KIND, "format": FORMAT, **header}) + "\n"
        file = self.path.open("x", encoding="utf-8", buffering=1)
        try:
            file.write(first)
            file.flush()
        except OSError as error:
            with suppress(OSError):  # what could not be written cannot be flushed either
                file.close()
            self.path.unlink(missing_ok=True)
            if error.filename is None:
                error.filename = str(self.path)  # a full disk does not say which file it refused
            raise
        self._file: IO[str] | None = file

    @property
    def open(self) -> bool:
        """Whether anything is still written."""
        return self._file is not None

    def write(self, entry: Any) -> None:
        """Append one entry; from the first failure on none."""
        if self._file is None:
            return
        try:
            self._file.write(json.dumps(entry) + "\n")
        except OSError as error:
            warnings.warn(f"{self.path}: the recording ends here: {error}", stacklevel=2)
            self.close()

    def close(self) -> None:
        """End the recording."""
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError as error:
                warnings.warn(f"{self.path}: the last lines may be missing: {error}", stacklevel=2)


def read_log(path: str | os.PathLike[str]) -> tuple[dict[str, Any], Iterator[list[Any]]]:
    """The header, and the entries as they come; the file is read line by line.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read, is no recording of a session, or of another format. Entries raise it at a
            line that is damaged; a last line that is cut off, as a crash leaves it, is left out with a warning.
    """
    lines = _lines(Path(path))
    first = next(lines, None)
    header = None if first is None else first[1]
    if not isinstance(header, dict) or header.get("kind") != KIND:
        raise ValueError(f"{path}: not a recording of a session")
    if header.get("format") not in READABLE:
        readable = " and ".join(map(str, READABLE))
        raise ValueError(f"{path}: session format {header.get('format')}, this version reads {readable}")
    return header, _entries(Path(path), lines)


_KINDS = {"push": 4, "advance": 2, "forecast": 4, "restart": 2}


def _entries(path: Path, lines: Iterator[tuple[int, Any]]) -> Iterator[list[Any]]:
    for number, entry in lines:
        if not isinstance(entry, list) or not entry or _KINDS.get(str(entry[0])) != len(entry):
            raise ValueError(f"{path}:{number}: expected one of {', '.join(_KINDS)}, got {str(entry)[:80]}")
        yield entry


def _lines(path: Path) -> Iterator[tuple[int, Any]]:
    with io.TextIOWrapper(open_file(path, None), encoding="utf-8", errors="replace") as file:
        number = 0
        while line := file.readline(LONGEST_LINE):
            number += 1
            if not line.endswith("\n"):
                if len(line) == LONGEST_LINE:
                    raise ValueError(f"{path}:{number}: longer than any line of a recording")
                warnings.warn(f"{path}:{number}: cut off; this last line is left out", stacklevel=3)
                return
            try:
                value = json.loads(line)
            except (ValueError, RecursionError) as error:
                raise ValueError(f"{path}:{number}: damaged: {error}") from error
            yield number, value


def fingerprint(module: torch.nn.Module) -> str:
    """Sixteen hexadecimal digits that change with any parameter or buffer, or option that the module prints."""
    digest = hashlib.sha256(torch.nn.Module.__repr__(module).encode())
    for name, tensor in sorted({**dict(module.named_parameters()), **dict(module.named_buffers())}.items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
