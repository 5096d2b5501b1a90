"""A bank of phase hypotheses: where in the interaction a person is, who may pause, go on, start over, or start late.

A point-mass filter (Bucy & Senne 1971; Anderson & Moore 1979, section 8.4) over triples of a demonstration, a phase
on a grid and a mode, going or standing still. It is not linear in anything, and keeps every possibility alive: the
ensemble, which is far more exact where it is right, is led back where it is lost. Given the phase, the weights are
the ensemble's (Rao-Blackwellised: Doucet, de Freitas, Murphy & Russell 2000).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_count, as_number
from torch_ebip.common.brief import brief
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.pace import Pace, Placement
from torch_ebip.filtering.updates.weighting import Seen
from torch_ebip.interaction.likeness import Likeness, likeness_of
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.recordings.layout import Layout

SETTINGS = ("stop", "go", "jump", "value", "velocity", "late")
"""What `PhaseBank` keeps in one tensor."""
RATES = (0.35, 0.6, 0.85, 1.0, 1.2, 1.6, 2.2, 3.0)
"""Of a person, as multiples of a demonstration's phase velocity."""
CHANCES = (0.04, 0.1, 0.2, 0.3, 0.2, 0.1, 0.04, 0.02)
"""Of these, at each step anew: a person's pace changes."""
IDLE = 0.1
"""Chance that a person stands still at first."""
MOST_STEPS = 40
"""Of the bank at once, after a silence: longer ones tell no more."""
LEAST_COUNT = 0.02
"""What a sample of a person who stands still counts at least."""
FLOOR = 0.02
"""Deviation of the phase, beside those of ensemble and bank, within which the two agree."""
ANEW = 0.2
"""Phases by which an ensemble was wrong when all is forgotten that it has learned; of less a part is."""
HELD = 0.4, 0.8
"""Probability of standing still from which on the ensemble's clock is held, and from which on altogether: it would be
behind if it were held a little all the time."""
AGREE, DIFFER = 1.0, 3.0
"""Deviations apart up to which the ensemble is believed, and from which on the bank."""


class Whereabouts(NamedTuple):
    """What a state remembers of N demonstrations at P phases, of all D DoFs of the layout.

    Attributes:
        share: [..., 2, N, P], probability of going and standing at each, summing to 1.
        own: [..., N], which demonstrations are hypotheses: those of the ensemble, summing to 1.
        sums: [..., 6, D], of samples of this period their number, ages and values; of the last one that had any 1,
            their mean age and value.
        standing: [...], probability at the last step.
        clock: [...], s since then; infinity: there was none.
    """

    share: Tensor
    own: Tensor
    sums: Tensor
    standing: Tensor
    clock: Tensor

    def __repr__(self) -> str:
        return brief(self)


class PhaseBank(Pace):
    """Probabilities p of (mode, demonstration j, phase f), from one period to the next:

    - of those that go a share 1 - exp(-stop t) stands still, of those that stand 1 - exp(-go t) goes on;
    - who goes is ahead by r v_j t, v_j the demonstration's phase velocity, r one of `RATES`;
    - a share 1 - exp(-jump t) is anywhere, half of it where an interaction begins;
    - all are weighed by exp(-1/2 sum_s (value min(d_s, cap) + velocity min(e_s, cap))) over sensors s, where d_s is
      the mean over DoFs of (x - f_j)^2 / q and e_s that of (u - r f'_j v_j)^2 / q', with the r between the least and
      the largest of `RATES` that fits best; of who stands that of u^2 / q'. x, u are values and velocities of late.

    q and q' are mean squared distances of a demonstration from the nearest other one, and what noise adds, see
    `Likeness`. A sensor that lies counts ``cap`` at most, for all hypotheses alike.

    Where the bank's phase is more than `AGREE` deviations from the ensemble's, the ensemble is led towards it.

    Args:
        likeness: what is compared.
        pace: [N], v_j, 1/s.
        which: int64 [N], which of the prior's states they are.
        centre: [D], near which values lie, units of the DoFs.
        stop: times a second that a person stops.
        go: times a second that one who stands goes on.
        jump: times a second that a person starts over, or is somewhere else.
        value, velocity: what a period's values and velocities of a sensor count; samples of one person err alike.
        late: chance that a person was under way before anybody looked: anywhere.
        period: s, between steps of the bank.

    Raises:
        ValueError: rates that are not positive, a chance that is not between 0 and 1.
    """

    settings: Tensor
    which: Tensor
    centre: Tensor
    columns: Tensor
    transition: Tensor

    def __init__(
        self,
        likeness: Likeness,
        pace: Tensor,
        which: Tensor,
        centre: Tensor,
        stop: float = 0.3,
        go: float = 1.0,
        jump: float = 0.02,
        value: float = 0.3,
        velocity: float = 1.0,
        late: float = 0.03,
        period: float = 0.05,
    ) -> None:
        super().__init__()
        numbers = dict(zip(SETTINGS, (stop, go, jump, value, velocity, late), strict=True))
        for name, number in numbers.items():
            as_number(name, number, 0, above=True)
        if not late < 1:
            raise ValueError(f"late must lie between 0 and 1, got {late}")
        self.period = as_number("period", period, 0, above=True, of="of seconds")
        self.likeness = likeness
        self.register_buffer("settings", centre.new_tensor(list(numbers.values())))
        self.register_buffer("which", owned(which), persistent=False)
        self.register_buffer("centre", owned(centre), persistent=False)
        self.register_buffer("columns", torch.arange(len(centre), device=centre.device), persistent=False)
        moves = transition_of(pace, likeness.n_phases, self.period)
        self.register_buffer("transition", moves, persistent=False)

    @classmethod
    def of(cls, primitive: InteractionPrimitive, phases: int = 25, most: int = 60, **settings: float) -> PhaseBank:
        """The bank of a primitive's demonstrations, compared by all that is not controlled.

        Args:
            primitive: of the demonstrations.
            phases: P, of the grid.
            most: N at most, of demonstrations: those that differ most.
            settings: see `PhaseBank`.
        """
        likeness, which = likeness_of(primitive, as_count("phases", phases, 2), as_count("most", most, 1))
        weights = primitive.weights
        middle = primitive.basis.project(weights.new_full((), 0.5), weights.mean(0))
        return cls(likeness, primitive.phase_velocity[which], which, middle, **settings)

    def check(self, model: StateSpace) -> None:
        """See `Part.check`: it is for as many DoFs as the model has."""
        if len(self.columns) != model.n_dofs:
            raise ValueError(f"the phase bank is of {len(self.columns)} DoFs, the model has {model.n_dofs}")

    def select(self, view: View) -> PhaseBank:
        """See `Part.select`."""
        part = sharing(self)
        part.register_buffer("columns", self.columns[view.dofs], persistent=False)
        return part

    def start(self, members: Tensor, origin: Tensor | None) -> Whereabouts:
        """See `Pace.start`: hypotheses are the demonstrations of the ensemble."""
        batch, N = members.shape[:-2], len(self.which)
        own = members.new_ones(*batch, N)
        if origin is not None:
            count = 1 + max(int(self.which.max()), int(origin.max()))
            there = members.new_zeros(*batch, count).scatter(-1, origin.expand(*batch, -1), 1.0)
            own = there.index_select(-1, self.which)
            own = torch.where(own.any(-1, keepdim=True), own, 1.0)  # none of the bank's: then all
        own = own / own.sum(-1, keepdim=True)
        share = self._first(own, self.settings[5])
        none = members.new_zeros(batch)
        sums = members.new_zeros(*batch, 6, len(self.centre))
        return Whereabouts(share, own, sums, none + IDLE, none + torch.inf)

    def _first(self, own: Tensor, late: Tensor | float) -> Tensor:
        """[..., 2, N, P], where an interaction of demonstrations [..., N] begins: at phase 0; if late, anywhere."""
        P = self.likeness.n_phases
        anywhere = own.new_full((P,), 1.0) * late / P
        begin = torch.cat([anywhere[:1] + (1 - late), anywhere[1:]])
        modes = own.new_tensor([1 - IDLE, IDLE])
        return modes[:, None, None] * own[..., None, :, None] * begin

    def elapse(self, memory: Whereabouts, dt: Tensor) -> tuple[Whereabouts, Tensor]:
        """See `Pace.elapse`."""
        going = 1 - self.held(memory)
        step = dt.unsqueeze(-1).unsqueeze(-1)
        older = memory.sums[..., (0, 3), :] * step
        sums = memory.sums.index_add(-2, torch.tensor([1, 4], device=older.device), older)
        return memory._replace(sums=sums, clock=memory.clock + dt), dt * going

    def standing(self, memory: Whereabouts) -> Tensor:
        """[...], probability that a person stands still now."""
        stop, go = self.settings[0], self.settings[1]
        usual = stop / (stop + go)
        gone = torch.where(memory.clock.isinf(), 0, memory.clock)
        return usual + (memory.standing - usual) * torch.exp(-(stop + go) * gone)

    def held(self, memory: Whereabouts) -> Tensor:
        """[...], in [0, 1], how far a person is believed to stand still: the ensemble's clock is held by as much."""
        return ((self.standing(memory) - HELD[0]) / (HELD[1] - HELD[0])).clamp(0, 1)

    def resting(self, memory: Whereabouts) -> Tensor:
        """[...], s until a person goes on."""
        return self.held(memory) / self.settings[1]

    def gone(self, memory: Whereabouts, seconds: Tensor) -> Tensor:
        """[..., P], s, how long of so many seconds [P] a person goes, on the average; infinity is infinity."""
        go, end = self.settings[1], seconds.isinf()
        finite = torch.where(end, 0, seconds)
        waiting = finite - (1 - torch.exp(-go * finite)) / go
        return torch.where(end, seconds, torch.lerp(finite, waiting, self.held(memory).unsqueeze(-1)))

    def gone_apart(self, memory: Whereabouts, seconds: Tensor, count: int) -> Tensor:
        """[..., P, E], as `gone`, each of E members in a case of its own: it goes, or waits for a time of its own."""
        held, go = self.held(memory)[..., None, None], self.settings[1]
        # Evenly spread, and in no order that demonstrations might have.
        place = (torch.arange(count, device=held.device, dtype=held.dtype) + 0.5) * 0.6180339887498949 % 1
        waits = place < held
        part = torch.where(waits, place / torch.where(held > 0, held, 1), 0).clamp(max=1 - 1e-6)
        rest = torch.where(waits, -torch.log1p(-part) / go, 0)
        return (seconds.unsqueeze(-1) - rest).clamp(min=0)

    def counts(self, memory: Whereabouts) -> Tensor:
        """See `Pace.counts`."""
        return (1 - self.held(memory)).clamp(min=LEAST_COUNT)

    def notice(self, memory: Whereabouts, seen: Seen) -> tuple[Whereabouts, Placement | None]:
        """See `Pace.notice`."""
        sums = self._summed(memory.sums, seen)
        due = memory.clock >= self.period * (1 - 1e-4)
        some = due if seen.observed is None else due & seen.observed.any(-1)
        if not bool(some.any()):
            return memory._replace(sums=sums), None
        fresh = memory.clock.isinf()
        clock = torch.where(fresh, 0, memory.clock)
        steps = (clock / self.period + 1e-4).floor()
        share = self._passed(memory, steps)
        share = share * self._weight(sums)
        share = share / share.sum((-3, -2, -1), keepdim=True)
        now = sums[..., :3, :]
        there = now[..., :1, :] > 0
        number = torch.where(there, now[..., :1, :], 1)
        last = torch.where(there, torch.cat([there.to(now), now[..., 1:, :] / number], -2), sums[..., 3:, :])
        stepped = Whereabouts(
            share,
            memory.own,
            torch.cat([torch.zeros_like(now), last], -2),
            share[..., 1, :, :].sum((-2, -1)),
            (clock - steps * self.period).clamp(min=0),
        )
        kept = memory._replace(sums=sums)
        stepped = Whereabouts(*(_where(some, new, old) for new, old in zip(stepped, kept, strict=True)))
        return stepped, self._placement(stepped, some, seen)

    def _summed(self, sums: Tensor, seen: Seen) -> Tensor:
        """Sums [..., 6, D] with a sample."""
        columns = self.columns if seen.rows is None else self.columns[seen.rows]
        y = seen.y if seen.observed is None else torch.where(seen.observed, seen.y, 0)
        one = torch.ones_like(y) if seen.observed is None else seen.observed.to(y)
        none = torch.zeros_like(y)
        added = torch.stack([one, none, one * (y - self.centre[columns]), none, none, none], -2)
        if added.ndim < sums.ndim:
            added = added.expand(*sums.shape[:-2], *added.shape[-2:])
        return sums.index_add(-1, columns, added)

    def _passed(self, memory: Whereabouts, steps: Tensor) -> Tensor:
        """Shares [..., 2, N, P] after so many steps [...]."""
        stop, go, jump = (1 - torch.exp(-self.settings[:3] * self.period)).unbind()
        anywhere = 0.5 * (self._first(memory.own, 0.0) + self._first(memory.own, 1.0))
        share, N = memory.share, len(self.which)
        for k in range(min(int(steps.max()), MOST_STEPS)):
            going, standing = share.unbind(-3)
            flat = going.reshape(-1, N, going.shape[-1]).transpose(0, 1)
            moved = torch.bmm(flat, self.transition).transpose(0, 1).reshape(going.shape)
            after = torch.stack([(1 - stop) * moved + go * standing, (1 - go) * standing + stop * moved], -3)
            share = torch.where((k < steps)[..., None, None, None], torch.lerp(after, anywhere, jump), share)
        return share

    def _weight(self, sums: Tensor) -> Tensor:
        """[..., 2, N, P], what each hypothesis makes of the samples in sums [..., 6, D]; the best near 1."""
        number, age, value, before, older, former = sums.unbind(-2)
        there = number > 0
        number = torch.where(there, number, 1)
        value, age = value / number, age / number
        gap = older - age
        moves = there & (before > 0) & (gap > 1e-3)
        velocity = torch.where(moves, value - former, 0) / torch.where(moves, gap, 1)
        strength = self.settings[3], self.settings[4]
        log = self.likeness(value + self.centre, velocity, there, moves, *strength, (RATES[0], RATES[-1]))
        return torch.exp(log - log.amax((-3, -2, -1), keepdim=True))

    def belief(self, memory: Whereabouts) -> tuple[Tensor, Tensor]:
        """Mean and deviation of the phase, [...] each, by what the bank remembers."""
        phases = self.likeness.phases
        share = memory.share.sum((-3, -2))
        mean = share @ phases
        variance = (share * (phases - mean.unsqueeze(-1)).square()).sum(-1)
        return mean, variance.clamp(min=0.25 * phases[1].square()).sqrt()

    def _placement(self, memory: Whereabouts, some: Tensor, seen: Seen) -> Placement:
        """Where members are led, of those entries of a batch of which there is ``some`` news, bool [...]."""
        mean, deviation = self.belief(memory)
        phase, centre = seen.moving[..., 0], seen.mean[..., 0]
        spread = (phase - centre.unsqueeze(-1)).square().mean(-1).sqrt()
        apart = mean - centre
        far = apart.abs() / (deviation.square() + spread.square() + FLOOR**2).sqrt()
        share = torch.where(some, ((far - AGREE) / (DIFFER - AGREE)).clamp(0, 1), 0)
        wider = (deviation / spread.clamp(min=1e-6)).clamp(min=1)
        offset, stretch = torch.zeros_like(seen.mean), torch.ones_like(seen.mean)
        offset[..., 0], stretch[..., 0] = share * apart, 1 + share * (wider - 1)
        return Placement(offset, stretch, share * (apart.abs() / ANEW).clamp(max=1))

    def named_values(self, layout: Layout) -> dict[str, float]:
        """See `Part.named_values`: ``pace/...``."""
        return {f"pace/{name}": value for name, value in zip(SETTINGS, self.settings.tolist(), strict=True)}

    def extra_repr(self) -> str:
        """Sizes."""
        return f"{len(self.which)} demonstrations, {self.likeness.n_phases} phases, every {self.period:g} s"

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return f"period={self.period:g}"


def transition_of(pace: Tensor, phases: int, period: float) -> Tensor:
    """[N, P, P], where of P phases who goes is after a period from each; behind the last is the last.

    Args:
        pace: [N], phase velocities, 1/s.
        phases: P.
        period: s.
    """
    rates, chances = pace.new_tensor(RATES), pace.new_tensor(CHANCES)
    places = torch.arange(phases, device=pace.device, dtype=pace.dtype)
    ahead = pace[:, None] * period * (phases - 1) * rates  # [N, rates], in cells
    at = (places[:, None] + ahead[:, None, :]).clamp(max=phases - 1)  # [N, P, rates]
    low = at.floor().clamp(max=phases - 2)
    moves = pace.new_zeros(len(pace), phases, phases)
    for cell, part in ((low, 1 - (at - low)), (low + 1, at - low)):
        moves.scatter_add_(-1, cell.long(), part * chances)
    return moves / moves.sum(-1, keepdim=True)


def _where(some: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """``new`` [..., *] of some entries of a batch, bool [...], of the others ``old``."""
    if bool(some.all()):
        return new
    return torch.where(some.reshape(*some.shape, *[1] * (new.ndim - some.ndim)), new, old)
