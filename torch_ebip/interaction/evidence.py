"""Members weighted by how well they explain what was seen: an ensemble update that bends.

The linear update shifts every demonstration by the same gain, which is right for a Gaussian prior. Real
demonstrations come in clusters. Here each member keeps the demonstration it came from, and a tempered particle
weight beside its Kalman shift: exp(-d^2 / 2h), d^2 the mean squared distance of that demonstration, near the
member's phase, from the recent measurements. Missing sensors, uncertainty and gradients work as before.

Near, because the phase is known to a few hundredths only, and two demonstrations compared at the wrong phases
seem to differ by their movement in between: the likelihood is averaged over a few phases about the member's.
Where the demonstrations are comes from a `DemonstrationTable`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_number
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.model import StateSpace, View
from torch_ebip.filtering.noise.constraints import Positive
from torch_ebip.filtering.updates.weighting import Seen, Weighting
from torch_ebip.interaction.table import DemonstrationTable
from torch_ebip.recordings.layout import Layout


class Evidence(NamedTuple):
    """What a state remembers for weighting.

    Attributes:
        weights: [..., E], of the members, summing to 1.
        misfit: [..., E], discounted sum over samples of the distances.
        seen: [...], discounted number of samples that measured something.
    """

    weights: Tensor
    misfit: Tensor
    seen: Tensor


class EvidenceWeighting(Weighting):
    """Weights (1 - defensive) softmax_j(-d_j^2 sharpness exp(slope (phase - 1/2)) / 2) + defensive / E.

    d_j^2 is the mean over recent samples, exponentially forgotten, of the distance D_j^2 of each, with t the
    sharpness at that phase:

        exp(-t D_j^2 / 2) = sum_o p_o exp(-t D_jo^2 / 2),  p_o ~ exp(-o^2 / (2 wander^2)),

    where D_jo^2 is the mean over measured DoFs of the squared distance at the member's phase + o, in units of
    each DoF's variance, times a factor for its modality.

    Args:
        table: of the demonstrations, numbered as in the prior.
        variance: [D], of each DoF over the demonstrations, squared units.
        modality_of_dof: int64 [D].
        sharpness: 1/h at the start; learned. The larger, the fewer demonstrations speak.
        forgetting: rate at the start, 1/s; learned.
        slope: of the log sharpness over phase at the start; learned.
        defensive: share that is spread evenly over all members, so that no weight vanishes.
        wander: uncertainty of a member's phase at the start, a standard deviation; learned.
        offsets: [O], from a member's phase to where its demonstration is compared.

    Raises:
        ValueError: a setting that is not positive, or a table of other DoFs.
    """

    variance: Tensor
    modality_of_dof: Tensor
    offsets: Tensor

    def __init__(
        self,
        table: DemonstrationTable,
        variance: Tensor,
        modality_of_dof: Tensor,
        sharpness: float = 10.0,
        forgetting: float = 6.0,
        slope: float = 2.0,
        defensive: float = 0.02,
        wander: float = 0.08,
        offsets: Sequence[float] = (-0.1, -0.05, 0.0, 0.05, 0.1),
    ) -> None:
        super().__init__()
        for name, value in {
            "sharpness": sharpness,
            "forgetting": forgetting,
            "slope": slope,
            "wander": wander,
        }.items():
            as_number(name, value, 0, above=True)
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
        self.sharpness = Positive(variance.new_tensor(sharpness))
        self.forgetting = Positive(variance.new_tensor(forgetting))
        self.slope = Positive(variance.new_tensor(slope))
        self.factor = Positive(variance.new_ones(int(modality_of_dof.max()) + 1))
        self.wander = Positive(variance.new_tensor(wander))
        self.register_buffer("offsets", owned(variance.new_tensor(offsets)))
        self.defensive = defensive

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
        return part

    def named_values(self, layout: Layout) -> dict[str, float]:
        """See `Part.named_values`: ``weighting/...``, and ``weighting/factor/MODALITY``."""
        learned = {
            "sharpness": self.sharpness,
            "forgetting": self.forgetting,
            "slope": self.slope,
            "wander": self.wander,
        }
        values = {f"weighting/{name}": float(parameter.value) for name, parameter in learned.items()}
        factors = zip(layout.names, self.factor.value.tolist(), strict=True)
        return values | {f"weighting/factor/{name}": factor for name, factor in factors}

    def start(self, origin: Tensor) -> Evidence:
        """Equal weights for members that have seen nothing, of the demonstrations int64 [..., E]."""
        E = origin.shape[-1]
        misfit = self.variance.new_zeros(origin.shape)
        return Evidence(misfit + 1 / E, misfit, misfit.sum(-1))

    def forget(self, memory: Evidence, dt: Tensor) -> Evidence:
        """Discount the past of a memory over dt [...] seconds."""
        keep = torch.exp(-self.forgetting.value * dt)
        return memory._replace(misfit=memory.misfit * keep.unsqueeze(-1), seen=memory.seen * keep)

    def learn(self, memory: Evidence, seen: Seen) -> Evidence:
        """The memory after a sample that was ``seen``: compared with the demonstrations near the members' phases."""
        phases = (seen.moving[..., :1] + self.offsets).clamp(0, 1)
        paths = self.table.at(seen.origin, phases, seen.rows)
        return self.compare(memory, paths, seen)

    def compare(self, evidence: Evidence, paths: Tensor, seen: Seen) -> Evidence:
        """Take in a sample.

        Args:
            evidence: so far.
            paths: [..., E, O, K], of the demonstrations at the members' phases + `offsets`.
            seen: what was measured.
        """
        y, observed, rows, trust = seen.y, seen.observed, seen.rows, seen.trust
        variance = self.variance if rows is None else self.variance[rows]
        modality = self.modality_of_dof if rows is None else self.modality_of_dof[rows]
        # A DoF that never moved in the demonstrations says nothing about which of them this is.
        scale = torch.where(variance > 0, self.factor.value[modality] / torch.where(variance > 0, variance, 1), 0)
        if observed is None:
            count = y.new_full((*y.shape[:-1], 1), y.shape[-1])
            difference = paths - y[..., None, None, :]
        else:
            count = observed.sum(-1, keepdim=True).clamp(min=1)
            scale = torch.where(observed, scale, 0)
            difference = paths - torch.where(observed, y, 0)[..., None, None, :]
        share = trust
        if share is None:
            share = torch.ones_like(y) if observed is None else observed.to(scale)
        scale = scale * share / count
        distance = (difference.square() @ scale[..., None, :, None]).squeeze(-1)
        temper = 0.5 * self.sharpness.value * torch.exp(self.slope.value * (seen.mean[..., 0] - 0.5))
        prior = torch.log_softmax(-0.5 * (self.offsets / self.wander.value).square(), -1)
        likelihood = torch.logsumexp(prior - distance * temper[..., None, None], -1)
        misfit = evidence.misfit - likelihood / temper.unsqueeze(-1)
        samples = evidence.seen + (share.sum(-1) / count.squeeze(-1))
        # Less than one sample, where values are not trusted, counts as little as it is: it is not scaled up to one.
        mean = misfit / torch.where(samples > 1, samples, 1).unsqueeze(-1)
        weights = torch.softmax(-mean * temper.unsqueeze(-1), dim=-1)
        weights = (1 - self.defensive) * weights + self.defensive / weights.shape[-1]
        if observed is not None:
            weights = torch.where(observed.any(-1).unsqueeze(-1), weights, evidence.weights)
        return Evidence(weights, misfit, samples)
