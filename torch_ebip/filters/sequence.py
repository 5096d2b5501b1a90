"""Filtering a whole sequence: states to keep on the way, and gradient checkpointing of segments."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torch_ebip.draws import Generators, replayed, set_states, states_of

State = Any
"""A NamedTuple of tensors with leading batch dimensions; every filter has its own."""


class Segment(NamedTuple):
    """What some samples leave: the state after the last one, and an entry a sample: [...], [...] and [..., D]."""

    state: State
    phase: list[Tensor]
    log_likelihood: list[Tensor]
    projection: list[Tensor]
    kept: list[tuple[tuple[int, ...], State]]


def checkpointed(run: Callable[..., Segment], state: State, start: int, stop: int, generator: Generators) -> Segment:
    """Run a segment so that its backward pass repeats it with the same draws.

    The global generator is saved by torch's own checkpointing; an explicit one is replayed from its state.
    """
    if generator is None:
        return checkpoint(run, state, start, stop, None, use_reentrant=False)  # type: ignore[no-any-return]
    beginning = states_of(generator)
    ends = []

    def replay(state: State) -> Segment:
        """The segment with the draws of the first time."""
        again = replayed(generator, beginning)
        done = run(state, start, stop, again)
        ends.append(states_of(again))
        return done

    done = checkpoint(replay, state, use_reentrant=False)
    set_states(generator, ends[0])
    return done  # type: ignore[no-any-return]


def pick(state: State, here: Tensor) -> list[tuple[tuple[int, ...], State]]:
    """The entries of a batch that are to be kept now, bool [*batch, K], with their place [*batch, K]."""
    if not bool(here.any()):
        return []
    places = [tuple(index) for index in here.nonzero().tolist()]

    def entry(index: tuple[int, ...], part: Tensor) -> Tensor:
        """One entry of the batch."""
        return part[index]

    return [(place, map_state(partial(entry, place[:-1]), state)) for place in places]


def assemble(picked: list[tuple[tuple[int, ...], State]], shape: torch.Size) -> State:
    """The entries that `pick` gave, in their places: batch dimensions ``shape``."""
    ordered = [state for _, state in sorted(picked, key=lambda pair: pair[0])]

    def stack(*parts: Tensor) -> Tensor:
        """The entries in their places, [*shape, ...]."""
        return torch.stack(parts).reshape(*shape, *parts[0].shape)

    return map_state(stack, *ordered)


def map_state(function: Callable[..., Tensor], *states: State) -> State:
    """Apply a function to the corresponding tensors [...] of states, which may be nested and hold None."""
    first = states[0]
    if first is None:
        return None
    if isinstance(first, Tensor):
        return function(*states)
    return type(first)(*(map_state(function, *parts) for parts in zip(*states, strict=True)))
