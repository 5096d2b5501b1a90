"""A model on disk: one file in the safetensors format, which holds tensors and text and can execute nothing.

Its header's metadata say what it is (``format``, ``version``), describe the model (``description``, JSON), and hold a
sum over all of it (``sha256``), because the format itself has none and a flipped bit would be a weight.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torch_ebip.common.files import atomic_write, finite, open_file

if TYPE_CHECKING:
    from types import ModuleType

KIND = "torch_ebip model"
VERSION = 8
"""Of what is written; every version up to it is read."""
LIMIT = 1 << 33
"""Bytes of a file."""
HEADER_LIMIT = 1 << 24
"""Bytes of its header."""


def write_model_file(
    path: str | os.PathLike[str], description: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> None:
    """Write a model's description, JSON, and its tensors [...] by name to a path, atomically.

    Raises:
        ImportError: safetensors is not installed.
    """
    text = json.dumps(finite(dict(description)), allow_nan=False, sort_keys=True)
    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    metadata = {"format": KIND, "version": str(VERSION), "description": text, "sha256": _sum(VERSION, text, plain)}
    content = _safetensors().save(plain, metadata)
    with atomic_write(path) as file:
        file.write(content)


def read_model_file(path: str | os.PathLike[str], limit: int = LIMIT) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The description and the tensors [...] of a model; executes nothing of it.

    Args:
        path: of the file.
        limit: bytes; more is refused before it is read.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is none of a model, of a later version, cut off or damaged; says which.
        ImportError: safetensors is not installed.
    """
    with open_file(path, limit) as file:
        content = file.read()
    metadata = _metadata(path, content)
    if metadata.get("format") != KIND:
        raise ValueError(f"{path}: not a model of torch_ebip, but tensors of something else")
    version, text = str(metadata.get("version")), str(metadata.get("description"))
    if not version.isdecimal() or not 1 <= int(version[:9]) <= VERSION:
        raise ValueError(
            f"{path}: model format {version[:20]!r}, this torch_ebip reads up to {VERSION}: get a newer one"
        )
    try:
        tensors: dict[str, Tensor] = _safetensors().load(content)
        same = _sum(int(version), text, tensors) == metadata.get("sha256")
    except ImportError:
        raise
    except Exception as error:  # the library raises its own type, and what damaged bytes lead to
        raise ValueError(f"{path}: a model that is cut off or damaged: {str(error)[:200]}") from error
    if not same:
        raise ValueError(f"{path}: a damaged model: what it holds is not what was written")
    try:
        description = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: a model without a description: {str(error)[:200]}") from error
    if not isinstance(description, dict):
        raise ValueError(f"{path}: a model without a description")
    return description, tensors


def _metadata(path: str | os.PathLike[str], content: bytes) -> dict[str, Any]:
    """What the header says beside its tensors."""
    length = struct.unpack("<Q", content[:8])[0] if len(content) >= 8 else 0
    if not 2 <= length <= HEADER_LIMIT or content[8:9] != b"{":
        raise ValueError(f"{path}: not a model of torch_ebip")
    if len(content) < 8 + length:
        raise ValueError(f"{path}: a model that is cut off in its header")
    try:
        header = json.loads(content[8 : 8 + length])
        metadata = header.get("__metadata__", {})
    except (AttributeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a model of torch_ebip, or a damaged one: {str(error)[:200]}") from error
    if not isinstance(metadata, dict):
        raise ValueError(f"{path}: not a model of torch_ebip")
    return metadata


def _sum(version: int, text: str, tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over version, description, and every tensor's name, kind, shape and bytes."""
    digest = hashlib.sha256(f"{version}\n{text}\n".encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name}\n{tensor.dtype}\n{list(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().view(-1).view(torch.uint8).numpy().tobytes() if tensor.numel() else b"")
    return digest.hexdigest()


def _safetensors() -> ModuleType:
    """The library, imported where it is used."""
    try:
        import safetensors.torch
    except ImportError as error:
        raise ImportError("model files need safetensors: pip install safetensors") from error
    return safetensors.torch
