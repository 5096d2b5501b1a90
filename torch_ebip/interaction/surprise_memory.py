"""What is remembered of how surprising sensors were, and what that makes of them."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from torch_ebip.common.brief import brief

MOST = 5.0
"""What a sample adds to the mean at most, as a multiple of what rejects: a sensor that agrees again is soon back."""
MOST_BIAS = 2.0
"""What a bias is at most, likewise, as far as it is forgotten in time for that."""
BACK = 0.5
"""s, after which a sensor that agrees with what is expected without it is believed again."""
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
"""Numbers that are kept of a sensor, before the sums of its DoFs."""
STATES = ("ok", "suspect", "rejected")


class SurpriseMemory(NamedTuple):
    """What is remembered of S sensors, and of all of them together.

    Attributes:
        kept: [..., S + 1, 6 + m], a row for each sensor: sums of multiples of what is usual and of samples, both
            discounted; how surprising it is, a logarithm, 0 where it is as usual; what it counts, 0 to 1; the last
            multiple's logarithm; and discounted more slowly, the sum of samples and those of differences of its
            DoFs, m at most. The last row begins with what all are together: `largest` and `recent`.
    """

    kept: Tensor

    def __repr__(self) -> str:
        return brief(self)

    @property
    def sensors(self) -> Tensor:
        """[..., S, 6 + m]."""
        return self.kept[..., :-1, :]

    @property
    def level(self) -> Tensor:
        """[..., S], how surprising each sensor is."""
        return self.kept[..., :-1, 2]

    @property
    def counts(self) -> Tensor:
        """[..., S], what each counts."""
        return self.kept[..., :-1, 3]

    @property
    def largest(self) -> Tensor:
        """[...], how surprising they were together at most (0 suspect, 1 rejected); minus infinity at first."""
        return self.kept[..., -1, 0]

    @property
    def recent(self) -> Tensor:
        """[...], by how much that was beyond the body of its distribution, forgotten slowly."""
        return self.kept[..., -1, 1]


def state_of(counts: float) -> str:
    """ "ok", "suspect" or "rejected", of a sensor that counts so much."""
    return STATES[0] if counts >= 1 else STATES[1] if counts > 0 else STATES[2]
