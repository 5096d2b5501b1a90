"""The interactions of the study shared out among processes, a few at a time; what is finished is kept on disk."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.data import load
from experiments.evaluate import FilterMethod, Task, evaluate
from experiments.faults.faults import Fault, catalogue, suffer
from experiments.folds import read_values, split, write_values
from experiments.results import Cell, Values
from torch_ebip import (
    Demonstrations,
    Filter,
    Gate,
    Huber,
    InteractionPrimitive,
    StudentT,
    bip,
    ebip,
    learn,
    load_model,
    particle_filter,
    select_basis,
)
from torch_ebip.learning import Progress

METHODS: dict[str, Callable[[Path, InteractionPrimitive, int], Filter]] = {
    "ebip_tuned": lambda folder, primitive, members: load_model(folder).rebuilt(members).filter,
    "tuned_student": lambda folder, primitive, members: load_model(folder).rebuilt(members, StudentT()).filter,
    "tuned_huber": lambda folder, primitive, members: load_model(folder).rebuilt(members, Huber()).filter,
    "tuned_gate": lambda folder, primitive, members: load_model(folder).rebuilt(members, Gate()).filter,
    "ebip": lambda folder, primitive, members: ebip(primitive, members),
    "ebip_student": lambda folder, primitive, members: ebip(primitive, members, robust=StudentT()),
    "particle_filter": lambda folder, primitive, members: particle_filter(primitive, members),
    "bip": lambda folder, primitive, members: bip(primitive),
}
"""How each filter is made from the tuned one's folder, the primitive and the number of members."""
SLOW = ("bip",)
"""Take as long as all others together."""
ASKED = 2
"""Interactions of a portion that they are asked about."""
PORTION = 11
"""Interactions that a process takes at once."""
THINNING = 2
"""Every second sample is shown, 30 a second of the simulation, for a study of that many faults in its time."""
OBSERVED = 0.82
"""Share of an interaction that is shown."""


@dataclass(frozen=True)
class Plan:
    """Everything that decides the result.

    Attributes:
        folder: of the run.
        data: recordings; None for the simulation.
        demonstrations: how many of it.
        tests: how many held-out interactions, at most.
        methods: names of `METHODS`.
        groups: of faults; None for all.
        starts: shares of the interaction at which sensors are lost.
        members: E.
        seed: of everything random.
    """

    folder: str
    data: str | None
    demonstrations: int
    tests: int
    methods: tuple[str, ...]
    groups: tuple[str, ...] | None
    starts: tuple[float, ...]
    members: int
    seed: int

    def settings(self) -> dict[str, Any]:
        """For the run's configuration."""
        fixed = {"thinning": THINNING, "observed": OBSERVED, "portion": PORTION, "asked_of_slow": ASKED}
        return {**{key: value for key, value in asdict(self).items() if key != "folder"}, **fixed}


class Study:
    """What a process needs: recordings, primitive, faults."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        demonstrations, task = load(plan.data, plan.demonstrations, plan.seed)
        training, testing = split(len(demonstrations), 1, 0, plan.seed)
        self.known = demonstrations.subset(training)
        self.tests = _thinned(demonstrations.subset(testing[: plan.tests]))
        self.primitive = InteractionPrimitive.fit(self.known, select_basis(self.known))
        self.sensors = next(reversed(task.subsets.values()))
        self.whole = task
        self.task = task._replace(fractions=(OBSERVED,), skipped=[])

    @property
    def faults(self) -> list[Fault]:
        """All of them, the clean recording first."""
        every = catalogue(self.known.layout, self.sensors, self.plan.starts)
        chosen = self.plan.groups
        return [fault for fault in every if chosen is None or fault.group in chosen]

    def learn(self, steps: int, scan: int, progress: Callable[[Progress], None] | None) -> None:
        """Tune the filter that is put to the test, for all of the paper's sets of sensors."""
        task, layout = self.whole, self.known.layout
        shown = {name for names in task.subsets.values() for name in names}
        model = learn(
            self.known,
            targets=task.targets,
            sensors=[name for name in layout.names if name not in task.targets or name in shown],
            subsets=task.subsets,
            steps=steps,
            seed=self.plan.seed,
            folder=self.plan.folder,
            progress=progress,
            members=self.plan.members,
            arm=None if task.arm is None else task.arm[0],
            joints=None if task.arm is None else task.arm[1],
            scan=scan,
        )
        if model.report["interrupted"]:
            raise KeyboardInterrupt


@dataclass(frozen=True)
class Job:
    """Some of the interactions, numbers ``first`` to ``last`` - 1."""

    plan: Plan
    first: int
    last: int


def run_portion(job: Job) -> Values:
    """Every fault and every method for some interactions, computed or read from the run's folder."""
    finished = Path(job.plan.folder) / "portions" / f"{job.first:04d}.json"
    if finished.exists():
        return read_values(finished)
    torch.set_num_threads(1)
    study, plan, folder = Study(job.plan), job.plan, Path(job.plan.folder)
    numbers = range(job.first, job.last)
    tests = study.tests.subset(numbers)
    methods: dict[str, FilterMethod] = {}
    for name in plan.methods:
        filter = METHODS[name](folder, study.primitive, plan.members)
        methods[name] = FilterMethod(filter, plan.seed, dtype=torch.float32, thinning=THINNING)
    deviation = study.primitive.value_variance.sqrt()
    values: Values = {}
    for fault in study.faults:
        task = study.task._replace(subsets={fault.name: study.sensors})
        said = suffer(fault, tests, study.sensors, deviation, numbers, plan.seed)
        for name, method in methods.items():
            asked = min(ASKED, len(numbers)) if name in SLOW else len(numbers)
            for cell, array in _answers(task, method, tests, said, numbers[:asked]).items():
                values.setdefault(cell, {})[name] = np.pad(array, (0, len(numbers) - asked), constant_values=np.nan)
    write_values(finished, values)
    return values


def _thinned(whole: Demonstrations) -> Demonstrations:
    """Every so many samples of each, the last one among them."""
    kept = [trajectory[(len(trajectory) - 1) % THINNING :: THINNING] for trajectory in whole]
    return Demonstrations(whole.layout, kept, whole.rate / THINNING)


def _answers(
    task: Task, method: FilterMethod, tests: Demonstrations, said: Demonstrations, numbers: Sequence[int]
) -> dict[Cell, NDArray[np.float64]]:
    """Values of one method for the first interactions; infinite for those that it gives up on with an error."""

    def ask(rows: range, shown: Demonstrations) -> dict[Cell, NDArray[np.float64]]:
        """About some of them."""
        method.numbers = [numbers[row] for row in rows]
        answers = evaluate(task, {"it": method}, tests.subset(rows), shown.subset(rows))
        return {cell: found["it"] for cell, found in answers.items()}

    every = range(len(numbers))
    try:
        answers = ask(every, said)
        if not any(np.isnan(array).any() for array in answers.values()):
            return answers
        whole = ask(every, tests)  # NaN where nothing is known of the end; elsewhere the filter gave up silently
        return {
            cell: np.where(np.isnan(array) & ~np.isnan(whole[cell]), np.inf, array) for cell, array in answers.items()
        }
    except ValueError:  # of one of them at least
        # What is asked of it, from what it says of the recordings as they were.
        values = {cell: np.full(len(every), np.inf) for cell in ask(every, tests)}
    for row in every:
        try:
            for cell, array in ask(range(row, row + 1), said).items():
                values[cell][row] = array[0]
        except ValueError:
            continue
    return values
