"""How sure a filter may be of which interaction is going on: maximum likelihood on interactions left out.

Sharpness over phase for each memory of the evidence, drawn to be smooth, and a floor; the filter and its forecasts
stay as they are. What is reported of an interaction is by numbers that were learned without its fold.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief
from torch_ebip.filtering.ensemble import EnsembleFilter
from torch_ebip.interaction.evidence import Evidence, EvidenceWeighting
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.recognition import PHASES, Recognition, by_label, floored, member_logits
from torch_ebip.learning.held_out import HeldOut

SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Of an interaction that are shown."""
ROUNDS = 60
"""Of the optimiser, at most."""
PULL, SMOOTH = 0.02, 0.1
"""Weights of squared distances: from where the numbers start, and from one phase to the next."""


class Rows(NamedTuple):
    """What is remembered of R interactions left out at K moments, with every set of sensors.

    Attributes:
        evidence: [R, K], see `Evidence`.
        phase: [R, K].
        which: int64 [R, E], labels of the members.
        label: int64 [R], the right one.
        interaction: int64 [R].
    """

    evidence: Evidence
    phase: Tensor
    which: Tensor
    label: Tensor
    interaction: Tensor

    def __repr__(self) -> str:
        return brief(self)


def learn_recognition(
    held_out: HeldOut, filter: InteractionFilter, labels: tuple[str, ...], interactions: Tensor
) -> tuple[Recognition, dict[str, Any]]:
    """Numbers that make the probabilities of labels right, and what the report says of them.

    Args:
        held_out: the demonstrations, and what is shown of them.
        filter: that weighs its members by evidence.
        labels: of all N demonstrations.
        interactions: int64 [B], that decide.

    Returns:
        The recognition, and ``accuracy``, ``expected_calibration_error`` and ``log_loss`` (nats) of interactions by
        what was learned without their fold, over all shares; ``accuracy_by_share``.

    Raises:
        ValueError: a filter that does not weigh its members by evidence.
    """
    plain = Recognition(labels)
    weighting = filter.analysis.weighting if isinstance(filter, EnsembleFilter) else None
    if not isinstance(weighting, EvidenceWeighting):
        raise ValueError("recognition is learned of a filter that weighs its members: `ebip(..., weigh=True)`")
    rows = _rows(held_out, filter, plain, interactions)
    fold = held_out.partition.fold_of.to(rows.label.device)[rows.interaction]
    slope = weighting.slope.value.unsqueeze(-1) * (weighting.slope.value.new_tensor(PHASES) - 0.5)
    start = (0.5 * weighting.sharpness.value.unsqueeze(-1) * slope.exp()).detach().cpu().double()
    found = _fit(rows, torch.ones_like(fold, dtype=torch.bool), start, len(plain.labels))
    said = rows.phase.new_zeros(*rows.phase.shape, len(plain.labels))
    for f in sorted(set(fold.tolist())):
        theirs = fold == f
        numbers = _fit(rows, ~theirs, start, len(plain.labels)) if bool((~theirs).any()) else found
        said[theirs] = _probability(_some(rows, theirs), numbers, len(plain.labels)).detach()
    weights = filter.prior.states
    assert isinstance(weights, Tensor)
    recognition = Recognition(labels, *(value.to(weights) for value in found)).to(weights.device)
    right = said.argmax(-1) == rows.label.unsqueeze(-1)
    chance = said.gather(-1, rows.label.view(-1, 1, 1).expand(*said.shape[:2], 1)).clamp(min=1e-9)
    report = {
        "labels": {label: labels.count(label) for label in plain.labels},
        "accuracy": round(float(right.double().mean()), 4),
        "accuracy_by_share": {str(s): round(float(right[:, k].double().mean()), 4) for k, s in enumerate(SHARES)},
        "expected_calibration_error": round(calibration_error(said.amax(-1).flatten(), right.flatten()), 4),
        "log_loss": round(float(-chance.log().mean()), 4),
    }
    return recognition, report


class Bin(NamedTuple):
    """Answers of about one confidence.

    Attributes:
        confidence: mean probability of the most probable label.
        accuracy: share of them for which it was the right one.
        n: how many.
    """

    confidence: float
    accuracy: float
    n: int


def reliability(confidence: Tensor, right: Tensor, bins: int = 10) -> list[Bin]:
    """How often the sure are right: the bins that have answers.

    Args:
        confidence: [R], probability of the most probable label.
        right: bool [R], whether it was it.
        bins: even ones between 0 and 1.
    """
    sure = confidence.double()
    place = (sure * bins).floor().clamp(max=bins - 1)
    found = []
    for b in sorted(set(place.tolist())):
        mine = place == b
        found.append(Bin(float(sure[mine].mean()), float(right[mine].double().mean()), int(mine.sum())))
    return found


def calibration_error(confidence: Tensor, right: Tensor, bins: int = 10) -> float:
    """Expected calibration error (Naeini et al. 2015): the mean distance of the bins of `reliability` from the line.

    Args:
        confidence: [R], probability of the most probable label.
        right: bool [R], whether it was it.
        bins: even ones between 0 and 1.
    """
    found = reliability(confidence, right, bins)
    return sum(abs(b.accuracy - b.confidence) * b.n for b in found) / len(right)


@without_autocast
@torch.no_grad()
def _rows(held_out: HeldOut, filter: InteractionFilter, plain: Recognition, interactions: Tensor) -> Rows:
    """What a filter remembers of interactions int64 [B] that are none of its members; of all processes together."""
    parts = []
    for subset in held_out.task.subsets.values():
        for trial in held_out.trials(filter, interactions, subset, torch.tensor(SHARES, device="cpu")):
            state, shown = trial.trace.kept, trial.shown
            assert state is not None
            parts.append(
                [*state.memory.weighting, trial.filter.phase(state), shown.members.cpu(), shown.interactions.cpu()]
            )
    shared = held_out.ranks.gather([[tensor.cpu() for tensor in part] for part in parts])
    columns = [torch.cat(tensors) for tensors in zip(*(part for share in shared for part in share), strict=True)]
    weights, misfit, seen, phase, members, which = columns
    evidence = Evidence(weights.double(), misfit.double(), seen.double())
    label_of = plain.label_of.cpu()
    return Rows(evidence, phase.double(), label_of[members], label_of[which], which)


def _some(rows: Rows, chosen: Tensor) -> Rows:
    """Some of the rows, bool [R]."""
    evidence = Evidence(*(tensor[chosen] for tensor in rows.evidence))
    return Rows(evidence, *(tensor[chosen] for tensor in rows[1:]))


def _probability(rows: Rows, numbers: tuple[Tensor, Tensor], count: int) -> Tensor:
    """[R, K, L]."""
    sharpness, floor = numbers
    logits = member_logits(rows.evidence, rows.phase, sharpness)
    which = rows.which.unsqueeze(1)
    return floored(by_label(torch.softmax(logits, -1), which, count), which.expand(logits.shape), floor)


@torch.enable_grad()
def _fit(rows: Rows, chosen: Tensor, start: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Sharpness [M, P] and floor [] with the largest likelihood of the right labels of some rows, bool [R]."""
    rows = _some(rows, chosen)
    raw = torch.zeros_like(start, requires_grad=True)
    low = torch.full((), -3.0, dtype=torch.float64, device="cpu", requires_grad=True)
    optimiser = torch.optim.LBFGS([raw, low], max_iter=ROUNDS, line_search_fn="strong_wolfe")
    right = rows.label.view(-1, 1, 1).expand(*rows.phase.shape, 1)

    def numbers() -> tuple[Tensor, Tensor]:
        """As they are."""
        return start * raw.exp(), torch.sigmoid(low)

    def closure() -> Tensor:
        """Mean negative log-likelihood, and a pull."""
        optimiser.zero_grad()
        chance = _probability(rows, numbers(), count).gather(-1, right).clamp(min=1e-9)
        far = PULL * (raw.square().mean(-1).sum() + (low + 3).square()) + SMOOTH * raw.diff(dim=-1).square().sum()
        loss: Tensor = -chance.log().mean() + far / len(rows.label)
        loss.backward()  # type: ignore[no-untyped-call]
        return loss

    optimiser.step(closure)  # type: ignore[no-untyped-call]
    sharpness, floor = numbers()
    return sharpness.detach(), floor.detach()
