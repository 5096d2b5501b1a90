"""Members weighted by how well they explain what was seen: an ensemble update that bends.

The linear update shifts every demonstration by the same gain, which is right for a Gaussian prior. Real
demonstrations come in clusters. Here each member keeps the demonstration it came from, and a tempered particle
weight beside its Kalman shift: exp(-d^2 / 2h), d^2 the mean squared distance of that demonstration, near the
member's phase, from the measurements so far. Missing sensors, uncertainty and gradients work as before.

Near, because the phase is known to a few hundredths only, and two demonstrations compared at the wrong phases
seem to differ by their movement in between: the likelihood is averaged over a few phases about the member's.
Where the demonstrations are comes from a `DemonstrationTable`.

Far and near are measured by how far demonstrations lie apart there: where all of them are close together a centimetre
tells much, where they have spread out it tells little.

How far back it looks is a question of the interaction: a hand that hesitates is told by its last tenths of a second,
an action whose end looks like another's by how it began. So there may be several memories that forget at rates of
their own, a fast and a slow one; how much each counts is learned.
"""

from __future__ import annotations

from collections.abc import Sequence, Sized
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_number, as_numbers
from torch_ebip.common.brief import brief
from torch_ebip.common.modules import Versions, sharing
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.noise.constraints import Positive, Signed
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.weighting import Seen, Weighting
from torch_ebip.interaction.table import KEPT, DemonstrationTable
from torch_ebip.recordings.layout import Layout

LEAST_SPREAD = 0.1
"""Of a DoF's variance, added to that at a phase: where all demonstrations are at one place noise would decide."""


class Evidence(NamedTuple):
    """What a state remembers for weighting.

    Attributes:
        weights: [..., E], of the members, summing to 1.
        misfit: [..., M, E], of each memory: discounted sum over samples of the distances.
        seen: [..., M], discounted number of samples that measured something.
    """

    weights: Tensor
    misfit: Tensor
    seen: Tensor

    def __repr__(self) -> str:
        return brief(self)


class _Constants(NamedTuple):
    """What depends on parameters alone.

    Attributes:
        scale: [P, 2, k], of squared distances, divided by k: between P + 1 phases its value and its rise over a cell.
        sharpness: [M], half of it.
        slope: [M].
        primacy: [M].
        prior: [O], logarithms of the shares of the offsets.
    """

    scale: Tensor
    sharpness: Tensor
    slope: Tensor
    primacy: Tensor
    prior: Tensor

    def __repr__(self) -> str:
        return brief(self)


class EvidenceWeighting(Weighting):
    """Weights (1 - defensive) softmax_j(-sum_m t_m d_jm^2 / 2) + defensive / E of M memories.

    t_m = sharpness_m exp(slope_m (phase - 1/2)) is how much memory m counts. d_jm^2 is the mean over samples,
    forgotten at its rate and weighed by exp(primacy_m (1/2 - phase)), of the distance D_j^2 of each, with t the sum
    of the t_m:

        exp(-t D_j^2 / 2) = sum_o p_o exp(-t D_jo^2 / 2),  p_o ~ exp(-o^2 / (2 wander^2)),

    where D_jo^2 is the mean over measured DoFs of the squared distance at the member's phase + o, times a factor for
    its modality, in units of v_d (s_d(phase) + `LEAST_SPREAD`)^relative: v_d the DoF's variance, s_d(phase) that over
    the demonstrations at the mean phase, as a share of it.

    Args:
        table: of the demonstrations, numbered as in the prior.
        variance: [D], of each DoF over the demonstrations, squared units.
        modality_of_dof: int64 [D].
        sharpness: 1/h at the start, of each memory or of all; learned. The larger, the fewer demonstrations speak.
        forgetting: rate of each memory at the start, 1/s; learned. 0.01 remembers a whole interaction.
        slope: of the log sharpness over phase at the start, of each memory or of all; learned. Below 0 fewer speak
            early than late.
        primacy: how much more each memory, or all, holds of what came first, at the start; learned. 0: all alike.
        relative: how far distances are relative to the spread at a phase, at the start; learned. 0: to each DoF's
            variance alone, 1: to the spread.
        defensive: share that is spread evenly over all members, so that no weight vanishes.
        wander: uncertainty of a member's phase at the start, a standard deviation; learned.
        offsets: [O], from a member's phase to where its demonstration is compared.

    Raises:
        ValueError: a setting that is not positive, or a table of other DoFs; as many sharpnesses as memories.
    """

    variance: Tensor
    modality_of_dof: Tensor
    offsets: Tensor

    def __init__(
        self,
        table: DemonstrationTable,
        variance: Tensor,
        modality_of_dof: Tensor,
        sharpness: float | Sequence[float] = 10.0,
        forgetting: float | Sequence[float] = 6.0,
        slope: float | Sequence[float] = 2.0,
        primacy: float | Sequence[float] = 0.0,
        relative: float = 0.0,
        defensive: float = 0.02,
        wander: float = 0.08,
        offsets: Sequence[float] = (-0.1, -0.05, 0.0, 0.05, 0.1),
    ) -> None:
        super().__init__()
        count = len(forgetting) if isinstance(forgetting, Sized) else 1
        what = "one number for each memory"
        sharp = as_numbers("sharpness", sharpness, count, what, 0, above=True)
        rates = as_numbers("forgetting", forgetting, count, what, 0, above=True)
        first, rise = as_numbers("primacy", primacy, count, what), as_numbers("slope", slope, count, what)
        as_number("relative", relative)
        as_number("wander", wander, 0, above=True)
        if not 0 < as_number("defensive", defensive) < 1:
            raise ValueError(f"defensive must lie between 0 and 1, got {defensive}")
        if table.n_dofs != len(variance) or len(modality_of_dof) != len(variance):
            raise ValueError(
                f"table, variance and modality_of_dof are of {table.n_dofs}, {len(variance)} and "
                f"{len(modality_of_dof)} DoFs, which must be the same"
            )
        self.table = table
        self.register_buffer("variance", owned(variance))
        self.register_buffer("modality_of_dof", owned(modality_of_dof))
        self.sharpness = Positive(variance.new_tensor(sharp))
        self.forgetting = Positive(variance.new_tensor(rates))
        self.slope = Signed(variance.new_tensor(rise))
        self.primacy = Signed(variance.new_tensor(first))
        self.relative = Signed(variance.new_tensor(relative))
        self.factor = Positive(variance.new_ones(int(modality_of_dof.max()) + 1))
        self.wander = Positive(variance.new_tensor(wander))
        self.register_buffer("offsets", owned(variance.new_tensor(offsets)))
        self.defensive = defensive
        self._at_work = False

    def at_work(self) -> None:
        """See `Weighting.at_work`. Otherwise nothing is kept: a module may be copied, or given other parameters."""
        self._at_work = True
        self._kept: dict[tuple[int, ...] | None, _Constants] = {}
        self._versions = Versions(self)
        self._discounted: tuple[Tensor, Tensor] | None = None
        self._forgetting_versions = Versions(self.forgetting)

    def extra_repr(self) -> str:
        """What is not learned."""
        return f"defensive={self.defensive:g}"

    def check(self, model: StateSpace) -> None:
        """See `Part.check`: it is for as many DoFs as the model has."""
        if len(self.variance) != model.n_dofs:
            raise ValueError(f"the weighting is for {len(self.variance)} DoFs, the model has {model.n_dofs}")

    def select(self, view: View) -> EvidenceWeighting:
        """See `Part.select`."""
        part = sharing(self)
        part.table = self.table.select(view)
        part.register_buffer("variance", self.variance[view.dofs])
        part.register_buffer("modality_of_dof", self.modality_of_dof[view.dofs])
        part._at_work = False
        return part

    def named_values(self, layout: Layout) -> dict[str, float]:
        """See `Part.named_values`: ``weighting/...``, of several memories ``.../1`` and on; factors by modality."""
        values = {f"weighting/{name}": float(getattr(self, name).value.detach()) for name in ("wander", "relative")}
        for name in ("sharpness", "forgetting", "slope", "primacy"):
            each = getattr(self, name).value.tolist()
            numbers = [f"/{i}" for i in range(1, len(each) + 1)] if len(each) > 1 else [""]
            values |= {f"weighting/{name}{number}": value for number, value in zip(numbers, each, strict=True)}
        factors = zip(layout.names, self.factor.value.tolist(), strict=True)
        return values | {f"weighting/factor/{name}": factor for name, factor in factors}

    def start(self, origin: Tensor) -> Evidence:
        """Equal weights for members that have seen nothing, of the demonstrations int64 [..., E]."""
        E, M = origin.shape[-1], len(self.forgetting.start)
        misfit = self.variance.new_zeros(*origin.shape[:-1], M, E)
        return Evidence(misfit[..., 0, :] + 1 / E, misfit, misfit.sum(-1))

    def forget(self, memory: Evidence, dt: Tensor) -> Evidence:
        """Discount the past of a memory over dt [...] seconds."""
        keep = self._discount(dt)
        return Evidence(memory.weights, memory.misfit * keep.unsqueeze(-1), memory.seen * keep)

    def _discount(self, dt: Tensor) -> Tensor:
        """What is left after dt [...] seconds, [..., M]; kept for the same tensor while the parameters stay."""
        if not self._at_work:
            return torch.exp(-self.forgetting.value * dt.unsqueeze(-1))
        if self._forgetting_versions.changed() or self._discounted is None or self._discounted[0] is not dt:
            self._discounted = dt, torch.exp(-self.forgetting.value * dt.unsqueeze(-1))
        return self._discounted[1]

    def learn(self, memory: Evidence, seen: Seen) -> Evidence:
        """The memory after a sample that was ``seen``: compared with the demonstrations near the members' phases."""
        phases = seen.moving.narrow(-1, 0, 1) + self.offsets
        assert seen.origin is not None
        paths = self.table.at(seen.origin, phases, seen.rows)
        return self.compare(memory, paths, seen)

    def compare(self, evidence: Evidence, paths: Tensor, seen: Seen) -> Evidence:
        """Take in a sample.

        Args:
            evidence: so far.
            paths: [..., E, O, K], of the demonstrations at the members' phases + `offsets`.
            seen: what was measured.
        """
        y, observed, trust = seen.y, seen.observed, seen.trust
        cells, sharpness, slope, primacy, prior = self._constants(seen.rows)
        scale = _at(cells, seen.mean.select(-1, 0))
        K = y.shape[-1]
        if observed is None:
            difference, share, count = paths - (y if y.ndim == 1 else y[..., None, None, :]), trust, None
        else:
            difference = paths - torch.where(observed, y, 0)[..., None, None, :]
            share = observed.to(scale) if trust is None else torch.where(observed, trust, 0)
            count = observed.sum(-1, keepdim=True).clamp(min=1)
        samples: Tensor | float = 1.0
        if share is not None:
            share = share / (K if count is None else count)
            scale, samples = scale * share * K, share.sum(-1, keepdim=True)
        square = difference.square()
        distance = square @ scale if scale.ndim == 1 else (square @ scale[..., None, :, None]).squeeze(-1)
        late = seen.mean.narrow(-1, 0, 1) - 0.5
        tempers = sharpness * torch.exp(slope * late)
        held = torch.exp(-primacy * late)
        temper = tempers.sum(-1, keepdim=True)
        likelihood = torch.logsumexp(torch.addcmul(prior, distance, temper.unsqueeze(-1), value=-1), -1)
        misfit = evidence.misfit - held.unsqueeze(-1) * (likelihood / temper).unsqueeze(-2)
        total = evidence.seen + held * samples
        # Less than one sample, where values are not trusted, counts as little as it is: it is not scaled up to one.
        shares = tempers / -torch.maximum(total, held)
        weights = torch.softmax((misfit * shares.unsqueeze(-1)).sum(-2), dim=-1)
        weights = (1 - self.defensive) * weights + self.defensive / weights.shape[-1]
        if observed is not None:
            weights = torch.where(observed.any(-1).unsqueeze(-1), weights, evidence.weights)
        return Evidence(weights, misfit, total)

    def _constants(self, rows: Tensor | None) -> _Constants:
        """What depends on parameters alone, for some DoFs int64 [k]; kept while they stay as they are."""
        if not self._at_work:
            return self._computed(rows)
        if self._versions.changed():
            self._kept.clear()
        key = None if rows is None else tuple(rows.tolist())
        if key not in self._kept:
            if len(self._kept) >= KEPT:
                self._kept.clear()
            self._kept[key] = self._computed(rows)
        return self._kept[key]

    def _computed(self, rows: Tensor | None) -> _Constants:
        variance = self.variance if rows is None else self.variance[rows]
        modality = self.modality_of_dof if rows is None else self.modality_of_dof[rows]
        # A DoF that never moved in the demonstrations says nothing about which of them this is.
        scale = torch.where(variance > 0, self.factor.value[modality] / torch.where(variance > 0, variance, 1), 0)
        spread = self.table.spread(rows) / torch.where(variance > 0, variance, 1) + LEAST_SPREAD  # [P + 1, k]
        scale = scale * spread.pow(-self.relative.value) / len(variance)
        prior = torch.log_softmax(-0.5 * (self.offsets / self.wander.value).square(), -1)
        return _Constants(
            torch.stack([scale[:-1], scale.diff(dim=0)], 1),
            0.5 * self.sharpness.value,
            self.slope.value,
            self.primacy.value,
            prior,
        )


def _at(cells: Tensor, phase: Tensor) -> Tensor:
    """What lies linearly between phases evenly from 0 to 1, [..., k], of cells [P, 2, k] at a phase [...]."""
    place = phase.clamp(0, 1) * len(cells)
    cell = place.detach().floor().clamp(max=len(cells) - 1)
    value, rise = cells.index_select(0, cell.long().reshape(-1)).view(*phase.shape, 2, -1).unbind(-2)
    return torch.addcmul(value, (place - cell).unsqueeze(-1), rise)
