"""A fold of the study: learn, interrupt what was left out, and ask every filter; kept on disk when it is finished."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from experiments.data import load
from experiments.evaluate import Answer, FilterMethod
from experiments.folds import split
from experiments.interruptions.kinds import KINDS, moments
from torch_ebip import Demonstrations, Filter, InteractionModel, InteractionPrimitive, ebip, learn, particle_filter
from torch_ebip.common.draws import seeded
from torch_ebip.common.files import read_json, write_json
from torch_ebip.learning.references import last_measured

FAR = 4.0
"""Deviations."""


def _unpaced(model: InteractionModel, primitive: InteractionPrimitive) -> Filter:
    """The tuned filter as it was before people could pause."""
    filter = copy.deepcopy(model.filter)
    filter.analysis.pace = None
    return filter


METHODS: dict[str, Callable[[InteractionModel, InteractionPrimitive], Filter]] = {
    "ebip_tuned": lambda model, primitive: model.filter,
    "tuned_unpaced": _unpaced,
    "ebip": lambda model, primitive: ebip(primitive),
    "particle_filter": lambda model, primitive: particle_filter(primitive),
}
"""How each filter is made of what was learned and of the primitive: the last two are the paper's."""


@dataclass(frozen=True)
class Plan:
    """Everything that decides the result.

    Attributes:
        folder: of the run.
        data: recordings; None for the simulation.
        demonstrations: how many of it.
        folds: of the cross-validation; with one, a fifth is held out.
        methods: names of `METHODS`.
        steps, scan: see `learn`.
        members: E; None: all demonstrations.
        seed: of everything random.
    """

    folder: str
    data: str | None
    demonstrations: int
    folds: int
    methods: tuple[str, ...]
    steps: int
    scan: int
    members: int | None
    seed: int

    def settings(self) -> dict[str, Any]:
        """For the run's configuration."""
        return {key: value for key, value in asdict(self).items() if key != "folder"}


@dataclass(frozen=True)
class Job:
    """One fold."""

    plan: Plan
    fold: int


Answers = list[dict[str, Any]]
"""One of each method, interaction, kind and moment: ``error`` (mean over DoFs of the absolute error at the end, unit
of the target), ``usual`` (that of the same method when as much was seen of the same person, undisturbed),
``squared``, ``far`` (share of DoFs further off than `FAR` deviations), ``deviation`` (their median) and
``phase_error``."""


def run_fold(job: Job) -> Answers:
    """All answers of a fold, computed or read from the run's folder."""
    plan = job.plan
    finished = Path(plan.folder) / f"fold-{job.fold:02d}" / "answers.json"
    if finished.exists():
        answers: Answers = read_json(finished)
        return answers
    torch.set_num_threads(1)
    demonstrations, task = load(plan.data, plan.demonstrations, plan.seed)
    training, testing = split(len(demonstrations), plan.folds, job.fold, plan.seed)
    known = demonstrations.subset(training)
    sensors = next(reversed(task.subsets.values()))
    arm = task.arm
    model = learn(
        known, targets=task.targets, sensors=[n for n in known.layout.names if n not in task.targets or n in sensors],
        subsets=task.subsets, steps=plan.steps, scan=plan.scan, seed=plan.seed, folder=finished.parent / "learned",
        progress=lambda _: None, members=plan.members, arm=None if arm is None else arm[0],
        joints=None if arm is None else arm[1],
    )  # fmt: skip
    if model.report["interrupted"]:
        raise KeyboardInterrupt
    layout, target = known.layout, task.targets[0]
    noise = model.primitive.residual_variance.sqrt().cpu()
    answers = []
    for name in plan.methods:
        filter = METHODS[name](model, model.primitive)
        method = FilterMethod(filter, plan.seed, testing.tolist(), dtype=torch.float32)
        for kind in KINDS:
            answers += _asked(name, kind, method, demonstrations, testing, layout.mask(sensors), target, noise, plan)
    write_json(finished, answers)
    return answers


def _asked(
    name: str,
    kind: str,
    method: FilterMethod,
    demonstrations: Demonstrations,
    testing: Tensor,
    shown: Tensor,
    target: str,
    noise: Tensor,
    plan: Plan,
) -> Answers:
    """What a method says of all test interactions with one kind of interruption."""
    layout, rate = demonstrations.layout, demonstrations.rate
    dofs = layout.mask([target])
    asked = []
    for number in testing.tolist():
        recording = demonstrations[number]
        draws = seeded(plan.seed, number, list(KINDS).index(kind))
        made = KINDS[kind](recording, rate, noise.to(recording), draws)
        asked.append((number, recording, made, moments(made, len(recording), rate)))

    def said(recordings: list[Tensor], keep: list[list[int]]) -> Answer:
        """At samples of recordings."""
        most = max(len(places) for places in keep)
        places = torch.tensor([[*each, *[each[-1]] * (most - len(each))] for each in keep])
        parts = [values[: max(each) + 1].to(torch.float32) for values, each in zip(recordings, keep, strict=True)]
        y = pad_sequence(parts, batch_first=True, padding_value=torch.nan)
        return method(y, ~y.isnan() & shown, places, dofs)

    answer = said([made.values for *_, made, _ in asked], [[m.sample for m in found] for *_, found in asked])
    usual = said([recording for _, recording, *_ in asked], [[m.source for m in found] for *_, found in asked])
    answers: Answers = []
    for b, (number, recording, made, found) in enumerate(asked):
        end = last_measured(recording)[dofs]
        for k, moment in enumerate(found):
            mean, variance = answer.forecast.mean[b, k, 0], answer.forecast.variance[b, k, 0]
            error, deviation = (mean - end).abs(), variance.sqrt()
            phase = made.source[moment.sample] / (len(recording) - 1)
            answers.append(
                {
                    "method": name,
                    "kind": kind,
                    "moment": moment.name,
                    "interaction": number,
                    "source": moment.source,
                    "error": float(error.nanmean()),
                    "usual": float((usual.forecast.mean[b, k, 0] - end).abs().nanmean()),
                    "squared": float(error.square().nanmean()),
                    "far": float((error > FAR * deviation).float().mean()),
                    "deviation": float(deviation.nanmedian()),
                    "phase_error": float((answer.phase[b, k] - phase).abs()),
                }
            )
    return answers


def all_of(parts: Sequence[Answers]) -> Answers:
    """Of all folds."""
    return [answer for part in parts for answer in part]
