"""What each stage of learning gave, on interactions left out, beside what can be said without a filter."""

from __future__ import annotations

from collections.abc import Callable

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


@without_autocast
@torch.no_grad()
def score(held_out: HeldOut, filter: InteractionFilter, interactions: Tensor) -> Scores:
    """Scores of a filter on interactions int64 [B]."""
    scores = _ends_scored(held_out, filter, interactions, _forecast_of_filter)
    return {**held_out.evaluate(filter, interactions), **scores}


@without_autocast
@torch.no_grad()
def reference_scores(held_out: HeldOut, filter: InteractionFilter, interactions: Tensor) -> tuple[Scores, Scores]:
    """Scores of the training mean and of the nearest demonstration, each among those of the same ensembles.

    Args:
        held_out: the demonstrations, and what is asked of them.
        filter: any, for the sake of its ensembles.
        interactions: int64 [B].
    """
    primitive, targets = held_out.task.primitive, held_out.task.targets
    last = ends(primitive)[:, targets]
    dt = held_out.settings.thinning / primitive.rate

    def mean(trial: Trial) -> tuple[Tensor, Tensor | None]:
        """The mean end of each ensemble."""
        found = last[trial.members].mean(1, keepdim=True)
        return found.expand(-1, trial.steps.shape[1], -1), None

    def near(trial: Trial) -> tuple[Tensor, Tensor | None]:
        """Where the nearest member's demonstration ended."""
        names = primitive.layout.dofs
        places = torch.tensor([names.index(name) for name in trial.filter.dof_names or names], device=last.device)
        y = trial.y.new_full((*trial.y.shape[:2], len(names)), torch.nan)
        observed = torch.zeros_like(y, dtype=torch.bool)
        y[..., places], observed[..., places] = trial.y, trial.observed
        return last[nearest(primitive, y, observed, trial.steps, dt, trial.members)], None

    return (
        _ends_scored(held_out, filter, interactions, mean),
        _ends_scored(held_out, filter, interactions, near),
    )


@without_autocast
@torch.no_grad()
def learn_shrinkage(
    held_out: HeldOut, filter: InteractionFilter, interactions: Tensor
) -> tuple[Shrinkage, dict[str, list[float]], float]:
    """How far towards the training mean forecasts are best drawn, by modality and lead: least squares in [0, 1].

    With few interactions the shares are pulled towards 1, where the filter speaks alone.

    Args:
        held_out: the demonstrations, and what is asked of them.
        filter: whose forecasts are drawn; without a read-out.
        interactions: int64 [B], that decide.

    Returns:
        The read-out; the shares by target, one for each of `LEADS`; and the root mean squared error of the end after
        it, in units of the targets' spread.
    """
    task = held_out.task
    primitive, targets, scale = task.primitive, task.targets, task.objective.scale
    modality = primitive.layout.modality_of_dof.to(targets.device)[targets]
    groups = sorted(set(modality.tolist()))
    leads = scale.new_tensor(LEADS, dtype=torch.float64)
    gram = {group: leads.new_zeros(len(LEADS), len(LEADS)) for group in groups}
    moment = {group: leads.new_zeros(len(LEADS)) for group in groups}
    kept: list[tuple[Tensor, Tensor, Tensor]] = []
    for subset in task.subsets.values():
        for trial in held_out.trials(filter, interactions, subset):
            part = trial.now.new_tensor(AHEAD)
            phase = trial.now.unsqueeze(-1) + (1 - trial.now.unsqueeze(-1)) * part
            weights = primitive.weights[trial.members].mean(1)[:, None, None, :]
            mean = primitive.basis.project(phase, weights)[..., targets]
            towards = ((trial.forecast(phase).mean - mean) / scale).double()
            wanted = ((held_out.truth(trial.interactions, phase) - mean) / scale).double()
            now = trial.filter.phase(trial.trace.kept).clamp(0, 1).unsqueeze(-1)
            basis = hats((phase - now).clamp(0, 1).double(), leads)
            kept.append((basis[..., -1, :], towards[..., -1, :], wanted[..., -1, :]))
            for group in groups:
                ours = modality == group
                square = towards[..., ours].square().sum(-1)
                product = (towards[..., ours] * wanted[..., ours]).sum(-1)
                gram[group] += torch.einsum("bkpi,bkp,bkpj->ij", basis, square, basis)
                moment[group] += torch.einsum("bkpi,bkp->i", basis, product)
    share = scale.new_ones(primitive.layout.n_dofs, len(LEADS))
    found: dict[str, list[float]] = {}
    for group in groups:
        # Every process saw a part of the interactions.
        held_out.ranks.add_up([gram[group], moment[group]])
        best = _within(gram[group], moment[group], 2 / len(interactions))
        found[primitive.layout.names[group]] = [round(float(value), 4) for value in best]
        share[primitive.layout.modality_of_dof.to(share.device) == group] = best.to(share)
    ours = share[targets].double()
    squares = [(torch.einsum("bki,di->bkd", basis, ours) * f - y).square().mean() for basis, f, y in kept]
    sizes = [len(basis) for basis, _, _ in kept]
    total = sum(float(square) * size for square, size in zip(squares, sizes, strict=True)) / sum(sizes)
    total = held_out.ranks.mean({"square": total}, sum(sizes))["square"]
    return Shrinkage(share), found, total**0.5


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


def _forecast_of_filter(trial: Trial) -> tuple[Tensor, Tensor | None]:
    """Mean and variance of the end."""
    forecast = trial.forecast(trial.now.new_ones(1)).at(0)
    return forecast.mean, forecast.variance


def _ends_scored(
    held_out: HeldOut,
    filter: InteractionFilter,
    interactions: Tensor,
    say: Callable[[Trial], tuple[Tensor, Tensor | None]],
) -> Scores:
    """Scores of what is said of the ends, mean [B, K, D_targets] and perhaps a variance, over all sets of sensors."""
    task = held_out.task
    layout, scale = task.primitive.layout, task.objective.scale
    modality = layout.modality_of_dof.to(task.targets.device)[task.targets]
    totals: Scores = {}
    count = 0
    for subset in task.subsets.values():
        for trial in held_out.trials(filter, interactions, subset):
            mean, variance = say(trial)
            error = mean - trial.truth[..., -1, :]
            values = {"error": float((error / scale).square().mean())}
            for group in sorted(set(modality.tolist())):
                values[f"mae/{layout.names[group]}"] = float(error[..., modality == group].abs().mean())
            if variance is not None:
                inside = error.abs() <= Z95 * variance.sqrt()
                values["coverage_95"] = float(inside.to(error).mean())
            for key, value in values.items():
                totals[key] = totals.get(key, 0.0) + value * len(error)
            count += len(error)
    means = held_out.ranks.mean({key: value / count for key, value in totals.items()}, count)
    return {**means, "error": means["error"] ** 0.5}
