"""The twin that nothing surprises."""

from __future__ import annotations

from dataclasses import replace

from torch_ebip import InteractionModel


def sure(model: InteractionModel) -> InteractionModel:
    """The same filter without surprise, doubt and bounds.

    Args:
        model: as `learn` gives it; it is left alone.
    """
    bold = model.rebuilt()
    bold.filter.doubt = bold.filter.bounds = bold.filter.analysis.surprise = None  # type: ignore[union-attr]
    return replace(bold)
