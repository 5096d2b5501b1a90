"""Throws shared out among processes, in portions; a portion that is finished is kept on disk."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from experiments.ball_catching.scene import Limits, Reach, World
from experiments.catch.controllers import (
    Controller,
    MeanController,
    ReactiveController,
    SessionController,
    mean_posture,
)
from experiments.catch.learning import filters, know
from experiments.catch.throws import CONDITIONS, Toss, draw
from experiments.catch.trial import Drop, Outcome, run
from experiments.folds import in_processes
from torch_ebip import Filter, InteractionPrimitive
from torch_ebip.common.files import read_json, write_json

METHODS = ("ebip_tuned", "ebip_tuned_all", "ebip_scaled", "ebip", "particle_filter", "mean", "reactive")
PORTION = 20
"""Throws that a process takes at once."""


@dataclass(frozen=True)
class Plan:
    """Everything that decides the result; `sensors` and `share` say what is cut off when, `arm` how fast it is,
    `disturbance` what befalls every second throw."""

    folder: str
    throws: int
    demonstrations: int
    seed: int
    lead: float | None
    arm: float
    sensors: tuple[str, ...]
    share: float
    disturbance: str | None = None

    @property
    def limits(self) -> Limits:
        """Of the arm."""
        return Limits().slowed(self.arm)

    @property
    def drop(self) -> Drop | None:
        """What is cut off, if anything is."""
        return Drop(self.sensors, self.share) if self.sensors else None


@dataclass(frozen=True)
class Portion:
    """Some throws of one condition for one method."""

    plan: Plan
    method: str
    condition: str
    first: int
    last: int

    @property
    def file(self) -> Path:
        """Where its outcomes are kept."""
        return Path(self.plan.folder) / "throws" / f"{self.method}-{self.condition}-{self.first:04d}.json"


class Bench:
    """What a process needs again and again: the scene, what was learned, the throws."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.primitive: InteractionPrimitive = know(plan.demonstrations, plan.seed)
        self.world, self.reach = World(plan.limits), Reach()
        self.ready, self.liked = mean_posture(self.primitive, 0.0), mean_posture(self.primitive, 1.0)
        self._filters: dict[str, Filter] = {}
        self._tosses: dict[str, list[Toss]] = {}

    def tosses(self, condition: str) -> list[Toss]:
        """All throws of a condition."""
        if condition not in self._tosses:
            plan = self.plan
            self._tosses[condition] = draw(condition, plan.throws, plan.seed, plan.limits, plan.disturbance)
        return self._tosses[condition]

    def controller(self, method: str, toss: Toss) -> Controller:
        """A new one for a throw."""
        if method == "mean":
            return MeanController(self.primitive, self.plan.lead)
        if method == "reactive":
            return ReactiveController(self.reach, self.liked, self.plan.limits)
        if method not in self._filters:
            folder = Path(self.plan.folder)
            factor = read_json(folder / "report.json")["factor"]
            self._filters[method] = filters(folder, self.primitive, factor)[method]()
        seed = 1000 * self.plan.seed + toss.number
        return SessionController(self._filters[method], self.primitive, seed, self.plan.lead)

    def throw(self, method: str, toss: Toss, watch: Callable[[World], None] | None = None) -> Outcome:
        """One throw for one method."""
        return run(self.world, toss, self.controller(method, toss), self.ready, self.plan.drop, watch)


@cache
def bench(plan: Plan) -> Bench:
    """The bench of this process."""
    return Bench(plan)


def run_portion(portion: Portion) -> list[dict[str, Any]]:
    """Outcomes of a portion, computed or read from its file."""
    if portion.file.exists():
        content: list[dict[str, Any]] = read_json(portion.file)
        return content
    torch.set_num_threads(1)
    mine = bench(portion.plan)
    rows = []
    for toss in mine.tosses(portion.condition)[portion.first : portion.last]:
        outcome = mine.throw(portion.method, toss)
        row = {"number": toss.number, "style": toss.style, "catchable": toss.catchable, **outcome._asdict()}
        row["seconds"] = np.round(outcome.seconds, 6).tolist()
        rows.append(row)
    write_json(portion.file, rows)
    return rows


Results = dict[tuple[str, str], list[dict[str, Any]]]
"""Outcomes by method and condition, in the order of the throws."""


def run_all(plan: Plan, methods: Sequence[str], workers: int) -> Results:
    """Every throw for every method, with a progress bar of the catches so far."""
    portions = [
        Portion(plan, method, condition, first, min(first + PORTION, plan.throws))
        for first in range(0, plan.throws, PORTION)
        for method in methods
        for condition in CONDITIONS
    ]
    done: dict[Portion, list[dict[str, Any]]] = {}
    total = plan.throws * len(methods) * len(CONDITIONS)
    with (
        tqdm(total=total, desc="throws", unit="throw", dynamic_ncols=True) as bar,
        closing(in_processes(run_portion, portions, workers)) as finished,
    ):
        for i, rows in finished:
            done[portions[i]] = rows
            rates = ", ".join(f"{method} {_rate(done, method):.0%}" for method in methods[:3])
            bar.set_postfix_str(f"caught: {rates}", refresh=False)
            bar.update(len(rows))
    results: Results = {(method, condition): [] for method in methods for condition in CONDITIONS}
    for portion in portions:
        results[portion.method, portion.condition] += done[portion]
    return results


def _rate(done: dict[Portion, list[dict[str, Any]]], method: str) -> float:
    caught = [row["caught"] for portion, rows in done.items() if portion.method == method for row in rows]
    return float(np.mean(caught)) if caught else float("nan")


def as_settings(plan: Plan, methods: Sequence[str]) -> dict[str, Any]:
    """For the run's configuration."""
    settings = asdict(plan)
    del settings["folder"]
    return {**settings, "methods": list(methods)}
