"""What an interaction gives to the filters over it: a phase, forecasts, and which demonstrations speak."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import torch
from torch import Tensor

from torch_ebip.common.ambient import eager, outside_inference
from torch_ebip.common.arguments import as_values
from torch_ebip.common.draws import Generators
from torch_ebip.filtering import functional
from torch_ebip.filtering.base import EngineName, Filter
from torch_ebip.filtering.ensemble import EnsembleFilter
from torch_ebip.filtering.extended import ExtendedFilter, GaussianState
from torch_ebip.filtering.members import MemberFilter
from torch_ebip.filtering.particle import ParticleFilter
from torch_ebip.filtering.protocols import MayLeaveSpan
from torch_ebip.filtering.states import State
from torch_ebip.interaction.attribution import affine_coefficients
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.phases.phase import PhaseModel
from torch_ebip.interaction.projection import BasisProjection
from torch_ebip.interaction.trace import InteractionTrace

Phases: TypeAlias = Tensor | Sequence[float] | float
"""Of a forecast."""


def as_phases(phase: Phases, like: Tensor) -> Tensor:
    """Phases [P] or [..., P] of a forecast, in the dtype and on the device of ``like``; one number is [1].

    Raises:
        ValueError: NaN or infinity, or no numbers at all.
    """
    if not isinstance(phase, Tensor):
        phase = as_values("phase", phase, None, like)
    phase = outside_inference(phase.to(like))
    if not bool(phase.isfinite().all()):
        raise ValueError("phases must be finite numbers, got NaN or infinity")
    return phase.reshape(1) if phase.ndim == 0 else phase


class InteractionFilter(Filter):
    """A filter over an `interaction_model`: its states are what moves, the phase first, and the weights.

    Raises:
        ValueError: a model that is not one of an interaction, or a prior without demonstrations.
    """

    _trace = InteractionTrace

    def _check(self) -> None:
        """See `Filter._check`."""
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

    @abstractmethod
    def forecast(self, state: State, phase: Phases | None = None) -> Forecast:
        """The trajectory that the state implies.

        Args:
            state: of this filter.
            phase: [P] or [..., P], or one number; default: 50 phases evenly from the current one to 1.

        Raises:
            ValueError: phases that are NaN or infinite.
        """

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

    @eager
    def forecast(self, state: State, phase: Phases | None = None) -> Forecast:
        """Steps 4 and 5 of the paper's box: mean and variance over members of h at phases [..., P] to come.

        At a given phase h is linear in the weights, so the mean of h is h of the mean, the paper's output.
        See `InteractionFilter.forecast`.

        Args:
            state: of this filter.
            phase: [P] or [..., P], or one number; default: 50 phases evenly from the current one to 1.
        """
        phase = self._phases_ahead(state, phase)
        departures, path = self._paths_ahead(state, phase)
        phase = phase.to(departures).expand(departures.shape[:-2])
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

    @eager
    def forecast(self, state: GaussianState, phase: Phases | None = None) -> Forecast:
        """h(phi, mu) and Phi(phi) Sigma_ww Phi(phi)' at phases [..., P] to come; see `InteractionFilter.forecast`.

        Args:
            state: of this filter.
            phase: [P] or [..., P], or one number; default: 50 phases evenly from the current one to 1.
        """
        basis, m = self.basis_projection.basis, self.phase_model.moving
        phase = self._phases_ahead(state, phase)
        phase = phase.to(state.mean).expand(*state.mean.shape[:-1], phase.shape[-1])
        mean = basis.project(phase, state.mean[..., m:].unsqueeze(-2))
        # Where the prior is rank deficient rounding can leave less than nothing.
        variance = basis.project_covariance(phase, state.covariance[..., m:, m:]).clamp(min=0)
        return Forecast(mean, variance, phase)
