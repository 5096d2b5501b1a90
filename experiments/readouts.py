"""What each part of the read-out gives: other read-outs of the filter that `learn` made, learned as its own was.

They are methods of `experiments.compare`, beside `ebip_tuned`, whose folder they read: `--methods ebip_tuned
readout_linear readout_alone ...`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from experiments.entries import Fold
from experiments.evaluate import END, Answer, FilterMethod
from torch_ebip.interaction import Analogues, InteractionEnsembleFilter, InteractionPrimitive
from torch_ebip.interaction.analogues import Analogy
from torch_ebip.interaction.present import Present
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.procedure import DECIDING
from torch_ebip.learning.reading_out import Makes, learn_readout
from torch_ebip.learning.settings import settings_for


class Forgetful(Analogues):
    """Without the evidence: what was told earlier does not count."""

    def forward(self, present: Present) -> Analogy:
        """See `Analogues.forward`: all members of the ``present`` alike."""
        there = present.prior > -torch.inf
        even = torch.where(there, 0, -torch.inf) - there.sum(-1, keepdim=True).to(present.prior).log()
        return super().forward(present._replace(prior=even.to(present.prior)))


class Timeless(Analogues):
    """Without the filter's phase: any phase is as likely as any other."""

    def forward(self, present: Present) -> Analogy:
        """See `Analogues.forward`: of a ``present`` whose phase nobody knows."""
        return super().forward(present._replace(variance=torch.full_like(present.variance, 1e4)))


def held_out_of(fold: Fold, subsets: Mapping[str, Tensor] | None = None) -> HeldOut:
    """A fold's interactions as `learn` has them, with some sets of sensors, bool [D] by name; default: all."""
    tuned = fold.tuned()
    settings = settings_for(fold.known, 1, fold.seed, None, {"thinning": fold.tuning.thinning})
    task = Task(tuned.primitive, tuned.objective, tuned.targets, tuned.subsets if subsets is None else subsets)
    return HeldOut(fold.known, task, settings)


def with_readout(
    fold: Fold,
    makes: Makes | None,
    alone: bool = False,
    expert: bool = False,
    subsets: Mapping[str, Tensor] | None = None,
) -> InteractionEnsembleFilter:
    """The filter that `learn` made of a fold, with another read-out.

    Args:
        fold: the training part.
        makes: its analogues; None for none.
        alone: whether analogues speak without the filter and the mean.
        expert: whether one is heard beside them, where it pays.
        subsets: sets of sensors, bool [D] by name, that it is learned from; default: all.
    """
    filter = copy.deepcopy(fold.model().filter)
    assert isinstance(filter, InteractionEnsembleFilter)
    surprise, doubt, bounds = filter.analysis.surprise, filter.doubt, filter.bounds
    filter.readout = filter.doubt = filter.bounds = filter.analysis.surprise = filter.analysis.recent = None
    held_out = held_out_of(fold, subsets)
    partition = held_out.partition
    some = partition.order[: max(DECIDING, len(partition.validating))]
    learn_readout(
        held_out, filter, some, partition.validating, makes, choose=False, corrected=not alone, expert=expert
    )
    filter.analysis.surprise, filter.doubt, filter.bounds = surprise, doubt, bounds
    return filter


class UnseenMethod:
    """For each set of sensors a read-out that was learned from all the others.

    Args:
        fold: the training part.

    Raises:
        ValueError: a single set.
    """

    def __init__(self, fold: Fold) -> None:
        masks = fold.tuned().subsets
        if len(masks) < 2:
            raise ValueError(f"no other set of sensors to learn from: there is only {', '.join(masks)}")
        self._methods = [
            (
                mask.cpu(),
                FilterMethod(with_readout(fold, _analogues, expert=True, subsets=_others(masks, name)), fold.seed),
            )
            for name, mask in masks.items()
        ]

    def __call__(
        self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor, ahead: Sequence[float] = END
    ) -> Answer:
        """See `experiments.evaluate.Method`; of the set that has what is observed."""
        shown = observed.any(0).any(0)
        fitting = [(int(mask.sum()), method) for mask, method in self._methods if not bool((shown & ~mask).any())]
        return min(fitting, key=lambda pair: pair[0])[1](y, observed, keep, dofs, ahead)


def _others(masks: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    return {other: mask for other, mask in masks.items() if other != name}


def _analogues(primitive: InteractionPrimitive, compared: Tensor) -> Analogues:
    return Analogues.of(primitive, compared)


def _method(build: Callable[[Fold], InteractionEnsembleFilter], fold: Fold) -> FilterMethod:
    return FilterMethod(build(fold), fold.seed)


READOUTS: dict[str, Callable[[Fold], FilterMethod | UnseenMethod]] = {
    "readout_linear": partial(_method, partial(with_readout, makes=None)),
    "readout_alone": partial(_method, partial(with_readout, makes=_analogues, alone=True)),
    "readout_no_memory": partial(_method, partial(with_readout, makes=Forgetful.of)),
    "readout_no_phase": partial(_method, partial(with_readout, makes=Timeless.of)),
    "readout_no_expert": partial(_method, partial(with_readout, makes=_analogues)),
    "readout_unseen": UnseenMethod,
    "readout_again": partial(_method, partial(with_readout, makes=_analogues, expert=True)),
}
"""Builders: drawn towards the mean alone; analogues without the filter; without the evidence; without the filter's
phase; without the expert; learned without the set of sensors that is asked about; as it is, learned anew, of a filter
that was learned before."""
