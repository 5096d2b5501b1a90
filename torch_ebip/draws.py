"""Standard-normal draws, on the device of their generator."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def standard_normal(shape: Sequence[int], like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draws [*shape] in the dtype and on the device of ``like``; from torch's global stream without a generator.

    They are made where the generator lives and moved, so that a generator of the CPU serves every device.
    """
    device = like.device if generator is None else generator.device
    return torch.randn(tuple(shape), generator=generator, dtype=like.dtype, device=device).to(like.device)
