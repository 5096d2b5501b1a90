"""Analogues: the demonstrations that were, at some phase, where the interaction is now; and what came of them.

Forecasts of a filter are linear in its members. A weighted mean over demonstrations, with weights by how near each is
to the present, bends: the analogue method of meteorology (Lorenz 1969; Delle Monache et al. 2013), kernel regression
(Nadaraya 1964; Watson 1964) over pairs of a demonstration and a phase. Here the filter says how likely each phase is,
and how much each demonstration explained so far; what near means is learned.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import outside_inference, owned
from torch_ebip.common.arguments import as_number
from torch_ebip.common.brief import brief
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.noise.constraints import Positive, Signed
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.recent import Line
from torch_ebip.interaction.compared import Compared, compared_of
from torch_ebip.interaction.course import apart, ends, within
from torch_ebip.interaction.present import Present
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.readout import Lead
from torch_ebip.interaction.table import DemonstrationTable

START = (60.0, 6.0)
"""Relevance of value and velocity at the start, of all sensors together."""
MEMORY = 0.27
"""Power of the filter's weights at the start."""
LEAST = 0.012
"""Deviation of the phase that is never gone below: half of what lies between the phases of the table."""
REACH = 5.0
"""Deviations of the phase beyond which a pair has no say."""
LEAST_SAY = 1e-9
"""Weight of a demonstration from which it is asked where it would be."""
UNLIKE = 0.1
"""Analogues that the chance counts for that an interaction is like none: 1 in 11 where one has all weight."""
PORTION = 1 << 24
"""Numbers that are held at once."""


class Analogy(NamedTuple):
    """Which demonstrations the present is like.

    Attributes:
        weights: [..., N], summing to 1.
        phase: [..., N], where each of them would be.
        wide: [..., N], summing to 1, by which a forecast is as wide as it is: some of it is of all alike.
    """

    weights: Tensor
    phase: Tensor
    wide: Tensor

    def __repr__(self) -> str:
        return brief(self)


class Analogues(nn.Module):
    """Weights of pairs (demonstration j, phase p): their logarithm is, up to a constant,

        m log w_j - (p - phase)^2 / (2 s^2) - 1/2 sum_gd c_gd r_gd exp(t_g (phase - 1/2)) (x_gd - f_gdj(p))^2,

    w_j what the filter's members that started as j count; phase (held within 0 and 1) and s its belief, s times a
    factor; x the present, g its value or its velocity, in deviations over the demonstrations; f those of the
    demonstrations; c_gd the share of a DoF in its sensor, 0 where it was not seen of late. m, r, t and the factor are
    learned. What no sensor shows is left out, so that one set of parameters serves any set of sensors.

    Args:
        table: of the N demonstrations.
        pace: [N], their phase velocities, 1/s.
        scale: [2, D], deviations of values and velocities over the demonstrations, units of the DoFs, and a second.
        modality_of_dof: int64 [D].
        compared: bool [D], the DoFs that are.
        unlike: u, above or equal to 0: with n analogues that count (1 / sum w^2), the interaction is like none of
            them with chance u / (u + n), and a forecast as wide as that makes it. Without it one that holds all
            weight would be sure of all it says.

    Raises:
        ValueError: shapes that do not fit; no DoF that is compared; a negative u.

    Example:
        >>> import torch
        >>> from torch_ebip import InteractionPrimitive
        >>> from torch_ebip.interaction.analogues import Analogues
        >>> from torch_ebip.recordings import example
        >>> Analogues.of(InteractionPrimitive.fit(example())).extra_repr()
        '30 demonstrations, 41 phases, compares 5 DoFs'
    """

    pace: Tensor
    scale: Tensor
    modality_of_dof: Tensor
    dofs: Tensor
    rows: Tensor

    def __init__(
        self,
        table: DemonstrationTable,
        pace: Tensor,
        scale: Tensor,
        modality_of_dof: Tensor,
        compared: Tensor,
        unlike: float = UNLIKE,
    ) -> None:
        super().__init__()
        self.unlike = as_number("unlike", unlike, 0)
        N, _, _, D = table.cells.shape
        if pace.shape != (N,) or scale.shape != (2, D) or modality_of_dof.shape != (D,) or compared.shape != (D,):
            raise ValueError(
                f"pace, scale, modality_of_dof and compared must be [{N}], [2, {D}], [{D}] and [{D}], got "
                f"{list(pace.shape)}, {list(scale.shape)}, {list(modality_of_dof.shape)} and {list(compared.shape)}"
            )
        dofs = compared.nonzero().squeeze(-1).to(scale.device)
        if not len(dofs):
            raise ValueError("no DoF is compared: name at least one that a sensor shows")
        self.table = table
        self.register_buffer("pace", owned(pace))
        self.register_buffer("scale", owned(scale[:, dofs]))
        self.register_buffer("modality_of_dof", owned(modality_of_dof.to(scale.device)[dofs]))
        self.register_buffer("dofs", dofs, persistent=False)
        self.register_buffer("rows", torch.arange(D, device=scale.device), persistent=False)
        sensors = len(set(self.modality_of_dof.tolist()))
        start = scale.new_tensor(START).unsqueeze(-1).expand(-1, len(dofs)) / sensors
        self.relevance = Positive(start)
        self.tilt = Signed(scale.new_zeros(2))
        self.memory = Positive(scale.new_tensor(MEMORY))
        self.looseness = Positive(scale.new_tensor(1.0))
        self._kept: tuple[list[tuple[Tensor, int]], Compared] | None = None

    @classmethod
    def of(cls, primitive: InteractionPrimitive, compared: Tensor | None = None, unlike: float = UNLIKE) -> Analogues:
        """Those of a primitive's demonstrations.

        Args:
            primitive: of the demonstrations.
            compared: bool [D]; default: the DoFs that are not controlled.
            unlike: see `Analogues`.
        """
        layout, weights = primitive.layout, primitive.weights
        table = DemonstrationTable.of(primitive)
        compared = ~layout.controlled if compared is None else compared
        pace = primitive.phase_velocity
        velocity = table.slopes * pace[:, None, None]
        scale = torch.stack([primitive.value_variance.clamp(min=0).sqrt(), velocity.flatten(0, 1).std(0)])
        return cls(table, pace, scale.to(weights), layout.modality_of_dof, compared, unlike)

    def _compared(self) -> Compared:
        """Kept while what they are made of stays as it is."""
        sources = (self.table.cells, self.pace, self.scale)
        versions = [(source, -1 if source.is_inference() else source._version) for source in sources]
        kept = self._kept  # another thread may exchange it
        if kept is None or any(
            ours is not theirs or now != then or now < 0
            for (ours, now), (theirs, then) in zip(versions, kept[0], strict=True)
        ):
            made = compared_of(self.table, self.pace, self.scale, self.dofs, self.modality_of_dof)
            self._kept = kept = versions, made
        return Compared(*(outside_inference(part) for part in kept[1]))

    def forward(self, present: Present) -> Analogy:
        """Which demonstrations the present [...] is like; differentiable.

        Args:
            present: of a state, over the layout's D DoFs.
        """
        batch, (N, P) = present.phase.shape, self.table.cells.shape[:2]
        line = present.line
        flat = Present(
            present.phase.reshape(-1),
            present.variance.reshape(-1),
            present.prior.reshape(-1, N),
            Line(*(part.expand(*batch, part.shape[-1]).reshape(-1, part.shape[-1]) for part in line)),
        )
        rows = max(1, PORTION // (P * N))
        parts = [self._weigh(flat, slice(i, i + rows)) for i in range(0, max(len(flat.phase), 1), rows)]
        return Analogy(*(torch.cat(each).reshape(*batch, N) for each in zip(*parts, strict=True)))

    def _weigh(self, present: Present, rows: slice) -> Analogy:
        """Of some rows of a flat batch."""
        periodic = self.table.periodic
        phase, prior = within(present.phase[rows], periodic), present.prior[rows]
        compared = self._compared()
        bank, places = compared.bank, compared.places
        variance = (present.variance[rows] * self.looseness.value.square()).clamp(min=LEAST**2)
        # On a circle the last place is the first one.
        near = slice(len(places) - 1) if periodic else _reached(phase, variance, len(places))
        bank, places = bank[near], places[near]
        P, N, _ = bank.shape
        x, shares = compared.seen(Line(*(part[rows] for part in present.line)), self.dofs)
        late = (phase - 0.5).unsqueeze(-1) * self.tilt.value
        shares = shares * (self.relevance.value * late.exp().unsqueeze(-1))  # [R, 2, k]
        # c (x - f)^2 without c x^2, which all pairs have in common.
        distance = torch.cat([shares, -2 * shares * x], -2).flatten(1) @ bank.flatten(0, 1).T
        away = apart(places - phase.unsqueeze(-1), periodic)
        off = away.square() / variance.unsqueeze(-1)
        off = torch.where(off <= REACH**2, off, torch.inf)
        there = prior > -torch.inf
        known = torch.where(there, self.memory.value * torch.where(there, prior, 0), -torch.inf)
        logits = torch.add(known.unsqueeze(-2) - 0.5 * off.unsqueeze(-1), distance.view(-1, P, N), alpha=-0.5)
        weights = torch.softmax(logits.flatten(1), -1).view_as(logits)
        each = weights.sum(-2)
        # The quotient of what has next to no say has a gradient without bounds.
        some = each > LEAST_SAY
        if periodic:
            where = phase.unsqueeze(-1) + (away.unsqueeze(-1) * weights).sum(-2) / torch.where(some, each, 1)
        else:
            where = (places @ weights) / torch.where(some, each, 1)
        where = torch.where(some, where, phase.unsqueeze(-1))
        even = there.to(each) / there.sum(-1, keepdim=True)
        alone = self.unlike * each.square().sum(-1, keepdim=True)
        return Analogy(each, where, torch.lerp(each, even, alone / (1 + alone)))

    def forecast(self, analogy: Analogy, lead: Lead) -> tuple[Tensor, Tensor]:
        """Mean and variance [..., P, D] of what came of them: each at its own pace where seconds were asked for.

        Args:
            analogy: see `forward`.
            lead: of P horizons.
        """
        N = len(self.pace)
        if lead.asked is None:
            at = lead.phase.unsqueeze(-2).expand(*analogy.phase.shape, -1)
        else:
            end = lead.asked.isinf()
            seconds = lead.asked if lead.gone is None else lead.gone.unsqueeze(-2)
            gone = torch.where(end, 0, seconds) * self.pace.unsqueeze(-1)
            at = analogy.phase.unsqueeze(-1) + gone  # [..., N, P]
            at = ends(at.transpose(-1, -2), end.unsqueeze(-1), self.table.periodic).transpose(-1, -2)
        which = torch.arange(N, device=at.device).expand(at.shape[:-1])
        whole = len(self.rows) == self.table.n_dofs
        paths = self.table.at(which, at, None if whole else self.rows)  # [..., N, P, D]
        mean = (analogy.weights[..., None, None] * paths).sum(-3)
        return mean, (analogy.wide[..., None, None] * (paths - mean.unsqueeze(-3)).square()).sum(-3)

    def select(self, view: View) -> Analogues:
        """The same for a view of the model: forecasts of its DoFs; what is compared stays."""
        part = sharing(self)
        part.register_buffer("rows", self.rows[view.dofs.to(self.rows.device)], persistent=False)
        return part

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have nothing kept."""
        return {**self.__dict__, "_kept": None}

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return f"unlike={self.unlike:g}"

    def extra_repr(self) -> str:
        """Sizes."""
        P = self.table.cells.shape[1]
        return f"{len(self.pace)} demonstrations, {P + 1} phases, compares {len(self.dofs)} DoFs"


def _reached(phase: Tensor, variance: Tensor, count: int) -> slice:
    """Those of ``count`` phases that are within `REACH` of some phase [R]."""
    reach = REACH * variance.detach().sqrt()
    phase = phase.detach()
    if not len(phase):
        return slice(0, count)
    low, high = float((phase - reach).min()), float((phase + reach).max())
    if not (math.isfinite(low) and math.isfinite(high)):
        return slice(0, count)
    return slice(max(math.floor(low * (count - 1)), 0), min(math.ceil(high * (count - 1)), count - 1) + 1)
