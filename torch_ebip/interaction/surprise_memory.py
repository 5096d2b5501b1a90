"""What is remembered of how surprising sensors were, and what that makes of them."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from torch_ebip.common.brief import brief

MOST = 5.0
"""What a sample adds to the mean at most, as a multiple of what rejects: a sensor that agrees again is soon back."""
MOST_BIAS = 2.0
"""What a bias is at most, likewise: it is forgotten more slowly."""
ABSURD = 1e9
"""The largest multiple there is."""
HERE = 0.1
"""Samples that must be left of a sensor, after forgetting, for it to have a say."""
ALONE = (10.0, 100.0)
"""Multiples of what rejects a sensor among others between which a sample is rejected whatever the others say: all may
be surprised because the interaction is another, but not by as much as that."""
LEAST_SAY = 1e-3
BEFORE = 3.0
"""Samples without a bias that a mean begins with: the first few tell little of a direction."""
ONE_SIDED = 6.0
"""What a difference with a direction is at most, as a multiple of what is usual: many small ones tell, not one."""
PER_SENSOR = 6
"""Numbers that are kept of a sensor, beside the sums of its DoFs."""
STATES = ("ok", "suspect", "rejected")


class SurpriseMemory(NamedTuple):
    """What is remembered of S sensors, and of all of them together.

    Attributes:
        sensors: [..., S, 6 + m], sums of multiples of what is usual and of samples, both discounted; how surprising
            it is, a logarithm, 0 where it is as usual; what it counts, 0 to 1; the last multiple's logarithm; and
            discounted more slowly, the sum of samples and those of differences of its DoFs, m at most.
        together: [..., 2], how surprising they were together at most so far (0 suspect, 1 rejected); and by how much
            that was beyond the body of its distribution, forgotten slowly.
    """

    sensors: Tensor
    together: Tensor

    def __repr__(self) -> str:
        return brief(self)

    @property
    def level(self) -> Tensor:
        """[..., S]."""
        return self.sensors[..., 2]

    @property
    def counts(self) -> Tensor:
        """[..., S]."""
        return self.sensors[..., 3]

    @property
    def largest(self) -> Tensor:
        """[...]; minus infinity before anything was seen."""
        return self.together[..., 0]

    @property
    def recent(self) -> Tensor:
        """[...], at least 0."""
        return self.together[..., 1]


def state_of(counts: float) -> str:
    """ "ok", "suspect" or "rejected", of a sensor that counts so much."""
    return STATES[0] if counts >= 1 else STATES[1] if counts > 0 else STATES[2]
