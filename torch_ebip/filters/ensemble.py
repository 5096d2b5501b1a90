"""The ensemble filter: the paper's five steps over any dynamics g and any observation h."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip import functional
from torch_ebip.ambient import eager, owned
from torch_ebip.arguments import as_number
from torch_ebip.draws import Generators, is_several, standard_normal
from torch_ebip.filters.base import Trace
from torch_ebip.filters.evidence import EvidenceWeighting
from torch_ebip.filters.in_place import filter_in_place
from torch_ebip.filters.interaction import BasisProjection, ConstantVelocityPhase
from torch_ebip.filters.localisation import Localisation
from torch_ebip.filters.members import EnsembleState, MemberFilter
from torch_ebip.filters.priors import select_prior
from torch_ebip.functional import Taper
from torch_ebip.noise.pair import FilterNoise
from torch_ebip.noise.process import InteractionNoise

MOST_GROWTH = 10.0
"""What all inflations of one interaction may come to. Weights have no dynamics that would draw in what no sensor
reduces, and an interaction lasts a hundred samples; a filter that is left running must not end in infinity."""


class EnsembleFilter(MemberFilter):
    """Ensemble Kalman filter, stochastic (the paper's) or square-root.

    Args:
        dynamics: g, maps members [..., E, n] and dt [...] to members.
        observation: h, maps members [..., E, n] to projections [..., E, D]. If it has ``phase(members)`` and
            ``at(members, phase)``, as `BasisProjection` has, the filter knows phases and can forecast.
        noise: Q and R.
        prior: maps (batch_shape, n_members, members, generator) to initial members.
        n_members: E.
        n_dofs: D.
        dt: seconds between samples where none is given.
        square_root: deterministic update instead of perturbed observations.
        inflation: factor on the anomalies after each update that measured something; a number, or a
            module with a ``value`` such as `AboveOne` to learn it. With the phase dynamics of an interaction all of
            them together come to at most `MOST_GROWTH`.
        localisation: factors on the cross-covariances of blocks of the state.
        weighting: weigh members by the evidence for the demonstrations they came from; default: all alike.
            Needs a state of phase, phase velocity and weights.
        thinning: how many samples each one given stands for: R is divided by it and inflation raised to its
            power. For sequences of which only every k-th sample is used.
        columns: int64 [D], which of the weighting's DoFs this filter has; default: all of them.
        dof_names: for error messages.

    Raises:
        ValueError: fewer than two members, an inflation that is not positive, or weighting without a basis
            projection.
    """

    columns: Tensor | None

    def __init__(
        self,
        dynamics: nn.Module,
        observation: nn.Module,
        noise: FilterNoise,
        prior: nn.Module,
        n_members: int,
        n_dofs: int,
        dt: float,
        square_root: bool = False,
        inflation: float | nn.Module | None = None,
        localisation: Localisation | None = None,
        weighting: EvidenceWeighting | None = None,
        thinning: int = 1,
        columns: Tensor | None = None,
        dof_names: tuple[str, ...] | None = None,
    ) -> None:
        super().__init__(dynamics, observation, noise, prior, n_members, n_dofs, dt, thinning, dof_names)
        self.square_root = square_root
        if inflation is not None and not isinstance(inflation, nn.Module):
            inflation = as_number("inflation", inflation, 0, above=True)
        self.inflation = inflation
        self.localisation = localisation
        self.weighting = weighting
        if weighting is not None and not isinstance(observation, BasisProjection):
            raise ValueError("evidence weights need demonstrations behind the members, and so a BasisProjection")
        self.register_buffer("columns", None if columns is None else owned(columns))

    @eager
    def initial_state(
        self,
        batch_shape: tuple[int, ...] = (),
        members: Tensor | None = None,
        generator: Generators = None,
    ) -> EnsembleState:
        """Step 1 of the paper's algorithm; see `Filter.initial_state`."""
        started = self.prior(batch_shape, self.n_members, members, generator)
        evidence = None if self.weighting is None else self.weighting.start(started)
        return self._taken_out(EnsembleState(started, evidence, self._grown(EnsembleState(started))))

    def _predict(self, state: EnsembleState, dt: Tensor, generator: Generators) -> EnsembleState:
        """Step 2: x = g(x) + N(0, Q)."""
        evidence = state.evidence
        if self.weighting is not None and evidence is not None:
            evidence = self.weighting.forget(evidence, dt)
        moved = self._advance(state.deviations, dt, generator)
        return EnsembleState(moved, evidence, self._grown(state), state.centre)

    def _update(
        self, state: EnsembleState, y: Tensor, observed: Tensor, generator: Generators
    ) -> tuple[EnsembleState, Tensor]:
        """Step 3: x = x + K (y + eps - h(x)), over the DoFs that some entry of the batch measured."""
        state = state._replace(growth=self._grown(state))
        measured = observed.reshape(-1, self.n_dofs).any(0)
        draws = None
        if is_several(generator) and not self.square_root:
            # What one interaction draws may not depend on what others measure.
            draws = standard_normal((*state.deviations.shape[:-1], self.n_dofs), state.deviations, generator)
        if not bool(measured.any()):
            return state, state.deviations.new_zeros(observed.shape[:-1])
        rows = None if bool(measured.all()) else measured.nonzero().squeeze(-1)
        members, weights, centred = state.deviations, state.weights, state.centre is not None
        phase, projections, paths = self._measure(state, rows)
        deviation = self._deviation(phase)
        taper = None if self.localisation is None else self.localisation()
        if rows is not None:
            y, observed, deviation = y[..., rows], observed[..., rows], deviation[..., rows]
            taper = None if taper is None else Taper(taper.state[:, rows], taper.observation[rows][:, rows])
        trust = None
        if self.noise.robust is not None:
            mean = functional.ensemble_mean(projections, weights)
            spread = functional.ensemble_variance(projections, weights)
            y, deviation, trust = self.noise.robust(
                torch.where(observed, y, 0), mean, spread, deviation, self.thinning
            )
            trust = torch.where(observed, trust, 0)
        evidence = state.evidence
        if self.weighting is not None and evidence is not None and paths is not None and phase is not None:
            columns = self.columns
            if rows is not None:
                columns = rows if columns is None else columns[rows]
            evidence = self.weighting.learn(evidence, paths, y, observed, phase, columns, trust)
        factor = torch.diag_embed(deviation)
        inflation, growth = None, state.growth
        if self.inflation is not None:
            share = observed.any(-1).to(members) if trust is None else trust.amax(-1)
            inflation = self._inflate(growth, share)
            growth = None if growth is None else growth * inflation
        try:
            if self.square_root:
                updated, likelihood = functional.square_root_update(
                    members, projections, y, factor, observed, taper, weights, inflation, centred
                )
            else:
                if draws is None:
                    draws = standard_normal(projections.shape, members, generator)
                elif rows is not None:
                    draws = draws[..., rows]
                updated, likelihood = functional.ensemble_update(
                    members, projections, y, factor, draws, observed, taper, weights, inflation, centred
                )
        except functional.FactorisationError as error:
            raise self._named(error, rows) from error
        return EnsembleState(updated, evidence, growth, state.centre), likelihood

    def _measure(self, state: EnsembleState, rows: Tensor | None) -> tuple[Tensor | None, Tensor, Tensor | None]:
        """Mean phase [...], projections [..., E, k] of some DoFs, and those of the demonstrations behind them."""
        members, evidence = state.deviations, state.evidence
        if not isinstance(self.observation, BasisProjection):
            return self._phase_or_none(state), self._project_rows(state, rows), None
        origin, offsets = None, None
        if evidence is not None and self.weighting is not None:
            origin, offsets = evidence.origin, self.weighting.offsets
        dofs = None if rows is None else rows.tolist()
        phases, projections, paths = self.observation.measure(members, dofs, origin, offsets, state.centre)
        return _mean_phase(phases, state.weights), projections, paths

    def _centre(self, state: EnsembleState) -> Tensor | None:
        """See `MemberFilter._centre`."""
        return state.centre

    def _taken_out(self, state: EnsembleState) -> EnsembleState:
        """A state with the middle of its members taken out of what stands still, if the model says what that is.

        Only of entries of which all members lie within a factor of two of it: there a difference is exact (Sterbenz
        1974), so that nothing is rounded; elsewhere the mean is small beside the spread, and nothing is gained.
        """
        known = (BasisProjection, InteractionNoise)
        if not isinstance(self.dynamics, ConstantVelocityPhase) or (
            (type(self.observation), type(self.noise.process)) != known
        ):
            return state
        members = state.deviations
        if members.ndim == 3 and len(members) > 1 and members.stride(0) == 0:  # the same ones for the whole batch
            alike = self._taken_out(EnsembleState(members[0]))
            assert alike.centre is not None
            deviations, centre = alike.deviations.expand(members.shape), alike.centre.expand(len(members), -1)
            return state._replace(deviations=deviations, centre=centre)
        low, high = torch.aminmax(members.detach(), dim=-2)
        middle = (0.5 * (low + high)).nan_to_num()
        near = torch.where(middle < 0, -high, low) >= 0.5 * middle.abs()
        near &= torch.where(middle < 0, -low, high) <= 2 * middle.abs()
        near[..., :2] = False
        if not bool(near.any()):
            return state._replace(centre=torch.zeros_like(middle))
        centre = torch.where(near, middle, 0)
        return state._replace(deviations=members - centre.unsqueeze(-2), centre=centre)

    def _grown(self, state: EnsembleState) -> Tensor | None:
        """All inflations of an interaction so far, [...]; 1 for a state made by hand; None if they have no bound."""
        if self.inflation is None or not isinstance(self.dynamics, ConstantVelocityPhase):
            return None
        return state.deviations.new_ones(state.deviations.shape[:-2]) if state.growth is None else state.growth

    def _inflate(self, growth: Tensor | None, share: Tensor) -> Tensor:
        """Inflation [...] after a sample that counts for a share [...] of one, in [0, 1], on top of earlier ones."""
        whole: Tensor = self._inflation_factor(share) ** self.thinning
        inflation = 1 + (whole - 1) * share
        return inflation if growth is None else torch.minimum(inflation, (MOST_GROWTH / growth).clamp(min=1))

    def _inflation_factor(self, members: Tensor) -> Tensor:
        value = self.inflation.value if isinstance(self.inflation, nn.Module) else self.inflation
        return torch.as_tensor(value, dtype=members.dtype, device=members.device)

    def restrict(self, dofs: Tensor, thinning: int = 1) -> EnsembleFilter:
        """See `Filter.restrict`."""
        model = self._select(dofs, thinning)
        localisation, columns = self.localisation, self.columns
        part = EnsembleFilter(
            model.dynamics,
            model.observation,
            model.noise,
            select_prior(self.prior, model.state),
            self.n_members,
            model.n_dofs,
            model.dt,
            self.square_root,
            self.inflation,
            None if localisation is None else localisation.select(model.state, model.dofs),
            self.weighting,
            thinning * self.thinning,
            model.dofs if columns is None else columns[model.dofs],
            model.dof_names,
        )
        return part.train(self.training)

    def _without_gradients(
        self,
        y: Tensor,
        observed: Tensor,
        dt: float | Tensor,
        state: EnsembleState,
        generator: Generators,
        keep: Tensor | None,
        project: bool,
    ) -> Trace | None:
        """See `Filter._without_gradients`: in place, where updates are transforms of the members."""
        if (
            not self.has_live_path
            or (state.evidence is None) != (self.weighting is None)
            or y.dtype != state.deviations.dtype
            or isinstance(dt, Tensor)
            or y.ndim > 3
            or state.deviations.shape[:-2] != y.shape[:-2]
        ):
            return None
        return filter_in_place(self, y, observed, dt, state, generator, keep, project)

    @property
    def has_live_path(self) -> bool:
        """Whether `LiveFilter` gives this filter's numbers: its model is known and its updates mix whole members."""
        parts = (type(self.dynamics), type(self.observation), type(self.noise.process))
        known = parts == (ConstantVelocityPhase, BasisProjection, InteractionNoise)
        return known and hasattr(self.prior, "select") and self._leaves_span() is None

    def _leaves_span(self) -> str | None:
        return "covariances are localised" if self.localisation is not None else super()._leaves_span()

    def extra_repr(self) -> str:
        """The options that are not modules."""
        return f"n_members={self.n_members}, square_root={self.square_root}, thinning={self.thinning}"


def _mean_phase(phases: Tensor, weights: Tensor | None) -> Tensor:
    """Of members [..., E]; a phase never lies far from 0 compared with what it differs by."""
    return phases.mean(-1) if weights is None else (phases * weights).sum(-1)
