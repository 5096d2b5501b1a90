"""What a package exports: what it imports from its own files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def exported(names: Mapping[str, Any]) -> list[str]:
    """Names of the classes and functions of torch_ebip among the globals of a package, sorted.

    So that a new part is one line of export; a type checker sees ``from x import Part as Part``.
    """
    return sorted(
        name
        for name, thing in names.items()
        if name[0] != "_" and name != "exported" and getattr(thing, "__module__", "").startswith("torch_ebip.")
    )
