"""The folder of a learning: of which one it is, and whether it was finished."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch_ebip.common.files import atomic_write, read_json, write_json
from torch_ebip.learning.interaction_model import NAME, InteractionModel
from torch_ebip.learning.ranks import Ranks
from torch_ebip.recordings.demonstrations import Demonstrations

RECORD = "learning.json"
"""Of what a folder's learning is one of."""
LEFT = ("checkpoint.pt", "report.json", "scan_scaled.json", "scan_tunable.json")
"""What else a learning leaves there."""


def enter(place: Path, ours: Mapping[str, Any], basis: str | None, ranks: Ranks) -> InteractionModel | None:
    """The model of a folder where this learning was finished; otherwise the folder becomes one of it.

    Args:
        place: the folder.
        ours: everything on which the result depends, as JSON gives it back.
        basis: table of the candidates, to be kept there.
        ranks: the processes that share the work.

    Raises:
        ValueError: a folder of another learning.
    """
    record = place / RECORD
    if record.exists():
        theirs = read_json(record)
        differing = [key for key in ours if not isinstance(theirs, dict) or theirs.get(key) != ours[key]]
        if differing:
            there = theirs.get(differing[0]) if isinstance(theirs, dict) else theirs
            raise ValueError(
                f"{place}: another learning's folder: {differing[0]} is {str(there)[:200]} there and "
                f"{str(ours[differing[0]])[:200]} here"
            )
    elif ranks.first:
        there = [name for name in (NAME, *LEFT) if (place / name).exists()]
        if there:
            raise ValueError(f"{place}: holds {', '.join(there)}, but not {RECORD}: nothing says of which learning")
        write_json(record, dict(ours))
        if basis is not None:
            with atomic_write(place / "basis.txt") as file:
                file.write(f"{basis}\n".encode())
    ranks.from_first(lambda: None)  # none goes on before the record is there
    finished = record.exists() and (place / NAME).exists()
    return InteractionModel.load(place / NAME) if finished else None


def fingerprint(demonstrations: Demonstrations) -> str:
    """Sixteen hexadecimal digits that change with any value, their order, their number or their kind."""
    digest = hashlib.sha256()
    for trajectory in demonstrations:
        values = trajectory.detach().cpu().contiguous()
        digest.update(f"{values.dtype} {list(values.shape)}".encode())
        digest.update(values.nan_to_num(nan=1e30).numpy().tobytes())
    return digest.hexdigest()[:16]
