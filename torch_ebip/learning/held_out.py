"""Interactions filtered by ensembles that do not contain them, and what is then said of their future.

What a filter makes of a demonstration that is one of its members says nothing of what it makes of a new one: tuning,
the search for where it starts, and every score that is reported come from here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.draws import seeded
from torch_ebip.filtering.trace import Trace
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.objective import ForecastObjective
from torch_ebip.learning.partition import Partition, generator_of
from torch_ebip.learning.ranks import Ranks
from torch_ebip.learning.settings import TuningSettings
from torch_ebip.recordings.demonstrations import Demonstrations

PORTION = 64
"""Interactions that are filtered at once where none needs a gradient: more would only take memory."""


class Trial(NamedTuple):
    """B interactions as a filter saw them, up to K horizons each.

    Attributes:
        filter: of the DoFs that are shown or asked for.
        trace: with the states at the horizons.
        y: [B, T, D'], what was measured, NaN included.
        observed: bool [B, T, D'], what of it was shown.
        steps: int64 [B, K], at which samples the horizons are.
        now: [B, K], true phases of the horizons.
        truth: [B, K, P, D_targets], regressions at the objective's phases ahead of them.
        targets: bool [D'], those among the filter's DoFs.
        members: int64 [B, E], the demonstrations of each ensemble.
        interactions: int64 [B], which demonstrations were filtered.
    """

    filter: InteractionFilter
    trace: Trace
    y: Tensor
    observed: Tensor
    steps: Tensor
    now: Tensor
    truth: Tensor
    targets: Tensor
    members: Tensor
    interactions: Tensor

    def terms(self, objective: ForecastObjective) -> dict[str, Tensor]:
        """The weighted terms of an objective by name."""
        terms: dict[str, Tensor] = objective(
            self.filter, self.trace, self.observed, self.truth, self.now, self.targets
        )
        return terms

    def forecast(self, phase: Tensor) -> Forecast:
        """Of the targets at phases [B, K, P], from the states at the horizons."""
        return self.filter.forecast(self.trace.kept, phase).select(self.targets)


class HeldOut:
    """Filters demonstrations by ensembles of others.

    Args:
        demonstrations: N of them, what the task's primitive was fitted to.
        task: targets, sensors, objective.
        settings: of ensembles, horizons, thinning and draws.
        ranks: the processes that share the work; default: this one alone.
    """

    def __init__(
        self, demonstrations: Demonstrations, task: Task, settings: TuningSettings, ranks: Ranks | None = None
    ) -> None:
        self.task, self.settings = task, settings
        self.ranks = Ranks() if ranks is None else ranks
        device = task.primitive.weights.device
        self.values, self.observed = (tensor.to(device) for tensor in demonstrations.pad())
        self.lengths = demonstrations.lengths.to(device)
        self.partition = Partition(len(demonstrations), settings)

    @property
    def shares(self) -> Tensor:
        """[4], of an interaction, evenly within the settings' horizons."""
        low, high = self.settings.horizons
        return low + (high - low) * (torch.arange(4, device="cpu") + 0.5) / 4

    def filter(
        self,
        filter: InteractionFilter,
        interactions: Tensor,
        subset: Tensor,
        shares: Tensor,
        members: Tensor,
        key: int,
    ) -> Trial:
        """Filter this process's part of some interactions.

        Args:
            filter: over all DoFs.
            interactions: int64 [B].
            subset: bool [D], of sensors that are shown.
            shares: [B, K], up to which parts of their length.
            members: int64 [B, E], their ensembles.
            key: of the draws, with the seed and the interaction.
        """
        task = self.task
        mine = slice(self.ranks.rank, None, self.ranks.size)
        interactions, shares, members = interactions[mine], shares[mine], members[mine]
        draws = [seeded(self.settings.seed, key, interaction) for interaction in interactions.tolist()]
        kept_dofs = subset | task.targets
        stride, device = self.settings.thinning, self.lengths.device
        interactions, shares, members = interactions.to(device), shares.to(device), members.to(device)
        part = filter.restrict(kept_dofs, stride)
        last = (self.lengths[interactions] - 1).unsqueeze(-1)
        steps = torch.minimum((shares * last / stride).round().long(), last // stride)
        length = int(steps.max()) + 1
        y = self.values[interactions, ::stride][:, :length][..., kept_dofs]
        observed = self.observed[interactions, ::stride][:, :length][..., kept_dofs] & subset[kept_dofs]
        within = torch.arange(length, device=steps.device).view(1, -1, 1) <= steps.amax(-1).view(-1, 1, 1)
        observed = observed & within
        state = part.initial_state((len(interactions),), members, draws)
        segment = self.settings.segment if torch.is_grad_enabled() else None
        trace = part(y, observed, state=state, generator=draws, keep=steps, segment=segment or None, project=False)
        now = (steps * stride / last).to(y)
        truth = self.truth(interactions, task.objective.phases_ahead(now))
        targets = task.targets[kept_dofs]
        return Trial(part, trace, y, observed, steps, now, truth, targets, members, interactions)

    def truth(self, interactions: Tensor, phase: Tensor) -> Tensor:
        """[B, K, P, D_targets], of interactions int64 [B]: their regressions at phases [B, K, P]."""
        primitive = self.task.primitive
        weights = primitive.weights[interactions, None, None, :]
        return primitive.basis.project(phase, weights)[..., self.task.targets]

    def trials(
        self, filter: InteractionFilter, interactions: Tensor, subset: Tensor, shares: Tensor | None = None
    ) -> Iterator[Trial]:
        """This process's part of some interactions, always at the same horizons and draws, a few at a time.

        Args:
            filter: over all DoFs.
            interactions: int64 [B].
            subset: bool [D], of sensors that are shown.
            shares: [K], up to which parts of their length; default: `shares`.
        """
        shares = self.shares if shares is None else shares
        members = self.partition.members(interactions, generator_of(self.settings.seed, -1))
        portion = PORTION * self.ranks.size
        parts = zip(torch.split(interactions, portion), torch.split(members, portion), strict=True)
        for some, theirs in parts:
            if len(some) > self.ranks.rank:  # at the end fewer may be left than there are processes
                yield self.filter(filter, some, subset, shares.expand(len(some), -1), theirs, -1)

    @without_autocast
    @torch.no_grad()
    def evaluate(
        self, filter: InteractionFilter, interactions: Tensor | None = None, shares: Tensor | None = None
    ) -> dict[str, float]:
        """Scores of a filter as it is, always at the same horizons and draws; nothing is reported or changed.

        Args:
            filter: over all DoFs.
            interactions: int64 [B], which demonstrations; default: those kept for validation. Each is filtered
                by an ensemble that does not contain it.
            shares: [K], of an interaction that are shown; default: `shares`.

        Returns:
            ``loss``, its terms, ``subset/NAME`` the loss of each subset, and ``spread`` and ``error`` of the
            forecasts of the end in units of the targets' spread over the demonstrations.

        Raises:
            ValueError: fewer interactions than processes.
        """
        objective = self.task.objective
        interactions = self.partition.validating if interactions is None else interactions
        if self.ranks.size > len(interactions):
            raise ValueError(f"{self.ranks.size} processes, but only {len(interactions)} interactions to share")
        totals: dict[str, list[float]] = {}
        mine = len(self.ranks.shard(range(len(interactions))))
        for name, subset in self.task.subsets.items():
            sums: dict[str, float] = {}
            for trial in self.trials(filter, interactions, subset, shares):
                terms = {key: float(value) for key, value in trial.terms(objective).items()}
                terms[f"subset/{name}"] = sum(terms.values())
                squares = objective.spread_and_error(trial.filter, trial.trace, trial.truth, trial.targets).square()
                terms["spread"], terms["error"] = squares.tolist()
                for key, value in terms.items():
                    sums[key] = sums.get(key, 0.0) + value * len(trial.observed)
            means = self.ranks.mean({key: value / mine for key, value in sums.items()}, mine)
            for key, value in means.items():
                totals.setdefault(key, []).append(value)
        overall = {key: sum(values) / len(values) for key, values in totals.items()}
        spread, error = math.sqrt(overall.pop("spread")), math.sqrt(overall.pop("error"))
        loss = sum(value for key, value in overall.items() if not key.startswith("subset/"))
        return {**overall, "loss": loss, "spread": spread, "error": error}
