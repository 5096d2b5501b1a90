"""What each stage of learning gave, on interactions left out, beside what can be said without a filter."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.learning.held_out import HeldOut, Trial
from torch_ebip.learning.metrics import Z95
from torch_ebip.learning.references import nearest, paths_after

Scores = dict[str, float]
"""``error``, the root mean squared error over all horizons alike in units of the targets' spread, ``error/HORIZON``,
``mae/MODALITY`` of the end in its unit and, of filters, ``coverage_95``, ``coverage_95/HORIZON``, ``loss`` and
``remaining``, see `remaining_error`: the least of it is chosen."""


def score(held_out: HeldOut, filter: InteractionFilter, interactions: Tensor) -> Scores:
    """Scores of a filter on interactions int64 [B]."""

    def more(trial: Trial) -> dict[str, float]:
        """What the objective does not say."""
        forecast = trial.forecast(held_out.task.objective)
        return tally(held_out, forecast.mean - trial.shown.truth, forecast.variance.sqrt())

    found = held_out.evaluate(filter, interactions, more=more)
    own = {key: value for key, value in found.items() if "|" not in key}
    return own | scores_of({key: value for key, value in found.items() if "|" in key})


@without_autocast
@torch.no_grad()
def reference_scores(held_out: HeldOut, interactions: Tensor) -> tuple[Scores, Scores]:
    """Scores of the training mean and of the nearest demonstration, each among those of the same ensembles.

    The mean of all at the time that will have passed since the beginning; the one that was nearest so far, at its
    own speed.

    Args:
        held_out: the demonstrations, and what is asked of them.
        interactions: int64 [B].
    """
    task, settings = held_out.task, held_out.settings
    primitive, ahead = task.primitive, task.objective.ahead
    assert ahead is not None
    dt = settings.thinning / primitive.rate
    totals: tuple[dict[str, float], dict[str, float]] = {}, {}
    count = 0
    for subset in task.subsets.values():
        for shown in held_out.portions(interactions, subset):
            y = shown.y.new_full((*shown.y.shape[:2], len(subset)), torch.nan)
            observed = torch.zeros_like(y, dtype=torch.bool)
            y[..., shown.dofs], observed[..., shown.dofs] = shown.y, shown.observed
            time = (shown.steps * dt).to(y).unsqueeze(-1) + ahead  # [B, K, P]
            among = shown.members[:, None, None, :].expand(*time.shape, -1)
            mean = paths_after(primitive, time.unsqueeze(-1), among, task.targets).mean(-2)
            one = nearest(primitive, y, observed, shown.steps, dt, shown.members).unsqueeze(-1).expand(time.shape)
            near = paths_after(primitive, time, one, task.targets)
            for said, total in zip((mean, near), totals, strict=True):
                for key, value in tally(held_out, said - shown.truth).items():
                    total[key] = total.get(key, 0.0) + value * len(y)
            count += len(y)
    ranks = held_out.ranks
    first, second = (scores_of(ranks.mean({key: v / count for key, v in t.items()}, count)) for t in totals)
    return first, second


def tally(held_out: HeldOut, error: Tensor, deviation: Tensor | None = None) -> dict[str, float]:
    """Means over interactions of what `scores_of` makes scores of, by ``HORIZON|...``.

    Args:
        held_out: what is asked.
        error: [B, K, P, D_targets], units of the DoFs; NaN: not measured.
        deviation: the same shape, of forecasts that have one.
    """
    task = held_out.task
    layout, names = task.primitive.layout, task.objective.horizons
    assert names is not None
    modality = layout.modality_of_dof.to(error.device)[task.targets]
    measured = ~error.isnan()
    error = torch.where(measured, error, 0)
    square = (error / task.objective.scale).square()
    inside = None if deviation is None else (error.abs() <= Z95 * deviation) & measured
    sums: dict[str, float] = {}
    for p, name in enumerate(names):
        sums[f"{name}|count"] = float(measured[:, :, p].double().mean())
        sums[f"{name}|square"] = float(square[:, :, p].double().mean())
        if inside is not None:
            sums[f"{name}|inside"] = float(inside[:, :, p].double().mean())
    last = names[-1]
    for m in sorted(set(modality.tolist())):
        ours = modality == m
        sums[f"{last}|count/{layout.names[m]}"] = float(measured[:, :, -1, ours].double().mean())
        sums[f"{last}|abs/{layout.names[m]}"] = float(error[:, :, -1, ours].abs().double().mean())
    return sums


def scores_of(sums: dict[str, float]) -> Scores:
    """Scores from the means of `tally`; a horizon of which nothing was measured has none."""
    squares: dict[str, float] = {}
    inside: dict[str, float] = {}
    mae: dict[str, float] = {}
    for key, value in sums.items():
        name, _, what = key.partition("|")
        count = sums.get(f"{name}|count", 0.0)
        if count > 0 and what == "square":
            squares[name] = value / count
        elif count > 0 and what == "inside":
            inside[name] = value / count
        elif what.startswith("abs/"):
            modality = what.removeprefix("abs/")
            there = sums[f"{name}|count/{modality}"]
            if there > 0:
                mae[f"mae/{modality}"] = value / there
    scores: Scores = {"error": (sum(squares.values()) / max(len(squares), 1)) ** 0.5}
    scores |= {f"error/{name}": value**0.5 for name, value in squares.items()} | mae
    if inside:
        scores["coverage_95"] = sum(inside.values()) / len(inside)
        scores |= {f"coverage_95/{name}": value for name, value in inside.items()}
    return scores
