"""What the baselines share: reading a prefix without looking past it, and answering with one value."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from experiments.evaluate import Answer
from torch_ebip import Demonstrations, Forecast
from torch_ebip.learning.references import last_measured, recorded

Array = NDArray[np.float64]


def ends(demonstrations: Demonstrations) -> Tensor:
    """[N, D] in units of the DoFs: what is to be forecast, with the same rule as in `evaluate`."""
    return torch.stack([last_measured(trajectory) for trajectory in demonstrations])


def kept_steps(lengths: Tensor, fraction: float) -> Tensor:
    """int64 [N]: last sample of the first `fraction` of recordings of `lengths` samples, as `evaluate` counts it."""
    return ((lengths * fraction).round().long() - 1).clamp(min=0)


def until(observed: Tensor, keep: Tensor) -> Tensor:
    """bool [B, T, D]: what is observed up to and with sample keep, int64 [B]."""
    return observed & (torch.arange(observed.shape[1]) <= keep.unsqueeze(-1)).unsqueeze(-1)


def point_answer(mean: Tensor) -> Answer:
    """An answer [B, K, A, D] that knows nothing of its uncertainty or of the phase."""
    unknown = torch.full_like(mean, torch.nan)
    return Answer(
        Forecast(mean, unknown, mean.new_full(mean.shape[:3], torch.nan)), mean.new_full(mean.shape[:2], torch.nan)
    )


def places_of(ahead: Sequence[float], learned: Sequence[float]) -> list[int]:
    """Where the seconds that are asked for are among those that were learned.

    Raises:
        ValueError: some were not.
    """
    strange = [a for a in ahead if a not in learned]
    if strange:
        raise ValueError(f"{strange} s ahead were not learned, only {list(learned)}")
    return [learned.index(a) for a in ahead]


def futures(demonstrations: Demonstrations, keep: Tensor, ahead: Sequence[float], targets: Tensor) -> Tensor:
    """[N, K, A, M], units of the DoFs: what is to be forecast, with the same rule as in `evaluate`.

    Args:
        demonstrations: N of them.
        keep: int64 [N, K], the last sample that is shown.
        ahead: A times in seconds after it; infinity: the end.
        targets: bool [D], the M DoFs.
    """
    values, last = demonstrations.pad()[0][..., targets], ends(demonstrations)[:, targets]
    seconds = values.new_tensor(list(ahead))
    return recorded(values, demonstrations.lengths, last, keep, seconds, demonstrations.rate)
