"""What filters have in common whose belief is a set of members, weighted or not."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip import functional
from torch_ebip.ambient import eager
from torch_ebip.arguments import as_count
from torch_ebip.draws import Generators
from torch_ebip.filters.base import Filter, Phases, as_phases
from torch_ebip.filters.evidence import Evidence
from torch_ebip.filters.forecast import Forecast
from torch_ebip.filters.interaction import BasisProjection, ConstantVelocityPhase
from torch_ebip.filters.sequence import State
from torch_ebip.noise.pair import FilterNoise
from torch_ebip.noise.process import InteractionNoise


class EnsembleState(NamedTuple):
    """An ensemble.

    What of a state stands still between measurements is stored as deviations from the mean of the first ensemble:
    float32 then holds how members differ, not where they are. `EnsembleState(members)` is a state made by hand.

    Attributes:
        deviations: [..., E, n], the members less the centre.
        evidence: what weights of the members rest on; None where all count alike.
        growth: [...], product of all inflations so far; None where there is none, or no bound on it.
        centre: [..., n], never changed by a step, 0 where the dynamics move a state; None: nothing was taken out.
    """

    deviations: Tensor
    evidence: Evidence | None = None
    growth: Tensor | None = None
    centre: Tensor | None = None

    @property
    def members(self) -> Tensor:
        """[..., E, n], with the centre."""
        return self.deviations if self.centre is None else self.deviations + self.centre.unsqueeze(-2)

    @property
    def weights(self) -> Tensor | None:
        """[..., E], summing to 1; None where all members count alike."""
        return None if self.evidence is None else self.evidence.weights

    @property
    def mean(self) -> Tensor:
        """[..., n]."""
        mean = functional.ensemble_mean(self.deviations, self.weights)
        return mean if self.centre is None else mean + self.centre

    @property
    def covariance(self) -> Tensor:
        """[..., n, n], A'A / (E - 1), or its weighted form."""
        return functional.ensemble_covariance(self.deviations, self.weights)


class MemberFilter(Filter):
    """Means, phases and forecasts of members; a subclass says how they are predicted and updated.

    Its states begin with members [..., E, n] or their deviations from a centre [..., n], and have ``weights``
    [..., E], None where all members count alike.

    Args:
        dynamics: g, maps members [..., E, n] and dt [...] to members.
        observation: h, maps members [..., E, n] to projections [..., E, D]. If it has ``phase(members)`` and
            ``at(members, phase)``, as `BasisProjection` has, the filter knows phases and can forecast.
        noise: Q and R.
        prior: maps (batch_shape, n_members, members, generator) to initial members.
        n_members: E.
        n_dofs, dt, thinning, dof_names: see `Filter`.

    Raises:
        ValueError: fewer than two members.
    """

    fair = True
    """Whether members are draws of equal standing: variances and scores are then corrected for their number."""

    def __init__(
        self,
        dynamics: nn.Module,
        observation: nn.Module,
        noise: FilterNoise,
        prior: nn.Module,
        n_members: int,
        n_dofs: int,
        dt: float,
        thinning: int = 1,
        dof_names: tuple[str, ...] | None = None,
    ) -> None:
        super().__init__(dynamics, observation, noise, prior, n_dofs, dt, thinning, dof_names)
        if as_count("n_members", n_members) < 2:
            raise ValueError(f"an ensemble needs at least 2 members to have a spread, got {n_members}")
        self.n_members = as_count("n_members", n_members)

    def _advance(self, members: Tensor, dt: Tensor, generator: Generators) -> Tensor:
        """g(x) + N(0, Q)."""
        moved: Tensor = self.dynamics(members, dt)
        process = self.noise.process
        if isinstance(process, InteractionNoise) and type(self.dynamics) is ConstantVelocityPhase:
            return process.add_(moved, dt, generator)  # what this g returns is new: one copy less
        return process(moved, dt, generator)  # type: ignore[no-any-return]

    @eager
    def project(self, state: State) -> Tensor:
        """See `Filter.project`."""
        return functional.ensemble_mean(self._project_rows(state, None), state.weights)

    def phase(self, state: State) -> Tensor:
        """See `Filter.phase`."""
        phase = self._phase_or_none(state)
        if phase is not None:
            return phase
        members: Tensor = state[0]
        return members[..., 0, 0] * torch.nan

    def _centre(self, state: State) -> Tensor | None:
        """What the members of a state are deviations from, [..., n]; None if they are none."""
        return None

    def _project_rows(self, state: State, rows: Tensor | None) -> Tensor:
        """h [..., E, k] of the members, for some DoFs int64 [k], ascending; None for all."""
        if isinstance(self.observation, BasisProjection):
            dofs = None if rows is None else rows.tolist()
            return self.observation.rows(state[0], dofs, self._centre(state))
        projections: Tensor = self.observation(state.members)
        return projections if rows is None else projections[..., rows]

    def _phase_or_none(self, state: State) -> Tensor | None:
        phase_of: Callable[[Tensor], Tensor] | None = getattr(self.observation, "phase", None)
        if phase_of is None:
            return None
        return functional.ensemble_mean(phase_of(state[0]).unsqueeze(-1), state.weights).squeeze(-1)

    @eager
    def forecast_members(self, state: State, phase: Tensor) -> Tensor:
        """Each member's trajectory, [..., P, E, D], that a state implies at a phase [P] or [..., P].

        Raises:
            TypeError: the observation knows no phase.
        """
        departures, path = self._paths_ahead(state, as_phases(phase, state[0]))
        return departures if path is None else departures + path

    def _paths_ahead(self, state: State, phase: Tensor) -> tuple[Tensor, Tensor | None]:
        """Each member's trajectory [..., P, E, D] as it differs from that of the centre, [..., P, 1, D], if any."""
        project_at: Callable[[Tensor, Tensor], Tensor] | None = getattr(self.observation, "at", None)
        if project_at is None:
            raise TypeError(f"{type(self.observation).__name__} knows no phase to forecast along: it has no `at`")
        members, centre = state[0], self._centre(state)
        phase = phase.to(members).expand(*members.shape[:-2], -1)
        return project_at(members, phase), None if centre is None else project_at(centre.unsqueeze(-2), phase)

    @eager
    def forecast(self, state: State, phase: Phases | None = None) -> Forecast:
        """Steps 4 and 5 of the paper's box: mean and variance over members of h at phases to come.

        At a given phase h is linear in the weights, so the mean of h is h of the mean, the paper's output.
        See `Filter.forecast`.
        """
        phase = self._phases_ahead(state) if phase is None else as_phases(phase, state[0])
        departures, path = self._paths_ahead(state, phase)
        phase = phase.to(departures).expand(departures.shape[:-2])
        weights = None if state.weights is None else state.weights.unsqueeze(-2).expand(departures.shape[:-1])
        mean = functional.ensemble_mean(departures, weights)
        variance = functional.ensemble_variance(departures, weights, self.fair)
        members = departures
        if path is not None:
            mean, members = mean + path.squeeze(-2), departures + path
        return Forecast(mean, variance, phase, members, weights, self.fair)
