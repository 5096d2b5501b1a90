"""What an interaction gives to the filters over it: a phase, forecasts, and which demonstrations speak."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torch_ebip.common.ambient import eager
from torch_ebip.common.draws import Generators
from torch_ebip.filtering import functional
from torch_ebip.filtering.base import EngineName, Filter
from torch_ebip.filtering.ensemble import EnsembleFilter
from torch_ebip.filtering.extended import ExtendedFilter, GaussianState
from torch_ebip.filtering.members import MemberFilter
from torch_ebip.filtering.particle import ParticleFilter
from torch_ebip.filtering.protocols import MayLeaveSpan, View
from torch_ebip.filtering.states import Memory, State
from torch_ebip.interaction.attribution import affine_coefficients
from torch_ebip.interaction.forecast import Forecast, Phases, as_phases, as_seconds_ahead
from torch_ebip.interaction.phases.phase import PhaseModel
from torch_ebip.interaction.projection import BasisProjection
from torch_ebip.interaction.readout import Lead, Readout, lead_of
from torch_ebip.interaction.recognition import Recognition
from torch_ebip.interaction.trace import InteractionTrace


class InteractionFilter(Filter):
    """A filter over an `interaction_model`: its states are what moves, the phase first, and the weights.

    Attributes:
        readout: what its forecasts pass through, such as a `HorizonShrinkage`; None: nothing.
        recognition: which labels its demonstrations have; None: none.

    Raises:
        ValueError: a model that is not one of an interaction, or a prior without demonstrations.
    """

    _trace = InteractionTrace
    readout: Readout | None
    recognition: Recognition | None

    def _check(self) -> None:
        """See `Filter._check`."""
        self.readout = None
        self.recognition = None
        self._spread: tuple[Tensor, int, Tensor, list[Tensor]] | None = None
        model = self.model
        if not isinstance(model.dynamics, PhaseModel) or not isinstance(model.measurement, BasisProjection):
            raise ValueError(
                f"an {type(self).__name__} is over a phase model and a basis projection, see `interaction_model`, "
                f"got {type(model.dynamics).__name__} and {type(model.measurement).__name__}"
            )
        if not isinstance(getattr(self.prior, "states", None), Tensor):
            raise ValueError(
                f"a {type(self.prior).__name__} knows no demonstrations that forecasts could rest on: "
                "it has no `states`"
            )

    if TYPE_CHECKING:  # what `nn.Module.__call__` hides

        def __call__(
            self,
            y: Tensor,
            observed: Tensor | None = None,
            dt: float | Tensor | None = None,
            state: State | None = None,
            generator: Generators = None,
            *,
            keep: Tensor | None = None,
            segment: int | None = None,
            project: bool = True,
            engine: EngineName = "auto",
        ) -> InteractionTrace: ...

    @property
    def basis_projection(self) -> BasisProjection:
        """h."""
        return self.model.measurement  # type: ignore[return-value]

    @property
    def phase_model(self) -> PhaseModel:
        """g."""
        return self.model.dynamics  # type: ignore[return-value]

    def phase(self, state: State) -> Tensor:
        """[...], mean phase of a state."""
        return self.moving(state)[..., 0]

    def phase_velocity(self, state: State) -> Tensor:
        """[...], mean phase velocity of a state, 1/s."""
        return self.phase_model.velocity(self.moving(state))

    def _narrow(self, view: View) -> None:
        """See `Filter._narrow`."""
        super()._narrow(view)
        if self.readout is not None:
            self.readout = self.readout.select(view)

    @eager
    def forecast(self, state: State, phase: Phases | None = None, *, ahead: Phases | None = None) -> Forecast:
        """The trajectory that the state implies, after the `readout`.

        Args:
            state: of this filter.
            phase: [P] or [..., P], or one number; default: 50 phases evenly from the current one to 1.
            ahead: instead of phases: seconds, [P] or one number, each member at its own velocity, backwards none;
                infinity is the end, behind which nothing lies. `Forecast.phase` is then the mean of the members'. A
                read-out with a share for the end takes it for infinity, and towards phase 1 where phases are asked.

        Raises:
            ValueError: phases that are NaN or infinite; seconds that are NaN or negative; both.
        """
        if ahead is not None and phase is not None:
            raise ValueError("a forecast is of phases or of seconds ahead, got both")
        seconds = None if ahead is None else as_seconds_ahead(ahead, state[0])
        if seconds is not None:
            forecast = self._forecast_ahead(state, seconds)
        else:
            forecast = self._forecast(state, self._phases_ahead(state, phase))
        if self.readout is None:
            return forecast
        lead = self.lead(state, forecast.phase, seconds)
        return self.readout(forecast, lead, *self.demonstrated(lead.phase))

    @abstractmethod
    def _forecast(self, state: State, phase: Tensor) -> Forecast:
        """What a state implies at phases [P] or [..., P]."""

    @abstractmethod
    def _forecast_ahead(self, state: State, ahead: Tensor) -> Forecast:
        """What a state implies so many seconds ahead, [P]; infinity is the end."""

    def lead(self, state: State, phase: Tensor, asked: Tensor | None = None) -> Lead:
        """How far ahead of a ``state`` each ``phase`` [..., P] lies, of seconds [P] if those were ``asked`` for."""
        moving = self.moving(state)
        return lead_of(moving[..., 0], self.phase_model.velocity(moving), phase, asked)

    def demonstrated(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the demonstrations at phases [..., P]: [..., P, D], units of the DoFs and squared."""
        states, basis = self.prior.states, self.basis_projection.basis
        assert isinstance(states, Tensor)
        version = 0 if states.is_inference() else states._version
        if self._spread is None or self._spread[0] is not states or self._spread[1] != version:
            # Kept: otherwise every forecast on a robot would cost a look at all demonstrations.
            weights = states[:, self.phase_model.moving :]
            self._spread = states, version, weights.mean(0), basis.variances(weights)
        _, _, mean, blocks = self._spread
        path, variance = basis.project_moments(phase, mean, blocks)
        return path, variance.clamp(min=0)

    @eager
    def recognise(self, state: State) -> dict[str, Tensor]:
        """Which of the labelled interactions is going on: the probability [...] of each label, by name.

        Args:
            state: of this filter.

        Raises:
            ValueError: the demonstrations have no labels, or the filter does not weigh its members.
        """
        memory = getattr(state, "memory", None)
        return self.recognised(Memory() if memory is None else memory, self.phase(state))

    def recognised(self, memory: Memory, phase: Tensor) -> dict[str, Tensor]:
        """See `recognise`, of the ``memory`` of an ensemble at a mean phase [...]; errors as there."""
        if self.recognition is None:
            raise ValueError(
                "nothing to recognise: the demonstrations have no labels; give them, "
                "`Demonstrations(..., labels=[...])`, or let `learn` look for groups"
            )
        probability = self.recognition(memory, phase)
        return dict(zip(self.recognition.labels, probability.unbind(-1), strict=True))

    def attribution(self, state: State) -> Tensor:
        """Which demonstrations speak: the mean forecast is this affine combination of their trajectories.

        Each forecast's mean is sum_i c_i h(phase, w_i), because nothing ever leaves the span of the
        demonstrations. See `torch_ebip.interaction.attribution`.

        Args:
            state: of this filter.

        Returns:
            c, [..., N], summing to 1.

        Raises:
            ValueError: an option moves weights out of the span; says which.
        """
        reason = self._leaves_span()
        if reason is not None:
            raise ValueError(f"forecasts are no combination of the demonstrations: {reason}")
        m, states = self.phase_model.moving, self.prior.states
        return affine_coefficients(states[:, m:], state.mean[..., m:])  # type: ignore[index]

    def _leaves_span(self) -> str | None:
        """What moves weights out of the span of the demonstrations, if anything does."""
        prior = self.prior.leaves_span if isinstance(self.prior, MayLeaveSpan) else None
        return self.model.leaves_span or prior

    def _phases_ahead(self, state: State, phase: Phases | None) -> Tensor:
        """Phases that are asked for; by default 50, [..., 50], evenly from the current one to 1."""
        if phase is not None:
            return as_phases(phase, state[0])
        now = self.phase(state).clamp(0, 1).unsqueeze(-1)
        return now + (1 - now) * torch.linspace(0, 1, 50, dtype=now.dtype, device=now.device)


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
        end = ahead.isinf().unsqueeze(-1)
        # A member that runs backwards, of a hand that goes back, waits: it has no end to come to.
        phase = now + velocity.clamp(min=0) * torch.where(end, 0, ahead.unsqueeze(-1))
        phase = torch.where(end, 1, phase).clamp(max=1)
        departures = basis.project(phase, members[..., m:].unsqueeze(-3))
        weights = None if state.weights is None else state.weights.unsqueeze(-2)
        mean = functional.ensemble_mean(phase.unsqueeze(-1), weights).squeeze(-1)
        centre, path = self._centre(state), None
        if centre is not None:
            # Members differ by where they are along the centre's path, too.
            still = centre[..., m:].unsqueeze(-2)
            path = basis.project(mean, still).unsqueeze(-2)
            departures = departures + (basis.project(phase, still.unsqueeze(-2)) - path)
        return self._of_members(state, mean, departures, path)

    def _of_members(self, state: State, phase: Tensor, departures: Tensor, path: Tensor | None) -> Forecast:
        """The forecast of members that differ by ``departures`` from a path that they share."""
        weights = None if state.weights is None else state.weights.unsqueeze(-2).expand(departures.shape[:-1])
        mean = functional.ensemble_mean(departures, weights)
        variance = functional.ensemble_variance(departures, weights, self.fair)
        members = departures
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
        phase = torch.where(ahead.isinf(), 1, now + velocity.clamp(min=0) * torch.where(ahead.isinf(), 0, ahead))
        phase = phase.clamp(max=1)
        return self._forecast(state, phase)

    def _forecast(self, state: GaussianState, phase: Tensor) -> Forecast:
        """h(phi, mu) and Phi(phi) Sigma_ww Phi(phi)' at phases [..., P] to come."""
        basis, m = self.basis_projection.basis, self.phase_model.moving
        phase = phase.to(state.mean).expand(*state.mean.shape[:-1], phase.shape[-1])
        mean = basis.project(phase, state.mean[..., m:].unsqueeze(-2))
        # Where the prior is rank deficient rounding can leave less than nothing.
        variance = basis.project_covariance(phase, state.covariance[..., m:, m:]).clamp(min=0)
        return Forecast(mean, variance, phase)
