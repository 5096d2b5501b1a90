"""Which of several labelled interactions is going on: the importance of the members by label.

What a filter weighs its members by serves forecasts; how sure it is of a label deserves numbers of its own. So where
interactions left out were there to learn from (`learning.recognising`), the memories of the evidence are weighed by
numbers that make the probabilities right, and only otherwise by those of the filter.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.filtering.states import Memory
from torch_ebip.interaction.evidence import Evidence
from torch_ebip.interaction.readout import hats

PHASES = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0)
"""At which sharpness is learned."""


class Recognition(nn.Module):
    """Probability of a label: the importance of its members, softmax_j(-sum_m t_m d_jm^2), with a floor.

    d_jm^2 is the mean distance in memory m, see `EvidenceWeighting`; the logarithm of t_m is linear between `PHASES`.
    Without numbers of its own the importance is that of the filter's weights.

    Args:
        labels: of the N demonstrations.
        sharpness: [M, P], t of each memory at `PHASES`, positive; [0, P] for none of its own.
        floor: a share, [...], without dimensions, that is spread by how frequent the labels are.

    Raises:
        ValueError: no label; a sharpness that is not [M, P] and positive; a floor outside [0, 1].

    Example:
        >>> from torch_ebip.interaction.recognition import Recognition
        >>> Recognition(["wave", "shake", "wave"]).labels
        ('wave', 'shake')
    """

    label_of: Tensor
    sharpness: Tensor
    floor: Tensor

    def __init__(
        self,
        labels: Sequence[str],
        sharpness: Tensor | None = None,
        floor: Tensor | None = None,
    ) -> None:
        super().__init__()
        if len(labels) == 0:
            raise ValueError("labels must be one for each demonstration, got none")
        self.labels = tuple(dict.fromkeys(labels))
        numbers = {label: i for i, label in enumerate(self.labels)}
        self.register_buffer("label_of", torch.tensor([numbers[label] for label in labels], device="cpu"))
        sharpness = torch.zeros(0, len(PHASES), device="cpu") if sharpness is None else sharpness
        floor = sharpness.new_zeros(()) if floor is None else floor
        if sharpness.ndim != 2 or sharpness.shape[1] != len(PHASES) or not bool((sharpness > 0).all()):
            raise ValueError(f"sharpness must be [M, {len(PHASES)}] and positive, got {list(sharpness.shape)}")
        if not 0 <= float(floor) <= 1:
            raise ValueError(f"floor must be a share between 0 and 1, got {float(floor):g}")
        self.register_buffer("sharpness", owned(sharpness))
        self.register_buffer("floor", owned(floor))

    def forward(self, memory: Memory, phase: Tensor) -> Tensor:
        """[..., L], of the ``memory`` of an ensemble at a mean phase [...]: probabilities of the L labels.

        Raises:
            ValueError: it does not know which demonstrations its members are, or does not weigh them.
        """
        evidence, origin = memory.weighting, memory.origin
        if origin is None or evidence is None:
            raise ValueError(
                "nothing says which of the labelled interactions is going on: the filter does not weigh its members "
                "by what was seen; make it with `weigh=True`, or by `learn`"
            )
        which = self.label_of.to(origin.device)[origin]
        if len(self.sharpness) == 0 or not isinstance(evidence, Evidence):
            return by_label(evidence.weights, which, len(self.labels))
        logits = member_logits(evidence, phase, self.sharpness)
        return floored(by_label(torch.softmax(logits, -1), which, len(self.labels)), which, self.floor)

    def extra_repr(self) -> str:
        """The labels."""
        return ", ".join(self.labels)

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return f"labels={', '.join(self.labels)}"


def member_logits(evidence: Evidence, phase: Tensor, sharpness: Tensor) -> Tensor:
    """[..., E] of what was remembered at phases [...], with a sharpness [M, P] for each memory at `PHASES`."""
    places = sharpness.new_tensor(PHASES)
    temper = torch.exp(hats(phase.to(sharpness).clamp(0, 1), places) @ sharpness.log().T)
    return -(evidence.misfit * (temper / evidence.seen.clamp(min=1)).unsqueeze(-1)).sum(-2)


def by_label(weights: Tensor, which: Tensor, count: int) -> Tensor:
    """[..., L]: sums of members' weights [..., E] by which of ``count`` labels they have, int64 [..., E]."""
    which = which.expand(weights.shape)
    return weights.new_zeros(*weights.shape[:-1], count).scatter_add(-1, which, weights)


def floored(probability: Tensor, which: Tensor, floor: Tensor) -> Tensor:
    """Probabilities [..., L] of which a share is spread by how many members have each label, int64 [..., E]."""
    even = probability.new_full(which.shape, 1 / which.shape[-1])
    frequent = by_label(even, which, probability.shape[-1])
    return (1 - floor) * probability + floor * frequent
