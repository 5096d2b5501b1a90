"""The kinds of filters over an interaction, by how they hold their belief: members, particles, a Gaussian."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.common.ambient import eager
from torch_ebip.filtering import functional
from torch_ebip.filtering.ensemble import EnsembleFilter
from torch_ebip.filtering.extended import ExtendedFilter, GaussianState
from torch_ebip.filtering.functional.moments import centred, member_shares
from torch_ebip.filtering.members import MemberFilter
from torch_ebip.filtering.particle import ParticleFilter
from torch_ebip.filtering.states import State
from torch_ebip.interaction.course import ends
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.forecast import Forecast, as_phases

PLACES = 40
"""On a circle, over which the end may be anywhere."""


class InteractionMemberFilter(InteractionFilter, MemberFilter):
    """Forecasts of members."""

    @eager
    def forecast_members(self, state: State, phase: Tensor) -> Tensor:
        """Each member's trajectory, [..., P, E, D], that a state implies at a phase [P] or [..., P]."""
        departures, path = self._paths_ahead(state, as_phases(phase, state[0]))
        return departures if path is None else departures + path

    def _paths_ahead(self, state: State, phase: Tensor) -> tuple[Tensor, Tensor | None]:
        """Each member's trajectory [..., P, E, D] as it differs from that of the centre, [..., P, 1, D], if any."""
        project_at, members, centre = self.basis_projection.at, state[0], self._centre(state)
        phase = phase.to(members).expand(*members.shape[:-2], -1)
        return project_at(members, phase), None if centre is None else project_at(centre.unsqueeze(-2), phase)

    def _forecast(self, state: State, phase: Tensor) -> Forecast:
        """Steps 4 and 5 of the paper's box: mean and variance over members of h at phases [..., P] to come.

        At a given phase h is linear in the weights, so the mean of h is h of the mean, the paper's output.
        """
        departures, path = self._paths_ahead(state, phase)
        phase = phase.to(departures).expand(departures.shape[:-2])
        return self._of_members(state, phase, departures, path)

    def _forecast_ahead(self, state: State, ahead: Tensor) -> Forecast:
        """See `InteractionFilter._forecast_ahead`: every member at the phase where it will be."""
        m, basis, members = self.phase_model.moving, self.basis_projection.basis, state[0]
        moving = self.model.split(members)[0]
        now, velocity = moving[..., 0].unsqueeze(-2), self.phase_model.velocity(moving).unsqueeze(-2)
        seconds, end = ahead.unsqueeze(-1), ahead.isinf().unsqueeze(-1)
        if (waits := self.waits(state)) is not None:
            seconds = waits.gone_apart(ahead, members.shape[-2])
        # A member that runs backwards, of a hand that goes back, waits: it has no end to come to.
        phase = now + velocity.clamp(min=0) * torch.where(end, 0, seconds)
        periodic = self.phase_model.periodic
        phase = ends(phase, end, periodic)
        phase = phase if periodic else phase.clamp(max=1)
        weights = None if state.weights is None else state.weights.unsqueeze(-2)
        mean = functional.ensemble_mean(phase.unsqueeze(-1), weights)
        centre = self._centre(state)
        if centre is None:
            departures, path = basis.project(phase, members[..., m:].unsqueeze(-3)), None
        else:
            # Members differ by where they are along the centre's path, too.
            phases = torch.cat([phase, mean], -1)
            departures, along = basis.project_apart(phases, members[..., m:], centre[..., m:])
            along, path = along[..., :-1, :], along[..., -1:, :]
            departures = departures + (along - path)
        return self._of_members(state, mean.squeeze(-1), departures, path)

    def _of_members(self, state: State, phase: Tensor, departures: Tensor, path: Tensor | None) -> Forecast:
        """The forecast of members that differ by ``departures`` from a path that they share."""
        weights = None if state.weights is None else state.weights.unsqueeze(-2).expand(departures.shape[:-1])
        apart = centred(departures, weights)
        mean, members = apart.reference + apart.shift, departures
        variance = (apart.anomalies.square() * member_shares(departures, weights, self.fair)).sum(-2)
        if path is not None:
            mean, members = mean + path.squeeze(-2), departures + path
        return Forecast(mean, variance, phase, members, weights, self.fair)


class InteractionEnsembleFilter(InteractionMemberFilter, EnsembleFilter):
    """The paper's eBIP and what is built on it: an `EnsembleFilter` of an interaction, made by `ebip`."""

    def _leaves_span(self) -> str | None:
        return super()._leaves_span() or self.analysis.leaves_span


class InteractionParticleFilter(InteractionMemberFilter, ParticleFilter):
    """A `ParticleFilter` of an interaction, made by `particle_filter`."""


class InteractionExtendedFilter(InteractionFilter, ExtendedFilter):
    """The paper's BIP: an `ExtendedFilter` of an interaction, made by `bip`."""

    def _forecast_ahead(self, state: GaussianState, ahead: Tensor) -> Forecast:
        """See `InteractionFilter._forecast_ahead`: at the mean velocity."""
        now, velocity = self.phase(state).unsqueeze(-1), self.phase_velocity(state).unsqueeze(-1)
        phase = now + velocity.clamp(min=0) * torch.where(ahead.isinf(), 0, ahead)
        if self.phase_model.periodic:
            return self._round(state, phase, ahead.isinf())
        phase = torch.where(ahead.isinf(), 1, phase).clamp(max=1)
        return self._forecast(state, phase)

    def _round(self, state: GaussianState, phase: Tensor, end: Tensor) -> Forecast:
        """On a circle: at phases [..., P], and where the end is asked for, bool [P], of all phases together."""
        said = self._forecast(state, phase)
        if not bool(end.any()):
            return said
        places = (torch.arange(PLACES, dtype=phase.dtype, device=phase.device) + 0.5) / PLACES
        whole = self._forecast(state, places)
        mean = whole.mean.mean(-2, keepdim=True)
        variance = (whole.variance + (whole.mean - mean).square()).mean(-2, keepdim=True)
        asked = end.unsqueeze(-1)
        return said._replace(
            mean=torch.where(asked, mean, said.mean), variance=torch.where(asked, variance, said.variance)
        )

    def _forecast(self, state: GaussianState, phase: Tensor) -> Forecast:
        """h(phi, mu) and Phi(phi) Sigma_ww Phi(phi)' at phases [..., P] to come."""
        basis, m = self.basis_projection.basis, self.phase_model.moving
        phase = phase.to(state.mean).expand(*state.mean.shape[:-1], phase.shape[-1])
        mean = basis.project(phase, state.mean[..., m:].unsqueeze(-2))
        # Where the prior is rank deficient rounding can leave less than nothing.
        variance = basis.project_covariance(phase, state.covariance[..., m:, m:]).clamp(min=0)
        return Forecast(mean, variance, phase)
