"""A line that says what a tuple of tensors is, instead of all its numbers."""

from __future__ import annotations

from typing import Any

from torch import Tensor

FEW = 4
"""So many numbers are shown as they are."""


def brief(thing: Any) -> str:
    """For the ``__repr__`` of a NamedTuple: sizes and types of its tensors, the rest as it is, on one line."""
    fields = (f"{name}={_said(getattr(thing, name))}" for name in thing._fields)
    return f"{type(thing).__name__}({', '.join(fields)})"


def _said(value: Any) -> str:
    if isinstance(value, Tensor):
        if value.numel() <= FEW:
            return str(value.tolist())
        return f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}"
    if isinstance(value, list) and len(value) > FEW:
        return f"{len(value)} of them"
    text = repr(value)
    return text if "\n" not in text and len(text) <= 100 else f"{type(value).__name__}(...)"
