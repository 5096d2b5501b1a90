"""Members weighted by how well they explain what was seen: an ensemble update that bends.

The linear update shifts every demonstration by the same gain, which is right for a Gaussian prior. Real
demonstrations come in clusters. Here each member keeps the demonstration it came from, and a tempered particle
weight beside its Kalman shift: exp(-d^2 / 2h), d^2 the mean squared distance of that demonstration, near the
member's phase, from the recent measurements. Missing sensors, uncertainty and gradients work as before.

Near, because the phase is known to a few hundredths only, and two demonstrations compared at the wrong phases
seem to differ by their movement in between: the likelihood is averaged over a few phases about the member's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.ambient import owned
from torch_ebip.arguments import as_number
from torch_ebip.noise.constraints import Positive


class Evidence(NamedTuple):
    """What a state remembers for weighting.

    Attributes:
        weights: [..., E], of the members, summing to 1.
        misfit: [..., E], discounted sum over samples of the distances.
        seen: [...], discounted number of samples that measured something.
        origin: [..., E, n_weights], the demonstration's weights that each member started from.
    """

    weights: Tensor
    misfit: Tensor
    seen: Tensor
    origin: Tensor


class EvidenceWeighting(nn.Module):
    """Weights (1 - defensive) softmax_j(-d_j^2 sharpness exp(slope (phase - 1/2)) / 2) + defensive / E.

    d_j^2 is the mean over recent samples, exponentially forgotten, of the distance D_j^2 of each, with t the
    sharpness at that phase:

        exp(-t D_j^2 / 2) = sum_o p_o exp(-t D_jo^2 / 2),  p_o ~ exp(-o^2 / (2 wander^2)),

    where D_jo^2 is the mean over measured DoFs of the squared distance at the member's phase + o, in units of
    each DoF's variance, times a factor for its modality.

    Args:
        variance: [D], of each DoF over the demonstrations, squared units.
        modality_of_dof: int64 [D].
        sharpness: 1/h at the start; learned. The larger, the fewer demonstrations speak.
        forgetting: rate at the start, 1/s; learned.
        slope: of the log sharpness over phase at the start; learned.
        defensive: share that is spread evenly over all members, so that no weight vanishes.
        wander: uncertainty of a member's phase at the start, a standard deviation; learned.
        offsets: [O], from a member's phase to where its demonstration is compared.
    """

    variance: Tensor
    modality_of_dof: Tensor
    offsets: Tensor

    def __init__(
        self,
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

    def start(self, members: Tensor) -> Evidence:
        """Equal weights for members [..., E, 2 + n_weights] that have seen nothing."""
        E = members.shape[-2]
        misfit = members.new_zeros(members.shape[:-1])
        return Evidence(misfit + 1 / E, misfit, misfit.sum(-1), members[..., 2:])

    def forget(self, evidence: Evidence, dt: Tensor) -> Evidence:
        """Discount the past of some evidence over dt [...] seconds."""
        keep = torch.exp(-self.forgetting.value * dt)
        return evidence._replace(misfit=evidence.misfit * keep.unsqueeze(-1), seen=evidence.seen * keep)

    def learn(
        self,
        evidence: Evidence,
        projections: Tensor,
        y: Tensor,
        observed: Tensor,
        phase: Tensor,
        columns: Tensor | None,
        trust: Tensor | None = None,
    ) -> Evidence:
        """Take in a sample.

        Args:
            evidence: so far.
            projections: [..., E, O, D], of the demonstrations (`Evidence.origin`) at the members' phases +
                `offsets`.
            y: [..., D], units of the DoFs; ignored where not observed.
            observed: bool [..., D].
            phase: [...], mean phase.
            columns: int64 [D], which of this module's DoFs these are; default: all.
            trust: [..., D], in [0, 1], what each value counts, 0 where not observed; default: all alike.
        """
        variance = self.variance if columns is None else self.variance[columns]
        modality = self.modality_of_dof if columns is None else self.modality_of_dof[columns]
        # A DoF that never moved in the demonstrations says nothing about which of them this is.
        scale = torch.where(variance > 0, self.factor.value[modality] / torch.where(variance > 0, variance, 1), 0)
        share = observed.to(scale) if trust is None else trust
        count = observed.sum(-1, keepdim=True).clamp(min=1)
        scale = torch.where(observed, scale, 0) * share / count
        difference = projections - torch.where(observed, y, 0)[..., None, None, :]
        distance = (difference.square() @ scale[..., None, :, None]).squeeze(-1)
        temper = 0.5 * self.sharpness.value * torch.exp(self.slope.value * (phase - 0.5))
        prior = torch.log_softmax(-0.5 * (self.offsets / self.wander.value).square(), -1)
        likelihood = torch.logsumexp(prior - distance * temper[..., None, None], -1)
        any_observed = observed.any(-1)
        misfit = evidence.misfit - likelihood / temper.unsqueeze(-1)
        seen = evidence.seen + (share.sum(-1) / count.squeeze(-1))
        # Less than one sample, where values are not trusted, counts as little as it is: it is not scaled up to one.
        mean = misfit / torch.where(seen > 1, seen, 1).unsqueeze(-1)
        weights = torch.softmax(-mean * temper.unsqueeze(-1), dim=-1)
        weights = (1 - self.defensive) * weights + self.defensive / weights.shape[-1]
        weights = torch.where(any_observed.unsqueeze(-1), weights, evidence.weights)
        return Evidence(weights, misfit, seen, evidence.origin)
