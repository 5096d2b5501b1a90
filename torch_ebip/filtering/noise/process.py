"""Process noise of models that bring their own or need none."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor, nn

from torch_ebip.common.draws import Generators

if TYPE_CHECKING:
    from torch_ebip.filtering.protocols import View


class NoProcessNoise(nn.Module):
    """Q = 0, for dynamics that bring their own noise or need none."""

    moving = 0
    """It stirs nothing."""

    def forward(self, members: Tensor, dt: Tensor, generator: Generators = None) -> Tensor:
        """The members [..., E, n] as they are, whatever dt, in seconds, and generator."""
        return members

    def select(self, view: View) -> NoProcessNoise:
        """The same for a view of the model."""
        return self
