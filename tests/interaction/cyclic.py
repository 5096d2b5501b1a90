"""Waves of five DoFs on the layout of conftest: three of a human, two of a robot."""

from __future__ import annotations

from functools import lru_cache

import torch

from experiments.cyclic.waves import Waves, waves
from tests.conftest import interactions
from torch_ebip import Demonstrations, InteractionPrimitive

HUMAN = torch.tensor([True, True, True, False, False])


@lru_cache
def waving(count: int = 24, seed: int = 0, anywhere: bool = False, dtype: torch.dtype = torch.float32) -> Waves:
    made = waves(count, seed, anywhere)
    layout, rate = interactions(1).layout, interactions(1).rate
    values = [values[:, :5].to(dtype) for values in made.recordings]
    return Waves(Demonstrations(layout, values, rate), made.phases)


@lru_cache
def small_circle(dtype: torch.dtype = torch.float32, anywhere: bool = False) -> InteractionPrimitive:
    return InteractionPrimitive.fit(waving(anywhere=anywhere, dtype=dtype).recordings, periodic=True)
