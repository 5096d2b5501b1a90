"""Checkpoints: written atomically, read with weights only, tied to the configuration they belong to."""

from __future__ import annotations

import os
import pickle
from collections.abc import Mapping
from typing import Any

import torch

from torch_ebip.files import atomic_write

FORMAT = 1


def save_checkpoint(
    path: str | os.PathLike[str], configuration: Mapping[str, Any], content: Mapping[str, Any]
) -> None:
    """Write tensors, numbers, strings and containers of them under ``path``, atomically.

    Args:
        path: of the file.
        configuration: what the content only makes sense with; `load_checkpoint` compares it.
        content: the rest.
    """
    with atomic_write(path) as file:
        torch.save({"format": FORMAT, "configuration": dict(configuration), "content": dict(content)}, file)


def load_checkpoint(path: str | os.PathLike[str], configuration: Mapping[str, Any]) -> dict[str, Any]:
    """Read the content of a checkpoint; executes nothing of it.

    Args:
        path: of the file.
        configuration: of this run; what the checkpoint was written with must be equal to it.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the file is cut off or not a checkpoint, or it was written with another configuration;
            names what differs.
    """
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
        version, theirs, content = stored["format"], dict(stored["configuration"]), dict(stored["content"])
    except FileNotFoundError:
        raise
    except (
        pickle.UnpicklingError,
        RuntimeError,
        EOFError,
        KeyError,
        IndexError,
        TypeError,
        ValueError,
        OSError,
    ) as error:
        raise ValueError(
            f"{path}: not a readable checkpoint (cut off, damaged or of another kind): {error}"
        ) from error
    if version != FORMAT:
        raise ValueError(f"{path}: checkpoint format {version}, this version reads {FORMAT}")
    ours = dict(configuration)
    differing = [
        f"{name}: {theirs.get(name)!r} there, {ours.get(name)!r} here"
        for name in sorted({*theirs, *ours})
        if theirs.get(name) != ours.get(name)
    ]
    if differing:
        raise ValueError(f"{path}: checkpoint of another configuration: {'; '.join(differing)}")
    return content
