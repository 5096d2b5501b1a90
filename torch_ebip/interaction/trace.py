"""What filtering an interaction leaves."""

from __future__ import annotations

from torch import Tensor

from torch_ebip.filtering.trace import Trace


class InteractionTrace(Trace):
    """A `Trace` whose states begin with the phase."""

    @property
    def phase(self) -> Tensor:
        """[..., T], mean phase after each sample."""
        return self.states[..., 0]
