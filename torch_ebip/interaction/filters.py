"""What an interaction gives to the filters over it: a phase, forecasts, and which demonstrations speak."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torch_ebip.common.ambient import eager
from torch_ebip.common.draws import Generators
from torch_ebip.filtering.base import EngineName, Filter
from torch_ebip.filtering.protocols import MayLeaveSpan, View
from torch_ebip.filtering.states import Memory, State
from torch_ebip.filtering.updates.recent import Recent
from torch_ebip.interaction.analogue_readout import AnalogueReadout
from torch_ebip.interaction.attribution import affine_coefficients
from torch_ebip.interaction.bounds import Bounds
from torch_ebip.interaction.doubt import Doubt
from torch_ebip.interaction.forecast import Forecast, Phases, as_phases, as_seconds_ahead
from torch_ebip.interaction.pace.phase_bank import PhaseBank
from torch_ebip.interaction.pace.waiting import Waits
from torch_ebip.interaction.phases.phase import PhaseModel
from torch_ebip.interaction.present import Present, present_of
from torch_ebip.interaction.projection import BasisProjection
from torch_ebip.interaction.readout import Lead, Readout, lead_of
from torch_ebip.interaction.recognition import Recognition
from torch_ebip.interaction.surprise import InteractionSurprise
from torch_ebip.interaction.trace import InteractionTrace


class InteractionFilter(Filter):
    """A filter over an `interaction_model`: its states are what moves, the phase first, and the weights.

    Attributes:
        readout: what its forecasts pass through, such as a `HorizonShrinkage`; None: nothing.
        doubt: what they pass through then, where the interaction surprises; None: nothing.
        bounds: and last, what keeps them near what was demonstrated; None: nothing.
        recognition: which labels its demonstrations have; None: none.

    Raises:
        ValueError: a model that is not one of an interaction, or a prior without demonstrations.
    """

    _trace = InteractionTrace
    readout: Readout | None
    doubt: Doubt | None
    bounds: Bounds | None
    recognition: Recognition | None

    def _check(self) -> None:
        """See `Filter._check`."""
        self.readout = self.doubt = self.bounds = self.recognition = None
        self._spread: tuple[Tensor, int, Tensor, list[Tensor]] | None = None
        model = self.model
        if not isinstance(model.dynamics, PhaseModel) or not isinstance(model.measurement, BasisProjection):
            raise ValueError(
                f"an {type(self).__name__} is over a phase model and a basis projection, see `interaction_model`, "
                f"got {type(model.dynamics).__name__} and {type(model.measurement).__name__}"
            )
        if model.dynamics.periodic != model.measurement.basis.periodic:
            raise ValueError("a phase on a circle and a periodic basis go together, such as `CyclicPhase`: got one")
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
        for name in ("readout", "doubt", "bounds"):
            passed = getattr(self, name)
            setattr(self, name, None if passed is None else passed.select(view))

    @eager
    def forecast(self, state: State, phase: Phases | None = None, *, ahead: Phases | None = None) -> Forecast:
        """The trajectory that the state implies, after the `readout`.

        Args:
            state: of this filter.
            phase: [P] or [..., P], or one number; default: 50 phases evenly from the current one to 1, or once round.
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
        if self.readout is None and self.doubt is None and self.bounds is None:
            return forecast
        lead = self.lead(state, forecast.phase, seconds)
        if seconds is not None and (waits := self.waits(state)) is not None:
            lead = lead._replace(gone=waits.gone(seconds))
        mean, variance = self.demonstrated(lead.phase)
        if self.readout is not None:
            present = self.present(state) if self.readout.reads_present else None
            forecast = self.readout(forecast, lead, mean, variance, present)
        if self.doubt is not None:
            forecast = self.doubt(forecast, lead, mean, variance, self.doubted(state))
        return forecast if self.bounds is None else self.bounds(forecast, variance)

    @abstractmethod
    def _forecast(self, state: State, phase: Tensor) -> Forecast:
        """What a state implies at phases [P] or [..., P]."""

    @abstractmethod
    def _forecast_ahead(self, state: State, ahead: Tensor) -> Forecast:
        """What a state implies so many seconds ahead, [P]; infinity is the end."""

    def lead(self, state: State, phase: Tensor, asked: Tensor | None = None) -> Lead:
        """How far ahead of a ``state`` each ``phase`` [..., P] lies, of seconds [P] if those were ``asked`` for."""
        moving = self.moving(state)
        model = self.phase_model
        return lead_of(moving[..., 0], model.velocity(moving), phase, asked, model.periodic)

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
    def present(self, state: State) -> Present:
        """What a state of members says of the present, for a read-out that compares it with demonstrations.

        Args:
            state: of this filter, from `initial_state` on: it must know as which demonstrations its members started.

        Raises:
            ValueError: a state without members, made by hand, or of an update that has no `Recent`.
        """
        memory, recent = getattr(state, "memory", None), self.recent
        if recent is None:
            raise ValueError("nobody remembers what was seen of late: the filter's update has no `Recent`")
        if memory is None or memory.recent is None:
            raise ValueError(
                "a state made by hand does not remember what was seen of late: `initial_state` makes one that does"
            )
        count = len(self.prior.states)  # type: ignore[arg-type]
        found = present_of(state[0][..., 0], memory, recent, count)
        waits = self.waits(state)
        if waits is None:
            return found
        # Who stands still has a velocity that says nothing of where: no demonstration stood there.
        going = (1 - waits.held).unsqueeze(-1)
        return found._replace(line=found.line._replace(moves=found.line.moves * going))

    def doubted(self, state: State) -> Tensor:
        """[...], how surprising the interaction of a ``state`` is of late, see `InteractionSurprise.doubt`."""
        memory, surprise = getattr(state, "memory", None), self.surprise
        if memory is None or memory.surprise is None or surprise is None:
            return torch.zeros_like(self.phase(state))
        return surprise.doubt(memory.surprise)

    @property
    def surprise(self) -> InteractionSurprise | None:
        """What judges sensors and the interaction; None if nothing does."""
        found = getattr(getattr(self, "analysis", None), "surprise", None)
        return found if isinstance(found, InteractionSurprise) else None

    @property
    def recent(self) -> Recent | None:
        """What remembers what was seen of late; None if nothing does."""
        found = getattr(getattr(self, "analysis", None), "recent", None)
        return found if isinstance(found, Recent) else None

    @property
    def pace(self) -> PhaseBank | None:
        """What follows the phase beside the members; None if nothing does."""
        found = getattr(getattr(self, "analysis", None), "pace", getattr(self, "pacing", None))
        return found if isinstance(found, PhaseBank) else None

    def waits(self, state: State) -> Waits | None:
        """Whether the person of a ``state`` stands still; None where nobody looks."""
        held, pace = getattr(getattr(state, "memory", state), "pace", None), self.pace
        return None if held is None or pace is None else pace.waits(held)

    @eager
    def familiarity(self, state: State) -> Tensor:
        """[...], in [0, 1], the chance of a surprise as large as the largest so far in an interaction like those
        demonstrated; NaN where nothing was calibrated.

        Args:
            state: of this filter.
        """
        memory, surprise = getattr(state, "memory", None), self.surprise
        if memory is None or memory.surprise is None or surprise is None:
            return torch.full_like(self.phase(state), torch.nan)
        return surprise.familiarity(memory.surprise)

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
        demonstrations. See `torch_ebip.interaction.attribution`. With an `AnalogueReadout` it is what its analogues
        count, which is one of its two voices.

        Args:
            state: of this filter.

        Returns:
            c, [..., N], summing to 1.

        Raises:
            ValueError: an option moves weights out of the span; says which.
        """
        if isinstance(self.readout, AnalogueReadout):
            speaking: Tensor = self.readout.analogues(self.present(state)).weights
            return speaking
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
        now, periodic = self.phase(state).unsqueeze(-1), self.phase_model.periodic
        part = torch.linspace(0, 1, 50, dtype=now.dtype, device=now.device)
        return now + part if periodic else now.clamp(0, 1) + (1 - now.clamp(0, 1)) * part
