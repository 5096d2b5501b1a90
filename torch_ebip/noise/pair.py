"""The noises of a filter, together."""

from __future__ import annotations

from torch import nn

from torch_ebip.noise.robust import RobustWeights


class FilterNoise(nn.Module):
    """The noise of a filter, Q and R.

    Args:
        process: maps members [..., E, n], dt [...] and a generator to members with noise added.
        measurement: maps the mean phase [...] (or None) to standard deviations [D] or [..., D].
        robust: what surprising measurements count; default: as much as others.
    """

    def __init__(self, process: nn.Module, measurement: nn.Module, robust: RobustWeights | None = None) -> None:
        super().__init__()
        self.process = process
        self.measurement = measurement
        self.robust = robust
