"""Times of actions that take turns, so that what slows the machine down slows all of them."""

from __future__ import annotations

import gc
import random
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from threadpoolctl import threadpool_limits

Key = TypeVar("Key", bound=Hashable)


class Timing(NamedTuple):
    """Seconds of one action.

    Attributes:
        median: over all calls.
        p99: 99th percentile.
        calls: how many.
    """

    median: float
    p99: float
    calls: int


def interleaved(
    actions: Mapping[Key, Callable[[], object]],
    repeats: int,
    every: Mapping[Key, int] | None = None,
    before: Callable[[int], object] | None = None,
    warmup: int = 1,
) -> dict[Key, Timing]:
    """Time actions in turn: a round is one call of each, in an order drawn anew (seeded) for each round.

    An action finds caches as the one before it left them; so each follows each.

    Args:
        actions: by name.
        repeats: rounds that count.
        every: an action that is slow takes part in every k-th round only; default: in all.
        before: called before each round with its number, not timed; rounds that warm up have negative ones.
        warmup: rounds before those that count.

    Returns:
        A timing for each action.
    """
    every = {} if every is None else every
    order, shuffle = list(actions), random.Random(0)
    taken: dict[Key, list[float]] = {key: [] for key in actions}
    with collected():
        for round_ in range(-warmup, repeats):
            if before is not None:
                before(round_)
            shuffle.shuffle(order)
            for key in order:
                if round_ % every.get(key, 1):
                    continue
                began = time.perf_counter()
                actions[key]()
                seconds = time.perf_counter() - began
                if round_ >= 0:
                    taken[key].append(seconds)
    return {
        key: Timing(float(np.median(values)), float(np.quantile(values, 0.99)), len(values))
        for key, values in taken.items()
    }


@contextmanager
def collected() -> Iterator[None]:
    """Without garbage collection, as `timeit` does; what there is is collected before."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextmanager
def threads(count: int) -> Iterator[None]:
    """With some number of threads for torch's kernels and numpy's libraries."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with threadpool_limits(count):
            yield
    finally:
        torch.set_num_threads(before)
