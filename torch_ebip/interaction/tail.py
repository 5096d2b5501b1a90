"""How often something as large was seen: the distribution of maxima over interactions left out, its tail fitted."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_number

BODY = tuple(0.05 * k for k in range(1, 17))
"""Probabilities of the quantiles that are kept: from .05 to .80, where the tail begins."""
FEWEST = 20
"""Values below which there is no tail to fit."""


class Tail(nn.Module):
    """Chances of a value above x: between quantiles as they were found, behind the last of them exponential.

    Of logarithms an exponential tail is Pareto's, and its length is Hill's estimate (1975). The largest twentieth of
    what is behind the last quantile, one at least, is only known to be no smaller than the next one (Epstein and
    Sobel, 1953, of lives that are censored): a recording that is odd itself does not decide about all others.

    Args:
        quantiles: [G, Q], of G kinds at the probabilities `BODY`, not decreasing.
        length: [G], of the tails, positive.

    Raises:
        ValueError: shapes that do not fit, quantiles that decrease, a length that is not positive.

    Example:
        >>> import torch
        >>> from torch_ebip.interaction.tail import Tail
        >>> tail = Tail.fit(torch.linspace(0, 1, 101).unsqueeze(-1))
        >>> tail.above(torch.tensor([0.5])).round(decimals=2).tolist()
        [0.5]
    """

    quantiles: Tensor
    length: Tensor

    def __init__(self, quantiles: Tensor, length: Tensor) -> None:
        super().__init__()
        G = len(quantiles)
        if quantiles.shape != (G, len(BODY)) or length.shape != (G,):
            raise ValueError(
                f"quantiles must be [G, {len(BODY)}] and length [G], got {list(quantiles.shape)} and "
                f"{list(length.shape)}"
            )
        if not bool((quantiles.diff(dim=-1) >= 0).all()) or not bool((length > 0).all()):
            raise ValueError("quantiles must not decrease, and the length of a tail must be positive")
        self.register_buffer("quantiles", owned(quantiles))
        self.register_buffer("length", owned(length))

    @classmethod
    def fit(cls, values: Tensor) -> Tail:
        """Of values [B, G], at least `FEWEST` of them.

        Raises:
            ValueError: too few, or some that are not finite.
        """
        if len(values) < FEWEST or not bool(values.isfinite().all()):
            raise ValueError(f"a tail is fitted to at least {FEWEST} finite values, got {list(values.shape)}")
        quantiles = values.double().quantile(values.new_tensor(BODY, dtype=torch.float64), 0).T
        excess = (values.double().T - quantiles[:, -1:]).sort(-1).values
        length = torch.stack([_length(some[some > 0]) for some in excess])
        return cls(quantiles.to(values), length.clamp(min=1e-3).to(values))

    def above(self, x: Tensor) -> Tensor:
        """Chances [..., G] of x [..., G] or more; 1 below what was ever found."""
        quantiles, Q = self.quantiles, len(BODY)
        flat = x.reshape(-1, len(quantiles)).T.contiguous()
        right = torch.searchsorted(quantiles.contiguous(), flat).clamp(1, Q - 1)
        low, high = quantiles.gather(-1, right - 1), quantiles.gather(-1, right)
        steps = quantiles.new_tensor(BODY)
        part = torch.where(high > low, (flat - low) / torch.where(high > low, high - low, 1), 0.0)
        within = 1 - torch.lerp(steps[right - 1], steps[right], part)
        excess = (flat - quantiles[:, -1:]).clamp(min=0)
        behind = (1 - BODY[-1]) * torch.exp(-excess / self.length.unsqueeze(-1))
        found = torch.where(excess > 0, behind, within.clamp(1 - BODY[-1], 1))
        return found.T.reshape(x.shape)

    def at(self, chance: float) -> Tensor:
        """[G], what is exceeded with a chance behind the last quantile's, in (0, .2]."""
        return self.quantiles[:, -1] + self.length * math.log((1 - BODY[-1]) / chance)

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: nothing beside themselves."""
        return ""

    def extra_repr(self) -> str:
        """Sizes."""
        return f"{len(self.length)} kinds"


def _length(excess: Tensor) -> Tensor:
    """[], of an exponential distribution of which these, ascending, were drawn, the largest twentieth censored."""
    count = len(excess)
    certain = count - math.ceil(count / 20)
    if certain < 1:
        return excess.sum() / max(count, 1)
    return (excess[:certain].sum() + (count - certain) * excess[certain - 1]) / certain


def on_one_scale(first: Tensor, second: Tensor) -> Tensor:
    """Offset and scale, [2], that bring the tail of values to where that of others begins, and to its length.

    Args:
        first: [A], the others, at least `FEWEST` of them, finite.
        second: [B], the values, likewise.
    """
    tails = [Tail.fit(values.unsqueeze(-1)) for values in (first, second)]
    scale = (tails[0].length / tails[1].length)[0]
    return torch.stack([tails[0].quantiles[0, -1] - scale * tails[1].quantiles[0, -1], scale])


def as_chances(suspect: float, rejected: float) -> dict[str, float]:
    """Both chances, checked.

    Args:
        suspect, rejected: see `InteractionSurprise`.

    Raises:
        ValueError: one outside (0, 1), ``suspect`` beyond the fitted tail, or not the larger one.
    """
    for name, chance in (("suspect", suspect), ("rejected", rejected)):
        if not 0 < as_number(name, chance) < 1:
            raise ValueError(f"{name} is a chance, between 0 and 1, got {chance}")
    if suspect > 1 - BODY[-1] or not rejected < suspect:
        raise ValueError(
            f"suspect must be at most {1 - BODY[-1]:g}, and rejected less than suspect, got {suspect} and {rejected}"
        )
    return {"suspect": float(suspect), "rejected": float(rejected)}
