"""One set of people: learn with both phases, and ask both while others wave; kept on disk when it is finished."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from experiments.cyclic.waves import Waves, waves
from torch_ebip import InteractionFilter, InteractionModel, InteractionPrimitive, ebip, learn
from torch_ebip.common.files import read_json, write_json
from torch_ebip.interaction.course import apart
from torch_ebip.learning.recorded import forecast_recorded

AHEAD = (0.1, 0.25, 0.5)
"""s."""
FIRST = 5
"""Samples from which on forecasts count: before that nobody has moved."""
Z95 = 1.959964
BEGINNINGS = ("at phase 0", "anywhere")
METHODS = ("ebip_tuned", "tuned_once", "ebip_circle", "ebip_once")
"""What `learn` returns, and what it returns with ``periodic=False``; the paper's eBIP with either phase, its R times
the factor that `learn` found best."""
Answers = list[dict[str, Any]]
"""One of each method, recording and horizon: ``squared`` (m^2, mean over moments and DoFs of the partner),
``inside`` (share within 95 % intervals), and on a circle ``phase`` (mean squared error)."""


@dataclass(frozen=True)
class Job:
    """Everything that decides the answers of one set.

    Attributes:
        folder: of the run.
        movement: seed of what people have in common.
        beginning: of `BEGINNINGS`.
        known, tests: how many recordings.
        steps, scan: see `learn`.
        seed: of the learning.
    """

    folder: str
    movement: int
    beginning: str
    known: int
    tests: int
    steps: int
    scan: int
    seed: int

    @property
    def place(self) -> Path:
        """Of what it leaves."""
        return Path(self.folder) / f"{self.beginning.replace(' ', '-')}-{self.movement}"

    def settings(self) -> dict[str, Any]:
        """For the run's configuration."""
        return {key: value for key, value in asdict(self).items() if key not in ("folder", "movement", "beginning")}

    def made(self) -> tuple[Waves, Waves]:
        """People to learn from, and others."""
        loose = self.beginning != BEGINNINGS[0]
        return (
            waves(self.known, 2 * self.movement, loose, movement=self.movement),
            waves(self.tests, 2 * self.movement + 1, loose, movement=self.movement),
        )


def run_set(job: Job) -> Answers:
    """All answers, computed or read from the run's folder."""
    finished = job.place / "answers.json"
    if finished.exists():
        stored: Answers = read_json(finished)
        return stored
    torch.set_num_threads(1)
    known, tests = job.made()
    models = {
        name: learn(
            known.recordings, periodic=periodic, steps=job.steps, scan=job.scan, seed=job.seed,
            folder=job.place / name, progress=lambda _: None,
        )
        for name, periodic in (("ebip_tuned", None), ("tuned_once", False))
    }  # fmt: skip
    filters: dict[str, InteractionFilter] = {name: model.filter for name, model in models.items()}
    circle = _periodic(models["ebip_tuned"], known)
    for name, primitive, model in (
        ("ebip_circle", circle, "ebip_tuned"),
        ("ebip_once", models["tuned_once"].primitive, "tuned_once"),
    ):
        variance = models[model].report["factor"] * primitive.residual_variance
        filters[name] = ebip(primitive, residual_variance=variance)
    answers: Answers = []
    for name, filter in filters.items():
        turned = _turned(circle, known) if filter.phase_model.periodic else None
        for number, (values, true) in enumerate(zip(tests.recordings, tests.phases, strict=True)):
            answers += _answered(name, filter, number, values, true, turned, job)
    write_json(finished, answers)
    return answers


def _periodic(model: InteractionModel, known: Waves) -> InteractionPrimitive:
    """The primitive of a model that found the circle; of one that did not a new one."""
    found = model.primitive
    return found if found.periodic else InteractionPrimitive.fit(known.recordings, periodic=True)


def _turned(primitive: InteractionPrimitive, known: Waves) -> Tensor:
    """By how much a primitive's phases lie behind the true ones: where a cycle begins is nobody's to say."""
    off = primitive.first_phase.double() - torch.stack([true[0] for true in known.phases])
    return torch.angle(torch.polar(torch.ones_like(off), 2 * math.pi * off).mean()) / (2 * math.pi)


def _answered(
    name: str, filter: InteractionFilter, number: int, values: Tensor, true: Tensor, turned: Tensor | None, job: Job
) -> Answers:
    """What a filter says of one recording."""
    _, tests = job.made()
    layout, rate = tests.recordings.layout, tests.recordings.rate
    partner = layout.controlled
    said = forecast_recorded(filter, layout, values, AHEAD, job.seed)
    now = torch.arange(FIRST, len(values))
    answers: Answers = []
    phase = {}
    if turned is not None:
        y = torch.where(partner, torch.nan, values)
        with torch.no_grad():
            followed = filter(y, generator=torch.Generator().manual_seed(job.seed)).phase
        off = apart(followed.double() - true - turned, True)[FIRST:]
        phase = {"phase": float(off.square().mean())}
    for k, ahead in enumerate(AHEAD):
        at = now[now + ahead * rate <= len(values) - 1]
        place = at + ahead * rate
        low = place.floor().long()
        part = (place - low).unsqueeze(-1)
        truth = torch.lerp(values[low], values[(low + 1).clamp(max=len(values) - 1)], part)[:, partner]
        error = said.mean[at, k][:, partner] - truth
        deviation = said.variance[at, k][:, partner].sqrt()
        answers.append(
            {
                "method": name,
                "beginning": job.beginning,
                "movement": job.movement,
                "number": number,
                "ahead": ahead,
                "squared": float(error.square().mean()),
                "inside": float((error.abs() <= Z95 * deviation).double().mean()),
                **phase,
            }
        )
    return answers
