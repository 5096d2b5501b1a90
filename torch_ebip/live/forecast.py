"""What a session expects."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from torch_ebip.common.brief import brief


class SessionForecast(NamedTuple):
    """What a session expects.

    Attributes:
        time: the present, s.
        phase: where in the interaction it is now, 0 to 1.
        time_to_end: seconds until phase 1; infinite if the interaction stands still.
        dofs: names of the controlled DoFs, D_c of them.
        mean, deviation: [D_c], or [P, D_c] for P horizons: expected values and their standard deviations.
        stale: names of the sensors of which nothing was used for a while, or ever.
    """

    time: float
    phase: float
    time_to_end: float
    dofs: tuple[str, ...]
    mean: Tensor
    deviation: Tensor
    stale: tuple[str, ...]

    def __repr__(self) -> str:
        return brief(self)
