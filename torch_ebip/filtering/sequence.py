"""Filtering a whole sequence: states to keep on the way, and gradient checkpointing of segments."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torch_ebip.common.brief import brief
from torch_ebip.common.draws import Generators, replayed, set_states, states_of
from torch_ebip.filtering.states import State, map_state


class Steps(Protocol):
    """What filters a sequence: a `Filter`."""

    def _predict(self, state: State, dt: Tensor, generator: Generators) -> State: ...

    def _update(self, state: State, y: Tensor, observed: Tensor, generator: Generators) -> tuple[State, Tensor]: ...

    def moving(self, state: State) -> Tensor:
        """[..., m]."""

    def project(self, state: State) -> Tensor:
        """[..., D]."""


class Segment(NamedTuple):
    """What some samples leave: the state after the last one, and an entry a sample: [..., m], [...] and [..., D].

    ``felt`` has what the update's `Surprise` remembered after each sample, nothing where there is none.
    """

    state: State
    states: list[Tensor]
    log_likelihood: list[Tensor]
    projection: list[Tensor]
    kept: list[tuple[tuple[int, ...], State]]
    felt: list[Any]

    def __repr__(self) -> str:
        return brief(self)


class Filtered(NamedTuple):
    """What filtering a sequence gives: the parts of a `Trace`.

    Attributes:
        state, states, log_likelihood, projection, kept: see `Trace`.
        felt: what the update's `Surprise` remembered after each sample, [..., T, ...] each; None where there is none.
    """

    state: State
    states: Tensor
    log_likelihood: Tensor
    projection: Tensor
    kept: State | None
    felt: Any = None

    def __repr__(self) -> str:
        return brief(self)


def surprise_of(state: State) -> Any:
    """What the update's `Surprise` remembers in a state, None if it has none."""
    memory = getattr(state, "memory", None)
    return None if memory is None else memory.surprise


def along(felt: list[Any], batch: torch.Size) -> Any:
    """Memories of samples one after the other, together: [*batch, T, ...]; None for none."""
    if not felt:
        return None
    place = len(batch)

    def together(*parts: Tensor) -> Tensor:
        """All samples of one tensor."""
        return torch.stack([part.expand((*batch, *part.shape[place:])) for part in parts], place)

    return map_state(together, *felt)


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


def filter_step_by_step(
    filter: Steps,
    y: Tensor,
    observed: Tensor,
    dt: Tensor,
    state: State,
    generator: Generators,
    keep: Tensor | None,
    segment: int | None,
    project: bool,
) -> Filtered:
    """`Filter.forward` for sequences that were checked: one step after the other, from state to state.

    Args:
        filter: whose steps.
        y: [..., T, D].
        observed: bool [..., T, D].
        dt: [] or [...], seconds between samples.
        state: where to start.
        generator: of all draws.
        keep: int64 [..., K], after which samples to keep the state.
        segment: samples a segment of gradient checkpointing.
        project: whether to project.

    Returns:
        See `Filtered`: states [..., T, m], log-likelihood [..., T], projection [..., T, D].
    """
    batch, length = y.shape[:-2], y.shape[-2]

    def run(state: State, start: int, stop: int, generator: Generators) -> Segment:
        """Samples start to stop - 1."""
        record = Segment(state, [], [], [], [], [])
        for t in range(start, stop):
            if t > 0:
                state = filter._predict(state, dt, generator)
            state, likelihood = filter._update(state, y[..., t, :], observed[..., t, :], generator)
            moving = filter.moving(state)
            record.log_likelihood.append(likelihood.expand(batch))
            record.states.append(moving.expand(*batch, moving.shape[-1]))
            record.projection.append(filter.project(state) if project else state[0].new_zeros(*batch, 0))
            felt = surprise_of(state)
            if felt is not None:
                record.felt.append(felt)
            if keep is not None:
                record.kept.extend(pick(state, keep == t))
        return record._replace(state=state)

    segments = []
    for start in range(0, length, segment or length):
        stop = min(start + (segment or length), length)
        execute = partial(checkpointed, run) if segment else run
        done = execute(state, start, stop, generator)
        state = done.state
        segments.append(done)
    return Filtered(
        state,
        torch.stack([moving for part in segments for moving in part.states], -2),
        torch.stack([value for part in segments for value in part.log_likelihood], -1),
        torch.stack([value for part in segments for value in part.projection], -2),
        None if keep is None else assemble([pick for part in segments for pick in part.kept], keep.shape),
        along([felt for part in segments for felt in part.felt], batch),
    )
