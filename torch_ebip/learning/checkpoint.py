"""Checkpoints: written atomically, read with weights only, tied to the configuration they belong to."""

from __future__ import annotations

import os
import pickletools
import re
import zipfile
from collections.abc import Iterator, Mapping
from typing import Any

import torch

from torch_ebip.common.files import atomic_write
from torch_ebip.recordings.archives import open_archive

FORMAT = 1
LIMIT = 1 << 32
"""Bytes that a checkpoint may have, unless a caller says something else."""
CODE_LIMIT = 1 << 22
"""Bytes of a checkpoint beside its tensors."""
_MADE = re.compile(r"collections OrderedDict|torch (Size|\w+Storage)|torch\._utils _rebuild_(tensor_v2|parameter)")
_MEMBER = re.compile(
    r"[^/]+/(data\.pkl|byteorder|version|data/\d+|\.data/serialization_id|\.format_version|\.storage_alignment)"
)
_PLAIN = (bool, int, float, str, type(None))


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


def load_checkpoint(
    path: str | os.PathLike[str], configuration: Mapping[str, Any], limit: int = LIMIT
) -> dict[str, Any]:
    """Read the content of a checkpoint; executes nothing of it.

    Args:
        path: of the file.
        configuration: that it must have been written with.
        limit: bytes; more is refused before it is read.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the file is cut off, damaged, too large or not a checkpoint, or it was written with another
            configuration; names what differs.
    """
    try:
        with open_archive(path, limit, (zipfile.ZIP_STORED,)) as (file, archive):
            _check_code(archive)
            # Torch compares no sums: a flipped bit would be a weight.
            damaged = archive.testzip()
            if damaged is not None:
                raise ValueError(f"{damaged!r} in it is not what was written")
            file.seek(0)
            stored = torch.load(file, map_location="cpu", weights_only=True)
        version, theirs, content = stored["format"], stored["configuration"], stored["content"]
        _check_tensors(stored)
        if not isinstance(theirs, dict) or not isinstance(content, dict):
            raise ValueError("no configuration or content in it")
        if not all(isinstance(name, str) for name in theirs):
            raise ValueError("settings without names")
    except FileNotFoundError:
        raise
    except Exception as error:  # damaged bytes raise nearly anything, a lack of memory included
        reason = str(error).rpartition("WeightsUnpickler error:")[2].strip()[:300]
        if not reason or any(word in reason for word in ("weights_only", "safe_globals", "trust")):  # torch's advice
            reason = "it holds something else than tensors, numbers, strings and containers of them"
        raise ValueError(
            f"{path}: not a readable checkpoint (cut off, damaged or of another kind): {reason}"
        ) from error
    if type(version) is not int or version != FORMAT:
        raise ValueError(f"{path}: checkpoint format {_brief(version)}, this version reads {FORMAT}")
    differing = list(_differences(theirs, configuration))
    if differing:
        raise ValueError(f"{path}: checkpoint of another configuration: {'; '.join(differing)}")
    return dict(content)


def _check_code(archive: zipfile.ZipFile) -> None:
    """Nothing but tensors, numbers, strings and containers: torch also makes bytes of any length, as a file asks.

    Torch looks members up without regard to case, so that there must be no two ways to spell one.
    """
    names = [member.filename for member in archive.infolist()]
    if len({name.lower() for name in names}) != len(names):
        raise ValueError("members of it have names that differ by case only")
    if len({name.partition("/")[0] for name in names}) != 1 or not all(map(_MEMBER.fullmatch, names)):
        raise ValueError("members that no checkpoint has")
    for member in archive.infolist():
        if member.filename.endswith("/data.pkl"):
            if member.file_size > CODE_LIMIT:
                raise ValueError(f"{member.file_size} bytes beside the tensors, expected at most {CODE_LIMIT}")
            for opcode, argument, _ in pickletools.genops(archive.read(member)):
                if opcode.name == "GLOBAL" and not _MADE.fullmatch(str(argument)):
                    raise ValueError(f"{str(argument)[:80]!r} in it is none of tensors, numbers, strings, containers")


def _check_tensors(content: Any) -> None:
    """No tensor that is larger than what the file holds for it: strides of 0 make gigabytes of a few bytes.

    Raises:
        ValueError: there is one.
    """
    # Each container once: they may hold each other, and themselves.
    seen: set[int] = set()
    open_ones = [content]
    while open_ones:
        part = open_ones.pop()
        if isinstance(part, torch.Tensor):
            if part.numel() * part.element_size() > part.untyped_storage().nbytes():
                raise ValueError(f"a tensor {list(part.shape)[:8]} of {part.untyped_storage().nbytes()} bytes")
        elif isinstance(part, Mapping | list | tuple) and id(part) not in seen:
            seen.add(id(part))
            open_ones += part.values() if isinstance(part, Mapping) else part


def _differences(theirs: Mapping[Any, Any], ours: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """What differs, by name. Goes as deep as ours: theirs may be made to be endless."""
    for name in sorted({*theirs, *ours}, key=str):
        there, here = theirs.get(name), ours.get(name)
        if isinstance(there, dict) and isinstance(here, Mapping):
            yield from _differences(there, here, f"{prefix}{name}.")
        elif not _same(there, here):
            yield f"{prefix}{name}: {_brief(there)} there, {_brief(here)} here"


def _same(there: Any, here: Any) -> bool:
    if isinstance(here, list | tuple):
        return isinstance(there, list | tuple) and len(there) == len(here) and all(map(_same, there, here))
    return isinstance(there, _PLAIN) and isinstance(here, _PLAIN) and there == here


def _brief(value: Any) -> str:
    """Numbers, strings and short lists of them; of anything else, which may be of any size, the type."""
    if isinstance(value, list | tuple) and len(value) <= 20 and all(isinstance(item, _PLAIN) for item in value):
        return f"[{', '.join(_brief(item) for item in value)}]"
    if isinstance(value, int) and abs(value) > 1 << 64:
        return "a huge number"
    return repr(value)[:80] if isinstance(value, _PLAIN) else f"a {type(value).__name__}"
