"""A model from where it was kept: its file, or the run folder of an experiment."""

from __future__ import annotations

import os
from pathlib import Path

from torch_ebip.learning.interaction_model import NAME, InteractionModel


def load_model(path: str | os.PathLike[str]) -> InteractionModel:
    """A model, of its file or of the run folder of an experiment.

    Args:
        path: of either.

    Raises:
        FileNotFoundError: there is no such file or folder, or no model in it.
        ValueError: see `InteractionModel.load`.

    Example:
        >>> import tempfile
        >>> from torch_ebip import InteractionModel, InteractionPrimitive, ebip, load_model
        >>> from torch_ebip.recordings import example
        >>> primitive = InteractionPrimitive.fit(example())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     InteractionModel(ebip(primitive), primitive).save(folder + "/model.safetensors")
        ...     model = load_model(folder)
        >>> model.sensors
        ('hand', 'gaze')
    """
    place = Path(path)
    if place.is_dir():
        place = place / NAME
        if not place.exists():
            inside = sorted(part.parent.name for part in place.parent.glob(f"*/{NAME}"))
            hint = f"; there is one in {', '.join(inside[:10])}" if inside else ""
            raise FileNotFoundError(f"{place.parent}: no {NAME} in this folder{hint}")
    return InteractionModel.load(place)
