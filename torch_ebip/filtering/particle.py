"""The bootstrap particle filter: members that are weighted, never shifted."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.common.arguments import as_number
from torch_ebip.common.brief import brief
from torch_ebip.common.draws import Generators, uniform
from torch_ebip.filtering import functional
from torch_ebip.filtering.members import MemberFilter, NumbersItsStates
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.pace import Pace, led, quantiles
from torch_ebip.filtering.updates.trust import RobustWeights
from torch_ebip.filtering.updates.weighting import Seen

HALF = 0.5
"""Share to be renewed from which on all is."""


class ParticleState(NamedTuple):
    """Weighted particles.

    Attributes:
        members: [..., E, n].
        log_weights: [..., E], normalised.
        pace: a NamedTuple of tensors, what a `Pace` remembers; None where there is none.
    """

    members: Tensor
    log_weights: Tensor
    pace: Any = None

    def __repr__(self) -> str:
        return brief(self)

    @property
    def weights(self) -> Tensor:
        """[..., E], summing to 1."""
        return self.log_weights.exp()

    @property
    def mean(self) -> Tensor:
        """[..., n]."""
        return functional.ensemble_mean(self.members, self.weights)

    @property
    def covariance(self) -> Tensor:
        """[..., n, n], sum_j w_j (x_j - mean)(x_j - mean)'."""
        return functional.ensemble_covariance(self.members, self.weights, unbiased=False)

    @property
    def effective_size(self) -> Tensor:
        """[...], 1 / sum_j w_j^2: E for equal weights, 1 where one particle has it all."""
        return torch.exp(-torch.logsumexp(2 * self.log_weights, dim=-1))


class ParticleFilter(MemberFilter):
    """Bootstrap particle filter with systematic resampling (Doucet & Johansen 2009, algorithm of section 3.5).

    Particles whose weights have an effective size below ``threshold`` E are resampled at the beginning of the
    next prediction, so that the estimates after an update do not suffer from it. Where a batch entry does not
    need it, its particles stay as they are.

    Args:
        model: g, h and their noise.
        prior: maps (batch_shape, n_members, chosen, generator) to initial members [*batch_shape, E, n].
        n_members: E.
        threshold: share of E below which particles are resampled; the paper's 1/2.
        softness: resample from (1 - softness) w + softness / E, and weigh by the ratio (soft resampling, Karkus,
            Hsu & Lee 2018): with it, gradients pass through resampling. 0 resamples from w, without gradient.
        trust: what surprising values count, each on top of those before it.
        pace: holds the clock of the model, and leads particles back that are lost; see `Pace`. Of those that were
            altogether wrong, half or more of which is to be renewed, all begin anew.

    Raises:
        ValueError: fewer than two particles, a threshold outside [0, 1] or a softness outside [0, 1).
    """

    fair = False

    def __init__(
        self,
        model: StateSpace,
        prior: nn.Module,
        n_members: int,
        threshold: float = 0.5,
        softness: float = 0.0,
        trust: Iterable[RobustWeights] = (),
        pace: Pace | None = None,
    ) -> None:
        super().__init__(model, prior, n_members)
        as_number("threshold", threshold, 0, 1)
        if as_number("softness", softness, 0) >= 1:
            raise ValueError(f"softness must be at least 0 and below 1, got {softness}")
        self.threshold = threshold
        self.softness = softness
        self.trust = nn.ModuleList(trust)
        self.pacing = pace
        if pace is not None:
            pace.check(model)

    def _start(
        self, batch_shape: tuple[int, ...], chosen: Tensor | None, generator: Generators, known: Tensor | None
    ) -> ParticleState:
        """Equal weights."""
        started, _ = self._members(batch_shape, chosen, generator)
        count = started.shape[-2]
        pace = None if self.pacing is None else self._paced(self.pacing, started, chosen, known)
        return ParticleState(started, started.new_full(started.shape[:-1], -math.log(count)), pace)

    def _predict(self, state: ParticleState, dt: Tensor, generator: Generators) -> ParticleState:
        """Resample where it is needed, then x = g(x) + N(0, Q)."""
        state, pace = self._resample(state, generator), None
        if self.pacing is not None:
            pace, dt = self.pacing.elapse(self._remembered(state), dt)
        members = self.model.advance(state.members, dt, generator)
        return ParticleState(members, state.log_weights, pace)

    def _resample(self, state: ParticleState, generator: Generators) -> ParticleState:
        batch, count = state.log_weights.shape[:-1], state.log_weights.shape[-1]
        # Drawn whether it is needed or not, so that later draws do not depend on the measurements.
        u = uniform(batch, state.members, generator)
        needed = state.effective_size < self.threshold * count
        if not bool(needed.any()):
            return state
        proposal, ratio = state.log_weights, torch.zeros_like(state.log_weights)
        if self.softness:
            even = torch.full_like(proposal, math.log(self.softness / count))
            proposal = torch.logaddexp(proposal + math.log1p(-self.softness), even)
            ratio = state.log_weights - proposal
        ancestors = functional.systematic_resample(proposal.detach(), u)
        ancestors = torch.where(needed.unsqueeze(-1), ancestors, torch.arange(count, device=u.device))
        members = state.members.gather(-2, ancestors.unsqueeze(-1).expand(state.members.shape))
        resampled = torch.log_softmax(ratio.gather(-1, ancestors), dim=-1)
        return state._replace(
            members=members, log_weights=torch.where(needed.unsqueeze(-1), resampled, state.log_weights)
        )

    def _update(
        self, state: ParticleState, y: Tensor, observed: Tensor, generator: Generators
    ) -> tuple[ParticleState, Tensor]:
        """w = w N(y; h(x), R), over the DoFs that were measured."""
        measured = observed.reshape(-1, self.n_dofs).any(0)
        if not bool(measured.any()):
            return state, state.members.new_zeros(observed.shape[:-1])
        rows = measured.nonzero().squeeze(-1)
        model = self.model
        state, counts = self._led(state, y, observed)
        deviation = model.deviation(self.moving(state) if model.noise_depends_on_state else None)[..., rows]
        deviation = deviation if counts is None else deviation / counts.sqrt().unsqueeze(-1)
        y, observed = torch.where(observed, y, 0)[..., rows], observed[..., rows]
        projections = model.project(state.members, rows)
        if len(self.trust):
            mean = functional.ensemble_mean(projections, state.weights)
            spread = functional.ensemble_variance(projections, state.weights, unbiased=False)
            for weigh in self.trust:
                y, deviation, _ = weigh(y, mean, spread, deviation)
        z = (y.unsqueeze(-2) - projections) / deviation.unsqueeze(-2)
        terms = torch.where(observed.unsqueeze(-2), z.square(), 0).sum(-1)
        constant = torch.where(observed, 2 * deviation.log() + math.log(2 * math.pi), 0).sum(-1, keepdim=True)
        joint = state.log_weights - 0.5 * (terms + constant)
        likelihood = torch.logsumexp(joint, dim=-1)
        any_observed = observed.any(-1)
        weights = torch.where(any_observed.unsqueeze(-1), joint - likelihood.unsqueeze(-1), state.log_weights)
        return state._replace(log_weights=weights), torch.where(any_observed, likelihood, 0)

    def _led(self, state: ParticleState, y: Tensor, observed: Tensor) -> tuple[ParticleState, Tensor | None]:
        """The state where the pace leads it, and what the sample [..., D] counts, [...]; None: 1."""
        if self.pacing is None:
            return state, None
        moving, still = self.model.split(state.members)
        mean = self.moving(state)
        memory, placement = self.pacing.notice(
            self._remembered(state), Seen(y, observed, None, None, moving, mean, None)
        )
        state = state._replace(pace=memory)
        if placement is not None:
            entry = led(moving[..., 0], mean[..., 0], placement).unsqueeze(-1)
            members, weights = torch.cat([entry, moving[..., 1:], still], -1), state.log_weights
            first = self._first(weights.shape[:-1])
            if first is not None:
                anew = (placement.renewed >= HALF).unsqueeze(-1)
                spread = placement.deviation.unsqueeze(-1) * quantiles(entry.shape[-2], entry)
                begun = (mean[..., 0] + placement.offset).unsqueeze(-1) + spread
                begun = torch.cat([begun.unsqueeze(-1), first[..., 1:]], -1)
                members = torch.where(anew.unsqueeze(-1), begun, members)
                weights = torch.where(anew, -math.log(weights.shape[-1]), weights)
            state = state._replace(members=members, log_weights=weights)
        return state, self.pacing.counts(memory)

    def _remembered(self, state: ParticleState) -> Any:
        """What a state remembers for the pace: nothing yet, if it was made by hand."""
        assert self.pacing is not None
        return self.pacing.start(state.members, None) if state.pace is None else state.pace

    def _first(self, batch: tuple[int, ...]) -> Tensor | None:
        """Particles as they start, [..., E, n], where nothing is drawn for it; otherwise None."""
        prior = self.prior
        if not isinstance(prior, NumbersItsStates) or len(getattr(prior, "states", ())) != self.n_members:
            return None
        return prior.start(batch, self.n_members, None, None)[0]

    def _narrow(self, view: View) -> None:
        """See `Filter._narrow`."""
        self.trust = nn.ModuleList([trust.select(view) for trust in self.trust])  # type: ignore[operator]
        self.pacing = None if self.pacing is None else self.pacing.select(view)

    def _parts(self) -> list[str]:
        """See `Filter._parts`."""
        return [type(part).__name__ for part in (*self.trust, self.pacing) if part is not None]

    def extra_repr(self) -> str:
        """The options that are not modules."""
        return (
            f"n_members={self.n_members}, threshold={self.threshold}, softness={self.softness}, stride={self.stride}"
        )
