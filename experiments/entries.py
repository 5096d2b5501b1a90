"""Everything that `experiments.compare` compares, by name: how a method is made from the training part of a fold."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from experiments.baselines import (
    BallisticMethod,
    RecurrentMethod,
    RecurrentSettings,
    RidgeMethod,
    TreesMethod,
)
from experiments.evaluate import FilterMethod, MeanMethod, Method, NearestMethod, Task
from experiments.methods import (
    FACTORS,
    Problem,
    best_factor,
    best_start,
    particle_tunable,
    scaled,
    tunable,
    tune,
)
from torch_ebip import (
    Demonstrations,
    Filter,
    InteractionPrimitive,
    TuningSettings,
    bip,
    ebip,
    ebip_minus,
    particle_filter,
    select_basis,
)


@dataclass(frozen=True)
class Fold:
    """The training part of a fold.

    Attributes:
        problem: demonstrations, primitive, targets.
        task: what will be asked.
        members: E; None: as many as there are demonstrations.
        seed: of everything random.
        scan: training interactions that decide about a factor on R.
        tuning: settings of the gradient.
        folder: for checkpoints and records.
    """

    problem: Problem
    task: Task
    members: int | None
    seed: int
    scan: int
    tuning: TuningSettings
    folder: Path

    @classmethod
    def of(
        cls,
        known: Demonstrations,
        task: Task,
        seed: int,
        tuning: TuningSettings,
        folder: Path,
        members: int | None = None,
        scan: int = 48,
        device: torch.device | None = None,
    ) -> Fold:
        """Basis by BIC and the primitive of the training demonstrations, and what is tuned for."""
        layout = known.layout
        primitive = InteractionPrimitive.fit(known, select_basis(known)).to(device)
        subsets = {subset: layout.mask(names) for subset, names in task.subsets.items()}
        arm = None if task.arm is None else (task.arm[0], layout.mask([task.arm[1]]))
        problem = Problem(known, primitive, layout.mask(task.targets), subsets, arm)
        return cls(problem, task, members, seed, scan, tuning, folder)

    @property
    def n_members(self) -> int:
        """E."""
        return len(self.problem.primitive) if self.members is None else self.members


def _filter(build: Callable[[Fold], Filter]) -> Callable[[Fold], Method | None]:
    return lambda fold: FilterMethod(build(fold), fold.seed)


def _ebip_minus(fold: Fold) -> Filter:
    with warnings.catch_warnings():
        # That no mixture fits is a finding of the paper, and says so once a fold.
        warnings.filterwarnings("ignore", message="no mixture of up to")
        return ebip_minus(fold.problem.primitive, fold.n_members, seed=fold.seed)


def _factor(fold: Fold) -> float:
    return best_factor(fold.problem, scaled, fold.tuning, fold.scan, FACTORS, fold.folder / "scan_scaled.json")


def _ebip_scaled(fold: Fold) -> Filter:
    return scaled(fold.problem.primitive, _factor(fold), fold.members)


def _ebip_tuned(fold: Fold) -> Filter:
    record = fold.folder / "scan_tunable.json"
    start = best_start(fold.problem, fold.tuning, fold.scan, _factor(fold), record)
    filter = tunable(fold.problem.primitive, start, fold.members)
    tune(fold.problem, filter, fold.tuning, None, fold.folder / "ebip_tuned.pt", None)
    return filter


def _particle_filter_tuned(fold: Fold) -> Filter:
    record = fold.folder / "scan_particle.json"
    start = best_factor(fold.problem, particle_tunable, fold.tuning, fold.scan, FACTORS, record)
    filter = particle_tunable(fold.problem.primitive, start, fold.members)
    tune(fold.problem, filter, fold.tuning, None, fold.folder / "particle_filter_tuned.pt", None)
    return filter


def _ballistic(fold: Fold) -> Method | None:
    """None where nothing is thrown."""
    return BallisticMethod(fold.problem.demonstrations) if "ball" in fold.task.targets else None


def _gru(fold: Fold) -> Method:
    problem = fold.problem
    settings = RecurrentSettings(seed=fold.seed)
    return RecurrentMethod(problem.demonstrations, problem.targets, problem.subsets, settings)


METHODS: dict[str, Callable[[Fold], Method | None]] = {
    "mean": lambda fold: MeanMethod(fold.problem.primitive),
    "nearest": lambda fold: NearestMethod(fold.problem.primitive),
    "ballistic": _ballistic,
    "ridge": lambda fold: RidgeMethod(fold.problem.demonstrations, fold.problem.targets, fold.task.fractions),
    "trees": lambda fold: TreesMethod(
        fold.problem.demonstrations, fold.problem.targets, fold.task.fractions, seed=fold.seed
    ),
    "gru": _gru,
    "bip": _filter(lambda fold: bip(fold.problem.primitive)),
    "particle_filter": _filter(lambda fold: particle_filter(fold.problem.primitive, fold.members)),
    "particle_filter_tuned": _filter(_particle_filter_tuned),
    "ebip_minus": _filter(_ebip_minus),
    "ebip": _filter(lambda fold: ebip(fold.problem.primitive, fold.members)),
    "ebip_scaled": _filter(_ebip_scaled),
    "ebip_tuned": _filter(_ebip_tuned),
}
"""Builders; one that does not apply to the recordings returns None."""
