"""What each stage of learning gave, on interactions left out, beside what can be said without a filter."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.shrinkage import LEADS, Shrinkage, hats
from torch_ebip.learning.held_out import HeldOut, Trial
from torch_ebip.learning.metrics import Z95
from torch_ebip.learning.references import ends, nearest

AHEAD = (0.25, 0.5, 1.0)
"""Shares of what is left of an interaction at which shrinkage is learned."""
SWEEPS = 200
"""Of coordinate descent on a handful of shares."""

Scores = dict[str, float]
"""``error``, the root mean squared error of the end in units of the targets' spread, ``mae/MODALITY`` in its unit
and, of filters, ``loss`` and ``coverage_95``."""


def score(held_out: HeldOut, filter: InteractionFilter, interactions: Tensor) -> Scores:
    """Scores of a filter on interactions int64 [B]."""

    def more(trial: Trial) -> Scores:
        """What the objective does not say."""
        forecast = trial.forecast(trial.shown.now.new_ones(1)).at(0)
        error = (forecast.mean - trial.shown.truth[..., -1, :]).abs()
        inside = error <= Z95 * forecast.variance.sqrt()
        return {**_by_modality(held_out, error), "coverage_95": float(inside.to(error).mean())}

    return held_out.evaluate(filter, interactions, more=more)


@without_autocast
@torch.no_grad()
def reference_scores(held_out: HeldOut, interactions: Tensor) -> tuple[Scores, Scores]:
    """Scores of the training mean and of the nearest demonstration, each among those of the same ensembles.

    Args:
        held_out: the demonstrations, and what is asked of them.
        interactions: int64 [B].
    """
    task = held_out.task
    primitive, scale = task.primitive, task.objective.scale
    last = ends(primitive)[:, task.targets]
    dt = held_out.settings.thinning / primitive.rate
    totals: tuple[Scores, Scores] = {}, {}
    count = 0
    for subset in task.subsets.values():
        for shown in held_out.portions(interactions, subset):
            y = shown.y.new_full((*shown.y.shape[:2], len(subset)), torch.nan)
            observed = torch.zeros_like(y, dtype=torch.bool)
            y[..., shown.dofs], observed[..., shown.dofs] = shown.y, shown.observed
            mean = last[shown.members].mean(1, keepdim=True)
            near = last[nearest(primitive, y, observed, shown.steps, dt, shown.members)]
            for said, total in zip((mean, near), totals, strict=True):
                error = said - shown.truth[..., -1, :]
                values = {"error": float((error / scale).square().mean()), **_by_modality(held_out, error.abs())}
                for key, value in values.items():
                    total[key] = total.get(key, 0.0) + value * len(error)
            count += len(y)
    scores = [held_out.ranks.mean({key: value / count for key, value in t.items()}, count) for t in totals]
    first, second = ({**each, "error": each["error"] ** 0.5} for each in scores)
    return first, second


class Drawn(NamedTuple):
    """What was found of shrinkage.

    Attributes:
        readout: to be given to the filter.
        shares: of each target modality, one for each of `LEADS`.
        error: root mean squared error of the end after it, in units of the targets' spread; each interaction drawn by
            shares that were learned without its fold.
        gain: by how many standard errors the squared error is then less than the training mean's, pair by pair.
        gain_alone: the same of the filter alone.
    """

    readout: Shrinkage
    shares: dict[str, list[float]]
    error: float
    gain: float
    gain_alone: float


@without_autocast
@torch.no_grad()
def learn_shrinkage(held_out: HeldOut, filter: InteractionFilter, interactions: Tensor, scored: Tensor) -> Drawn:
    """How far towards the training mean forecasts are best drawn, by modality and lead: least squares in [0, 1].

    With few interactions the shares are pulled towards 1, where the filter speaks alone.

    Args:
        held_out: the demonstrations, and what is asked of them.
        filter: whose forecasts are drawn; without a read-out.
        interactions: int64 [B], that decide.
        scored: int64 [S], those among them whose error is told.
    """
    task = held_out.task
    primitive, targets, scale = task.primitive, task.targets, task.objective.scale
    modality = primitive.layout.modality_of_dof.to(targets.device)[targets]
    groups = sorted(set(modality.tolist()))
    fold_of = held_out.partition.fold_of.to(targets.device)
    folds, K = held_out.settings.folds, len(LEADS)
    leads = scale.new_tensor(LEADS, dtype=torch.float64)
    gram, moment = leads.new_zeros(len(groups), folds, K, K), leads.new_zeros(len(groups), folds, K)
    ends: list[tuple[Tensor, ...]] = []
    for subset in task.subsets.values():
        for trial in held_out.trials(filter, interactions, subset):
            shown = trial.shown
            phase = shown.now.unsqueeze(-1) + (1 - shown.now.unsqueeze(-1)) * shown.now.new_tensor(AHEAD)
            weights = primitive.weights[shown.members].mean(1)[:, None, None, :]
            mean = primitive.basis.project(phase, weights)[..., targets]
            towards = ((trial.forecast(phase).mean - mean) / scale).double()
            wanted = ((held_out.truth(shown.interactions, phase) - mean) / scale).double()
            now = trial.filter.phase(trial.trace.kept).clamp(0, 1).unsqueeze(-1)
            basis = hats((phase - now).clamp(0, 1).double(), leads)
            fold = fold_of[shown.interactions]
            told = torch.isin(shown.interactions, scored.to(shown.interactions.device))
            ends.append((*(part[told, :, -1] for part in (basis, towards, wanted)), fold[told]))
            for i, group in enumerate(groups):
                ours = modality == group
                square = towards[..., ours].square().sum(-1)
                product = (towards[..., ours] * wanted[..., ours]).sum(-1)
                gram[i].index_add_(0, fold, torch.einsum("bkpi,bkp,bkpj->bij", basis, square, basis))
                moment[i].index_add_(0, fold, torch.einsum("bkpi,bkp->bi", basis, product))
    held_out.ranks.add_up([gram, moment])  # every process saw a part of the interactions
    pull = 2 / len(interactions)
    share = scale.new_ones(primitive.layout.n_dofs, K)
    without = leads.new_ones(folds, len(modality), K)
    shares: dict[str, list[float]] = {}
    for i, group in enumerate(groups):
        best = _within(gram[i].sum(0), moment[i].sum(0), pull)
        shares[primitive.layout.names[group]] = [round(float(value), 4) for value in best]
        share[primitive.layout.modality_of_dof.to(share.device) == group] = best.to(share)
        for left in range(folds):
            others = gram[i].sum(0) - gram[i, left], moment[i].sum(0) - moment[i, left]
            without[left, modality == group] = _within(*others, pull)
    basis, towards, wanted, fold = (torch.cat(parts) for parts in zip(*ends, strict=True))
    drawn = torch.einsum("bki,bdi->bkd", basis, without[fold]) * towards
    errors = torch.stack(
        [(said - wanted).square().mean((1, 2)) for said in (drawn, towards, torch.zeros_like(wanted))]
    )
    better = errors[2] - errors[:2]
    sums = torch.cat(
        [errors.new_tensor([len(fold)]), errors[0].sum().view(1), better.sum(-1), better.square().sum(-1)]
    )
    held_out.ranks.add_up([sums])
    count, error, differences, squares = float(sums[0]), float(sums[1] / sums[0]), sums[2:4], sums[4:6]
    spread = (squares / count - (differences / count).square()).clamp(min=0).sqrt()
    # Interactions are what is independent, not the sets of sensors that each was shown with.
    root = max(count / len(task.subsets), 1.0) ** 0.5
    gains = (differences / count * root / spread.clamp(min=1e-12)).tolist()
    return Drawn(Shrinkage(share), shares, error**0.5, *gains)


def _within(gram: Tensor, moment: Tensor, pull: float) -> Tensor:
    """Shares [K] in [0, 1] that minimise s' G s - 2 s' m, pulled towards 1, by coordinate descent."""
    ridge = pull * gram.diagonal().mean() + 1e-12
    gram = gram + ridge * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
    moment = moment + ridge
    share = torch.ones_like(moment)
    for _ in range(SWEEPS):
        for k in range(len(share)):
            rest = moment[k] - gram[k] @ share + gram[k, k] * share[k]
            share[k] = (rest / gram[k, k]).clamp(0, 1)
    return share


def _by_modality(held_out: HeldOut, error: Tensor) -> Scores:
    """Means of absolute errors [..., D_targets] by target modality, in its unit."""
    layout, targets = held_out.task.primitive.layout, held_out.task.targets
    modality = layout.modality_of_dof.to(targets.device)[targets]
    return {f"mae/{layout.names[m]}": float(error[..., modality == m].mean()) for m in sorted(set(modality.tolist()))}
