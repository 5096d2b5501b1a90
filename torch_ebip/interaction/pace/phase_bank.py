"""A bank of phase hypotheses: where in the interaction a person is, who may pause, go on, start over, or start late.

A point-mass filter (Bucy & Senne 1971; Anderson & Moore 1979, section 8.4) over triples of a demonstration, a phase
on a grid and a mode, going or standing still. It is not linear in anything, and keeps every possibility alive: the
ensemble, which is far more exact where it is right, is led back where it is lost. Given the phase, the weights are
the ensemble's (Rao-Blackwellised: Doucet, de Freitas, Murphy & Russell 2000).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_count, as_number
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.pace import Pace, Placement
from torch_ebip.filtering.updates.weighting import Seen
from torch_ebip.interaction.pace.beginning import begin_of, spread_of
from torch_ebip.interaction.pace.leading import belief_of, placement_of
from torch_ebip.interaction.pace.likeness import Likeness, likeness_of
from torch_ebip.interaction.pace.moves import Moves, moves_of, transition_of
from torch_ebip.interaction.pace.waiting import Waits
from torch_ebip.interaction.pace.whereabouts import Whereabouts, chosen, closed, summed
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.recordings.layout import Layout

SETTINGS = ("stop", "go", "jump", "value", "velocity", "late", "agree")
"""What `PhaseBank` keeps in one tensor."""
LONGEST, STEPS = 0.1, 25
"""s, of a period, and how many an interaction has at least."""
IDLE = 0.1
"""Chance that a person stands still at first."""
MOST_STEPS = 40
"""Of the bank at once, after a silence: longer ones tell no more."""
LEAST_COUNT = 0.02
"""What a sample of a person who stands still counts at least."""
FIRST, DUE, NEARLY = 0.9996, 0.9995, 0.0002
"""Of a period: on the clock at the start, when a step is due, and by how much rounded sums of times may be short."""
SHORTEST, WIDEST = 1e-3, 0.3
"""s, between two values that have a velocity: over longer gaps it is none of the present. Bank and samples may be far
apart in time: periods are `LONGEST` at most, and thinned recordings have less than that many samples."""
APART = 0.05
"""Deviation of the phases where interactions begin, beyond which members are far from each other at first."""
HELD = 0.4, 0.8
"""Probability of standing still from which on the ensemble's clock is held, and from which on altogether: it would be
behind if it were held a little all the time."""


class PhaseBank(Pace):
    """Probabilities p of (mode, demonstration j, phase f), from one period to the next:

    - of those that go a share 1 - exp(-stop t) stands still, of those that stand 1 - exp(-go t) goes on;
    - who goes is ahead by r v_j t, v_j the demonstration's phase velocity, r one of `RATES`;
    - a share 1 - exp(-jump t) is anywhere, half of it where an interaction begins;
    - all are weighed by exp(-t/2 sum_s (value min(d_s, cap) + velocity min(e_s, cap))) over sensors s, where d_s is
      the mean over DoFs of (x - f_j)^2 / q and e_s that of (u - r f'_j v_j)^2 / q', with the r between the least and
      the largest of `RATES` that fits best; of who stands that of u^2 / q'. x, u are values and velocities of late.

    q and q' are mean squared distances of a demonstration from the nearest other one, and what noise adds, see
    `Likeness`. A sensor that lies counts ``cap`` at most, for all hypotheses alike.

    Where the bank's phase is more than ``agree`` deviations from the ensemble's, the ensemble is led towards it.

    Args:
        likeness: what is compared.
        pace: [N], v_j, 1/s.
        which: int64 [N], which of the prior's states they are.
        n_dofs: D, of the layout.
        n_all: how many states the prior has.
        begin: [P], probability of each phase where an interaction begins; default: at phase 0.
        stop: times a second that a person stops.
        go: times a second that one who stands goes on.
        jump: times a second that a person starts over, or is somewhere else.
        value, velocity: times a second that values and velocities of a sensor count; samples of one person err alike.
        late: chance that a person was under way before anybody looked: anywhere.
        agree: deviations by which the phases of bank and ensemble may differ.
        period: s, between steps of the bank.

    Raises:
        ValueError: rates that are not positive, a chance that is not between 0 and 1.
    """

    settings: Tensor
    which: Tensor
    columns: Tensor
    transition: Tensor
    begin: Tensor

    def __init__(
        self,
        likeness: Likeness,
        pace: Tensor,
        which: Tensor,
        n_dofs: int,
        n_all: int,
        begin: Tensor | None = None,
        stop: float = 0.3,
        go: float = 1.0,
        jump: float = 0.02,
        value: float = 5.0,
        velocity: float = 15.0,
        late: float = 0.03,
        agree: float = 1.0,
        period: float = 0.1,
    ) -> None:
        super().__init__()
        numbers = dict(zip(SETTINGS, (stop, go, jump, value, velocity, late, agree), strict=True))
        for name, number in numbers.items():
            as_number(name, number, 0, above=True)
        if not late < 1:
            raise ValueError(f"late must lie between 0 and 1, got {late}")
        self.period = as_number("period", period, 0, above=True, of="of seconds")
        self.likeness = likeness
        self.register_buffer("settings", pace.new_tensor(list(numbers.values())))
        self.register_buffer("which", owned(which), persistent=False)
        self.n_dofs, self.n_all = n_dofs, n_all
        self.register_buffer("columns", torch.arange(n_dofs, device=pace.device), persistent=False)
        moves = transition_of(pace, likeness.n_phases, self.period, likeness.periodic)
        self.register_buffer("transition", moves, persistent=False)
        begin = (likeness.phases == 0).to(pace) if begin is None else begin
        self.register_buffer("begin", owned(begin), persistent=False)
        self.narrows = likeness.periodic or spread_of(begin, likeness.phases) > APART
        self._settled: tuple[Tensor, int, Moves] | None = None

    @classmethod
    def of(cls, primitive: InteractionPrimitive, phases: int = 25, most: int = 40, **settings: float) -> PhaseBank:
        """The bank of a primitive's demonstrations, compared by all that is not controlled.

        Args:
            primitive: of the demonstrations.
            phases: P, of the grid.
            most: N at most, of demonstrations: those that differ most.
            settings: see `PhaseBank`; the period is `LONGEST` at most, and one of `STEPS` of an interaction.
        """
        likeness, which = likeness_of(primitive, as_count("phases", phases, 2), as_count("most", most, 1))
        begin = begin_of(primitive.first_phase, likeness.phases, likeness.periodic)
        usual = 1 / float(primitive.phase_velocity.mean())
        settings = {"period": min(LONGEST, usual / STEPS), **settings}
        return cls(
            likeness,
            primitive.phase_velocity[which],
            which,
            primitive.layout.n_dofs,
            len(primitive),
            begin,
            **settings,
        )

    def check(self, model: StateSpace) -> None:
        """See `Part.check`: it is for as many DoFs as the model has."""
        if len(self.columns) != model.n_dofs:
            raise ValueError(f"the phase bank is of {len(self.columns)} DoFs, the model has {model.n_dofs}")

    def select(self, view: View) -> PhaseBank:
        """See `Part.select`."""
        part = sharing(self)
        part.register_buffer("columns", self.columns[view.dofs], persistent=False)
        return part

    def start(self, members: Tensor, origin: Tensor | None, known: Tensor | None = None) -> Whereabouts:
        """See `Pace.start`: hypotheses are demonstrations that are known."""
        batch, N = members.shape[:-2], len(self.which)
        own = members.new_ones(*batch, N)
        if known is None and origin is not None:
            known = members.new_zeros(*batch, self.n_all).scatter(-1, origin.expand(*batch, -1), 1.0) > 0
        if known is not None:
            if known.shape[-1] != self.n_all:
                raise ValueError(f"known must be bool [..., {self.n_all}], got {list(known.shape)}")
            own = known.to(members).expand(*batch, -1).index_select(-1, self.which)
            own = torch.where(own.any(-1, keepdim=True), own, 1.0)  # none of the bank's: then all
        own = own / own.sum(-1, keepdim=True)
        late = self.settings[5]
        none = members.new_zeros(batch)
        sums = members.new_zeros(*batch, 3, self.n_dofs)
        anywhere = 0.5 * (self._begin(own, late * 0) + self._begin(own, late * 0 + 1))
        # The first sample is due at once, and nobody has moved by then.
        return Whereabouts(self._begin(own, late), anywhere, sums, sums, none + IDLE, none + FIRST * self.period)

    def _begin(self, own: Tensor, late: Tensor) -> Tensor:
        """[..., N, 2 P], where those of demonstrations [..., N] begin: see ``begin``; a share of them anywhere."""
        place = (1 - late) * self.begin + late / len(self.begin)
        return own.unsqueeze(-1) * torch.cat([(1 - IDLE) * place, IDLE * place])

    def elapse(self, memory: Whereabouts, dt: Tensor) -> tuple[Whereabouts, Tensor]:
        """See `Pace.elapse`."""
        gone = dt
        if bool((memory.standing > HELD[0]).any()):
            gone = dt * (1 - self.held(memory))
        return memory._replace(clock=memory.clock + dt), gone

    def waits(self, memory: Whereabouts) -> Waits:
        """For how long a person who stands still will."""
        return Waits(self.held(memory), self.settings[1])

    def held(self, memory: Whereabouts) -> Tensor:
        """[...], in [0, 1], how far a person is believed to stand still: the ensemble's clock is held by as much."""
        rate, usual = self._moves().slowness
        standing = usual + (memory.standing - usual) * torch.exp(-rate * memory.clock)
        held: Tensor = ((standing - HELD[0]) / (HELD[1] - HELD[0])).clamp(0, 1)
        return held

    def counts(self, memory: Whereabouts) -> Tensor | None:
        """See `Pace.counts`."""
        if not bool((memory.standing > HELD[0]).any()):
            return None
        return (1 - self.held(memory)).clamp(min=LEAST_COUNT)

    def notice(self, memory: Whereabouts, seen: Seen) -> tuple[Whereabouts, Placement | None]:
        """See `Pace.notice`."""
        columns = self.columns if seen.rows is None else self.columns[seen.rows]
        kept = memory._replace(sums=summed(memory, seen, columns))
        some = memory.clock >= DUE * self.period
        if seen.observed is not None:
            some = some & seen.observed.any(-1)
        if not bool(some.any()):
            return kept, None
        steps = (memory.clock / self.period + NEARLY).floor()
        weight, distance, moves = self._weight(kept)
        share = self._passed(memory, steps) * weight
        share = share / share.sum((-2, -1), keepdim=True)
        moments = share.sum(-2) @ self._moves().moments
        clock = torch.where(steps > 0, memory.clock - steps * self.period, 0)
        stepped = Whereabouts(share, memory.anywhere, memory.sums * 0, closed(kept, clock), moments[..., 2], clock)
        if not bool(some.all()):
            stepped = Whereabouts(*(chosen(some, new, old) for new, old in zip(stepped, kept, strict=True)))
        P = distance.shape[-1]
        strange = ((share[..., :P] + share[..., P:]) * distance).sum((-2, -1))
        # Where somebody is whose velocity nobody knows is guessed: after a silence the ensemble knows better.
        news = some * moves
        belief = belief_of(moments, self.likeness.phases, self.likeness.periodic)
        agree, periodic = self.settings[6], self.likeness.periodic
        return stepped, placement_of(belief, strange, news, seen, agree, periodic, self.narrows)

    def _passed(self, memory: Whereabouts, steps: Tensor) -> Tensor:
        """Shares [..., N, 2 P] after so many steps [...]."""
        passes, leap = self._moves()[:2]
        share, N = memory.share, len(self.which)
        most = min(int(steps.max()), MOST_STEPS)
        alike = bool((steps == most).all())
        for k in range(most):
            flat = share.reshape(-1, N, share.shape[-1]).transpose(0, 1)
            after = torch.bmm(flat, passes).transpose(0, 1).reshape(share.shape)
            after = torch.addcmul(after, leap, memory.anywhere)
            share = after if alike else torch.where((k < steps)[..., None, None], after, share)
        return share

    def _weight(self, memory: Whereabouts) -> tuple[Tensor, Tensor, Tensor]:
        """[..., N, 2 P], what each hypothesis makes of the samples that a memory holds, the best has 1; how far they
        are from each, [..., N, P]; and the share of the DoFs seen whose velocity is known, [...]."""
        like, D = self.likeness, self.n_dofs
        batch = memory.clock.shape
        both = torch.cat([memory.sums, memory.before], -2).view(-1, 6, D)
        placed = both.index_select(-1, like.order.flatten()).view(-1, 6, *like.order.shape)
        number, time, value, former, older, before = placed.unbind(1)
        there, number = number.clamp(max=1), number.clamp(min=1)
        value, gap = value / number, time / number + older
        moves = there * former * ((gap > SHORTEST) & (gap < WIDEST))
        velocity = moves * (value - before) / gap.clamp(min=SHORTEST)
        strength = self.period * self.settings[3:5]
        log, distance = like(there * (value - like.middle), velocity, torch.stack([there, moves]), strength)
        weight = torch.exp(log - log.amax((-2, -1), keepdim=True))
        real = like.precision[0] > 0
        share = (moves * real).sum((-2, -1)) / (there * real).sum((-2, -1)).clamp(min=1)
        return weight.view(*batch, *log.shape[-2:]), distance.view(*batch, *distance.shape[-2:]), share.view(batch)

    def belief(self, memory: Whereabouts) -> tuple[Tensor, Tensor]:
        """Mean and deviation of the phase, [...] each, by what the bank remembers."""
        moments = memory.share.sum(-2) @ self._moves().moments
        return belief_of(moments, self.likeness.phases, self.likeness.periodic)

    def _moves(self) -> Moves:
        """What depends on the settings alone, kept while they stay as they are."""
        settings, known = self.settings, self._settled
        version = -1 if settings.is_inference() else settings._version
        if known is None or version < 0 or known[0] is not settings or known[1] != version:
            phases, periodic = self.likeness.phases, self.likeness.periodic
            made = moves_of(settings[:3], self.transition, phases, self.period, periodic)
            self._settled = known = settings, version, made
        return known[2]

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have nothing kept."""
        return {**self.__dict__, "_settled": None}

    def named_values(self, layout: Layout) -> dict[str, float]:
        """See `Part.named_values`: ``pace/...``."""
        return {f"pace/{name}": value for name, value in zip(SETTINGS, self.settings.tolist(), strict=True)}

    def extra_repr(self) -> str:
        """Sizes."""
        return f"{len(self.which)} demonstrations, {self.likeness.n_phases} phases, every {self.period:g} s"

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return f"period={self.period:g}"
