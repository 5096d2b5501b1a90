"""What the parts of an update have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import nn

from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import View
from torch_ebip.recordings.layout import Layout

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on


class Part(nn.Module):
    """A part of an update: a rule, a trust, a weighting, a localisation or an inflation. One idea, one file."""

    leaves_span: str | None = None
    """Why members do not stay in the span of the first ensemble with it; None if they do."""

    def check(self, model: StateSpace) -> None:
        """Raise ValueError if it does not fit a model."""

    def select(self, view: View) -> Self:
        """The same part for a view of the model, with its parameters, not copies of them."""
        return self

    def named_values(self, layout: Layout) -> dict[str, float]:
        """What TensorBoard shows of it, by name, for a filter on this layout."""
        return {}
