"""The measurement update, step 3 of the paper's box: which parts it has, and the one order in which they act."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.common.modules import sharing
from torch_ebip.filtering.functional import Spread
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.states import Memory
from torch_ebip.filtering.updates.inflation import SpreadRule
from torch_ebip.filtering.updates.localisation import Localisation
from torch_ebip.filtering.updates.pace import Pace
from torch_ebip.filtering.updates.part import Part
from torch_ebip.filtering.updates.recent import Recent
from torch_ebip.filtering.updates.rules import Rule, Stochastic
from torch_ebip.filtering.updates.surprise import Noticed, Surprise, believed
from torch_ebip.filtering.updates.trust import RobustWeights
from torch_ebip.filtering.updates.weighting import Seen, Weighting

if TYPE_CHECKING:
    from torch_ebip.filtering.carriers.carrier import Carrier, Measured


NO_SPREAD = Spread()


class Slots(NamedTuple):
    """The parts of an update, by their places."""

    rule: Rule
    surprise: Surprise | None
    trust: tuple[RobustWeights, ...]
    weighting: Weighting | None
    localisation: Localisation | None
    inflation: SpreadRule | None
    recent: Recent | None = None
    pace: Pace | None = None


class Update(nn.Module):
    """What happens at a measurement. Slots, not a list: their order is part of the algebra.

    Args:
        rule: how an innovation moves the members: `Stochastic`, the paper's, or `SquareRoot`.
        surprise: judges sensors by what was expected of them, before anything else does.
        trust: what surprising values count, each on top of those before it: `StudentT`, `Huber`, `Gate`.
        weighting: weighs members by what was seen.
        localisation: factors on the cross-covariances of blocks of the state.
        inflation: what becomes of the anomalies: `Inflation`.
        recent: remembers what was seen of late, for forecasts that compare it: `Recent`.
        pace: holds the clock of the model, and leads members back that are lost, before anything else: `PhaseBank`.

    Example:
        >>> from torch_ebip import Inflation, SquareRoot, StudentT, Update
        >>> update = Update(SquareRoot(), trust=[StudentT()], inflation=Inflation(1.01))
    """

    surprise: Surprise | None
    trust: nn.ModuleList
    weighting: Weighting | None
    localisation: Localisation | None
    inflation: SpreadRule | None
    recent: Recent | None
    pace: Pace | None

    def __init__(
        self,
        rule: Rule | None = None,
        trust: Iterable[RobustWeights] = (),
        weighting: Weighting | None = None,
        localisation: Localisation | None = None,
        inflation: SpreadRule | None = None,
        surprise: Surprise | None = None,
        recent: Recent | None = None,
        pace: Pace | None = None,
    ) -> None:
        super().__init__()
        self.rule = Stochastic() if rule is None else rule
        self.surprise = surprise
        self.trust = nn.ModuleList(trust)
        self.weighting = weighting
        self.localisation = localisation
        self.inflation = inflation
        self.recent = recent
        self.pace = pace

    @property
    def parts(self) -> list[Part]:
        """All that there are, in their order."""
        parts = (
            self.rule,
            self.surprise,
            *self.trust,
            self.weighting,
            self.localisation,
            self.inflation,
            self.recent,
            self.pace,
        )
        return [part for part in parts if isinstance(part, Part)]

    @property
    def leaves_span(self) -> str | None:
        """Why members do not stay in the span of the first ensemble; None if they do."""
        return next((part.leaves_span for part in self.parts if part.leaves_span is not None), None)

    def start(self, members: Tensor, origin: Tensor | None) -> Memory:
        """What is remembered of members [..., E, n] that have seen nothing.

        Args:
            members: [..., E, n], as they start.
            origin: int64 [..., E], as which of the prior's states; None where it does not know.
        """
        weighting = None if self.weighting is None or origin is None else self.weighting.start(origin)
        inflation = None if self.inflation is None else self.inflation.start(members)
        surprise = None if self.surprise is None else self.surprise.start(members)
        recent = None if self.recent is None else self.recent.start(members)
        pace = None if self.pace is None else self.pace.start(members, origin)
        return Memory(weighting, inflation, origin, surprise, recent, pace)

    def complete(self, memory: Memory, members: Tensor) -> Memory:
        """The memory of a state made by hand, with members [..., E, n], as if it had seen nothing."""
        if self.inflation is not None and memory.inflation is None:
            memory = memory._replace(inflation=self.inflation.start(members))
        if self.surprise is not None and memory.surprise is None:
            memory = memory._replace(surprise=self.surprise.start(members))
        if self.recent is not None and memory.recent is None:
            memory = memory._replace(recent=self.recent.start(members))
        if self.pace is not None and memory.pace is None:
            memory = memory._replace(pace=self.pace.start(members, memory.origin))
        return memory

    def elapse(self, memory: Memory, dt: Tensor) -> tuple[Memory, Tensor]:
        """What is left of a memory after dt [...] seconds, and how many of them the model goes through, [...]."""
        memory = self.forget(memory, dt)
        if self.pace is None or memory.pace is None:
            return memory, dt
        pace, seconds = self.pace.elapse(memory.pace, dt)
        return memory._replace(pace=pace), seconds

    def forget(self, memory: Memory, dt: Tensor) -> Memory:
        """What is left of a memory after dt [...] seconds."""
        weighting, surprise, recent = memory.weighting, memory.surprise, memory.recent
        if self.weighting is not None and weighting is not None:
            weighting = self.weighting.forget(weighting, dt)
        if self.surprise is not None and surprise is not None:
            surprise = self.surprise.forget(surprise, dt)
        if self.recent is not None and recent is not None:
            recent = self.recent.forget(recent, dt)
        return memory._replace(weighting=weighting, surprise=surprise, recent=recent)

    def select(self, view: View) -> Update:
        """The update of a view of the model: every part narrows itself."""
        part = sharing(self)
        part.rule = self.rule.select(view)
        part.trust = nn.ModuleList([trust.select(view) for trust in self.trust])  # type: ignore[operator]
        for name in ("surprise", "weighting", "localisation", "inflation", "recent", "pace"):
            slot = getattr(self, name)
            setattr(part, name, None if slot is None else slot.select(view))
        return part

    @property
    def slots(self) -> Slots:
        """The parts by their places."""
        trust: tuple[RobustWeights, ...] = tuple(self.trust)  # type: ignore[arg-type]
        return Slots(
            self.rule, self.surprise, trust, self.weighting, self.localisation, self.inflation, self.recent, self.pace
        )


def analyse(slots: Slots, carrier: Carrier, measured: Measured, perturbations: Tensor | None) -> Tensor:
    """x = x + K (y + eps - h(x)), and what is learned beside it: the one place where the parts are put in order.

    Args:
        slots: the parts.
        carrier: of the members; changed, unless an error is raised.
        measured: what was measured.
        perturbations: standard-normal draws [..., E, K], for `Carrier.move`; None if the rule does not perturb.

    Returns:
        The log-likelihood [...] of what was measured.
    """
    rule, surprise, trust, weighting, localisation, inflation, recent, pace = slots
    memory, counts, spread, taper = carrier.memory, None, NO_SPREAD, None
    observed = measured.observed
    weights, grown, felt, lately = memory.weighting, memory.inflation, memory.surprise, memory.recent
    if surprise is not None or trust:
        noticed = _noticed(carrier, measured)
        if surprise is not None:
            felt, counts = surprise.judge(felt, noticed)
            observed = _not_rejected(observed, counts)
        measured, counts = _trusted(surprise, trust, noticed, measured, counts)
    if pace is not None and memory.pace is not None:
        measured = _counted(measured, pace.counts(memory.pace))
    if weights is not None or lately is not None:
        seen = Seen(measured.y, observed, counts, measured.rows, carrier.moving, carrier.mean, memory.origin)
        weights = weights if weighting is None or weights is None else weighting.learn(weights, seen)
        lately = lately if recent is None or lately is None else recent.learn(lately, seen)
    if inflation is not None:
        spread, grown = inflation(grown, _share(measured, counts))
    if localisation is not None:
        taper = localisation()
    likelihood = carrier.move(rule, measured, taper, spread, perturbations)
    now = Memory(weights, grown, memory.origin, felt, lately, memory.pace)
    if any(after is not before for after, before in zip(now, memory, strict=True)):
        carrier.memory = now
    return likelihood


def _counted(measured: Measured, counts: Tensor | None) -> Measured:
    """A sample of which every value counts so much, [...], in (0, 1]; None: 1."""
    if counts is None:
        return measured
    return measured._replace(deviation=measured.deviation / counts.sqrt().unsqueeze(-1))


def _not_rejected(observed: Tensor | None, counts: Tensor | None) -> Tensor | None:
    """What was observed of sensors that count [..., K] more than nothing; None for all."""
    if counts is None or bool((counts > 0).all()):
        return observed
    return counts > 0 if observed is None else observed & (counts > 0)


def _noticed(carrier: Carrier, measured: Measured) -> Noticed:
    """A sample beside what was expected of it."""
    y, observed = measured.y, measured.observed
    if observed is not None:
        y = torch.where(observed, y, 0)
    return Noticed(y, observed, measured.rows, carrier.expected(), carrier.variance(), carrier.mean)


def _trusted(
    surprise: Surprise | None,
    trust: Sequence[RobustWeights],
    noticed: Noticed,
    measured: Measured,
    total: Tensor | None,
) -> tuple[Measured, Tensor | None]:
    """Values and deviations that deserve belief, and how much each value counts; None: all alike."""
    observed, y, deviation = noticed.observed, noticed.y, measured.deviation
    if surprise is not None and total is not None:
        y, deviation = believed(noticed, deviation, total, surprise.stride)
    for weigh in trust:
        y, deviation, counts = weigh(y, noticed.expected, noticed.variance, deviation)
        total = counts if total is None else total * counts
    if total is None:
        return measured, None
    if observed is not None:
        deviation, total = torch.where(observed, deviation, 0), torch.where(observed, total, 0)
    return measured._replace(y=y, deviation=deviation), total


def _share(measured: Measured, counts: Tensor | None) -> Tensor:
    """What a sample counts, [...], in [0, 1]."""
    if counts is not None:
        return counts.amax(-1)
    if measured.observed is None:
        return measured.y.new_ones(measured.y.shape[:-1])
    return measured.observed.any(-1).to(measured.y)
