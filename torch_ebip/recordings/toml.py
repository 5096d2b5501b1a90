"""Descriptions in TOML or JSON, read with care: of folders of CSV files, and of what is where in other files."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path
from typing import Any

from torch_ebip.common.files import read_text
from torch_ebip.recordings.layout import Modality

LIMIT = 1 << 20
"""Bytes of a description."""
# Time and memory of Python's reader grow with the square of the parts of a dotted key.
_DOTTED = re.compile(r"""(?:\.[ \t]*(?:[\w-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')[ \t]*){16}""")


def read_description(path: str | os.PathLike[str]) -> Any:
    """What a ``.toml`` or ``.json`` file says.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it cannot be read; names the file.
    """
    text = read_text(path, LIMIT).removeprefix("\ufeff")
    try:
        if Path(path).suffix == ".json":
            return json.loads(text)
        if _DOTTED.search(text):
            raise ValueError("a key of more than 16 parts")
        return _parse_toml(text)
    except (ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from error


def _parse_toml(text: str) -> Any:
    """Imported here: before Python 3.11 it is a library of its own, which a robot does without."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:  # pragma: no cover
        import tomli as tomllib
    return tomllib.loads(text)


def modality_of(table: Any) -> Modality:
    """A modality of a table with ``name``, ``dofs``, ``unit``, and ``controlled`` and ``kind`` if they are there."""
    dofs = entry(table, "dofs", list)
    if not all(isinstance(dof, str) for dof in dofs):
        raise ValueError("dofs must be a list of names")
    controlled = entry(table, "controlled", bool) if "controlled" in table else False
    kind = entry(table, "kind", str) if "kind" in table else "plain"
    return Modality(entry(table, "name", str), dofs, entry(table, "unit", str), controlled, kind)


def entry(table: Any, name: str, *kinds: type) -> Any:
    """An entry of a table, of exactly these types: a boolean is no number. KeyError if it is not there."""
    if not isinstance(table, dict):
        raise ValueError(f"expected a table with {name!r}, got {str(table)[:80]}")
    if type(table[name]) not in kinds:
        raise ValueError(f"{name} must be of type {kinds[0].__name__}, got {str(table[name])[:80]!r}")
    return table[name]


def number(table: Any, name: str) -> float | None:
    """A number of a table; None if it is not there."""
    return float(entry(table, name, float, int)) if name in table else None
