"""Interactions filtered by ensembles that do not contain them, and what is then said of their future.

What a filter makes of a demonstration that is one of its members says nothing of what it makes of a new one: tuning,
the search for where it starts, and every score that is reported come from here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief
from torch_ebip.common.draws import seeded
from torch_ebip.filtering.states import EnsembleState
from torch_ebip.filtering.trace import Trace
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.objective import ForecastObjective
from torch_ebip.learning.partition import Partition, generator_of
from torch_ebip.learning.ranks import Ranks
from torch_ebip.learning.recently import recent_sums
from torch_ebip.learning.references import last_measured, recorded
from torch_ebip.learning.settings import TuningSettings
from torch_ebip.recordings.demonstrations import Demonstrations

PORTION = 64
"""Interactions that are filtered at once where none needs a gradient: more would only take memory."""


class Shown(NamedTuple):
    """B interactions as they are shown, up to K horizons each.

    Attributes:
        interactions: int64 [B], which demonstrations they are.
        members: int64 [B, E], the demonstrations of each one's ensemble.
        dofs: bool [D], the D' that are shown or asked for.
        y: [B, T, D'], what was measured, NaN included.
        observed: bool [B, T, D'], what of it is shown.
        steps: int64 [B, K], at which samples the horizons are.
        now: [B, K], true phases of the horizons.
        truth: [B, K, P, D_targets], what the objective asks for: regressions at its phases, or what was recorded
            so many seconds later, NaN where nothing was.
        targets: bool [D'], those among the D'.
    """

    interactions: Tensor
    members: Tensor
    dofs: Tensor
    y: Tensor
    observed: Tensor
    steps: Tensor
    now: Tensor
    truth: Tensor
    targets: Tensor

    def __repr__(self) -> str:
        return brief(self)


class Trial(NamedTuple):
    """Interactions as a filter saw them.

    Attributes:
        shown: what was shown of them.
        filter: of the DoFs that are shown or asked for.
        trace: with the states at the horizons.
    """

    shown: Shown
    filter: InteractionFilter
    trace: Trace

    def __repr__(self) -> str:
        return brief(self)

    def terms(self, objective: ForecastObjective) -> dict[str, Tensor]:
        """The weighted terms [] of an objective by name: see `ForecastObjective.forward` [...]."""
        shown = self.shown
        terms: dict[str, Tensor] = objective(
            self.filter, self.trace, shown.observed, shown.truth, shown.now, shown.targets
        )
        return terms

    def forecast(self, objective: ForecastObjective) -> Forecast:
        """Of the targets where an objective asks for them, from the kept states: mean [B, K, P, D_targets]."""
        targets, kept = self.shown.targets, self.trace.kept
        if isinstance(kept, EnsembleState) and kept.centre is not None:
            # What nobody asks for need not be forecast.
            entries = self.filter.model.view(targets.cpu()).state
            part = kept._replace(deviations=kept.deviations[..., entries], centre=kept.centre[..., entries])
            return objective.forecast(self.filter.restrict(targets), part, self.shown.now)
        return objective.forecast(self.filter, kept, self.shown.now).select(targets)


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
        self.ends = torch.stack([last_measured(trajectory) for trajectory in demonstrations]).to(device)
        self.partition = Partition(len(demonstrations), settings)

    @property
    def shares(self) -> Tensor:
        """[4], of an interaction, evenly within the settings' horizons."""
        low, high = self.settings.horizons
        return low + (high - low) * (torch.arange(4, device="cpu") + 0.5) / 4

    def show(self, interactions: Tensor, subset: Tensor, shares: Tensor, members: Tensor) -> Shown:
        """This process's part of some interactions.

        Args:
            interactions: int64 [B].
            subset: bool [D], of sensors that are shown.
            shares: [B, K], up to which parts of their length.
            members: int64 [B, E], their ensembles.
        """
        task = self.task
        mine = slice(self.ranks.rank, None, self.ranks.size)
        interactions, shares, members = interactions[mine], shares[mine], members[mine]
        kept_dofs = subset | task.targets
        stride, device = self.settings.thinning, self.lengths.device
        interactions, shares, members = interactions.to(device), shares.to(device), members.to(device)
        last = (self.lengths[interactions] - 1).unsqueeze(-1)
        steps = torch.minimum((shares * last / stride).round().long(), last // stride)
        length = int(steps.max()) + 1
        y = self.values[interactions, ::stride][:, :length][..., kept_dofs]
        observed = self.observed[interactions, ::stride][:, :length][..., kept_dofs] & subset[kept_dofs]
        within = torch.arange(length, device=steps.device).view(1, -1, 1) <= steps.amax(-1).view(-1, 1, 1)
        observed = observed & within
        now = (steps * stride / last).to(y)
        ahead = task.objective.ahead
        if ahead is None:
            truth = self.truth(interactions, task.objective.phases_ahead(now))
        else:
            truth = self.recorded(interactions, steps * stride, ahead)
        targets = task.targets[kept_dofs]
        return Shown(interactions, members, kept_dofs, y, observed, steps, now, truth, targets)

    def filter(self, filter: InteractionFilter, shown: Shown, key: int) -> Trial:
        """Filter what is shown of some interactions.

        Args:
            filter: over all DoFs.
            shown: of them.
            key: of the draws, with the seed and the interaction.
        """
        draws = [seeded(self.settings.seed, key, interaction) for interaction in shown.interactions.tolist()]
        part = filter.restrict(shown.dofs, self.settings.thinning)
        known = self.partition.known(shown.interactions.cpu()).to(shown.members.device)
        state = part.initial_state((len(shown.interactions),), shown.members, draws, known=known)
        segment = self.settings.segment if torch.is_grad_enabled() else None
        trace = part(
            shown.y,
            shown.observed,
            state=state,
            generator=draws,
            keep=shown.steps,
            segment=segment or None,
            project=False,
        )
        return Trial(shown, part, self._seen_lately(shown, part, trace))

    def _seen_lately(self, shown: Shown, filter: InteractionFilter, trace: Trace) -> Trace:
        """The trace, its states knowing what all samples showed of late, not only those that thinning left."""
        recent, kept, stride = filter.recent, trace.kept, self.settings.thinning
        if recent is None or kept is None or stride == 1:
            return trace
        steps = shown.steps * stride
        length = int(steps.max()) + 1
        sensors = shown.observed.flatten(0, 1).any(0)
        y = self.values[shown.interactions, :length][..., shown.dofs]
        observed = self.observed[shown.interactions, :length][..., shown.dofs] & sensors
        counts = None
        if trace.counts is not None and filter.surprise is not None:
            at = torch.arange(length, device=y.device) // stride
            counts = trace.counts[:, at][..., filter.surprise.sensor_of_dof].to(y)
        sums = recent_sums(recent, y, observed, steps, 1 / self.task.primitive.rate, counts)
        memory = kept.memory._replace(recent=sums)
        return replace(trace, kept=kept._replace(memory=memory))

    def truth(self, interactions: Tensor, phase: Tensor) -> Tensor:
        """[B, K, P, D_targets], of interactions int64 [B]: their regressions at phases [B, K, P]."""
        primitive = self.task.primitive
        weights = primitive.weights[interactions, None, None, :]
        return primitive.basis.project(phase, weights)[..., self.task.targets]

    def recorded(self, interactions: Tensor, now: Tensor, ahead: Tensor) -> Tensor:
        """[B, K, P, D_targets], of interactions int64 [B]: what was measured ``ahead`` [P] seconds after samples
        now, see `references.recorded`.

        Args:
            interactions: int64 [B].
            now: int64 [B, K].
            ahead: [P], s.
        """
        targets, rate = self.task.targets, self.task.primitive.rate
        values, ends = self.values[interactions][..., targets], self.ends[interactions][..., targets]
        return recorded(values, self.lengths[interactions], ends, now, ahead, rate)

    def portions(self, interactions: Tensor, subset: Tensor, shares: Tensor | None = None) -> Iterator[Shown]:
        """This process's part of some interactions, always at the same horizons, a few at a time.

        Args:
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
                yield self.show(some, subset, shares.expand(len(some), -1), theirs)

    def trials(
        self, filter: InteractionFilter, interactions: Tensor, subset: Tensor, shares: Tensor | None = None
    ) -> Iterator[Trial]:
        """What a filter over all DoFs makes of `portions`, always with the same draws.

        Args:
            filter: over all DoFs.
            interactions: int64 [B].
            subset: bool [D], of sensors that are shown.
            shares: [K], up to which parts of their length; default: `shares`.
        """
        for shown in self.portions(interactions, subset, shares):
            yield self.filter(filter, shown, -1)

    @without_autocast
    @torch.no_grad()
    def evaluate(
        self,
        filter: InteractionFilter,
        interactions: Tensor | None = None,
        shares: Tensor | None = None,
        more: Callable[[Trial], dict[str, float]] | None = None,
    ) -> dict[str, float]:
        """Scores of a filter as it is, always at the same horizons and draws; nothing is reported or changed.

        Args:
            filter: over all DoFs.
            interactions: int64 [B], which demonstrations; default: those kept for validation. Each is filtered
                by an ensemble that does not contain it.
            shares: [K], of an interaction that are shown; default: `shares`.
            more: further scores, means over the interactions of a trial.

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
                shown = trial.shown
                squares = objective.spread_and_error(trial.filter, trial.trace, shown.truth, shown.targets).square()
                others = {"spread": float(squares[0]), "error": float(squares[1])}
                others |= {} if more is None else {f"more/{key}": value for key, value in more(trial).items()}
                for key, value in (terms | others).items():
                    sums[key] = sums.get(key, 0.0) + value * len(shown.observed)
            means = self.ranks.mean({key: value / mine for key, value in sums.items()}, mine)
            for key, value in means.items():
                totals.setdefault(key, []).append(value)
        overall = {key: sum(values) / len(values) for key, values in totals.items()}
        spread, error = math.sqrt(overall.pop("spread")), math.sqrt(overall.pop("error"))
        loss = sum(value for key, value in overall.items() if not key.startswith(("subset/", "more/")))
        overall = {key.removeprefix("more/"): value for key, value in overall.items()}
        return {**overall, "loss": loss, "spread": spread, "error": error}
