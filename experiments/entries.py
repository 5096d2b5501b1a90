"""Everything that `experiments.compare` compares, by name: how a method is made from the training part of a fold."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch

from experiments.baselines import (
    BallisticMethod,
    RecurrentMethod,
    RecurrentSettings,
    RidgeMethod,
    TreesMethod,
    UntoldTreesMethod,
)
from experiments.evaluate import FilterMethod, MeanMethod, Method, NearestMethod, Task
from torch_ebip import (
    BSplineBasis,
    Demonstrations,
    ForecastObjective,
    ForwardKinematicsLoss,
    InteractionFilter,
    InteractionModel,
    InteractionPrimitive,
    ParticleFilter,
    Tuner,
    TuningSettings,
    bip,
    ebip,
    ebip_minus,
    learn,
    particle_filter,
    select_basis,
)
from torch_ebip.learning import Weights
from torch_ebip.learning.configuration import Task as Tuned
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.horizons import AHEAD, reached
from torch_ebip.learning.ranks import Ranks
from torch_ebip.learning.starts import FACTORS, best_factor, scaled


@dataclass(frozen=True)
class Fold:
    """The training part of a fold.

    Attributes:
        known: the demonstrations.
        primitive: of them.
        task: what will be asked.
        members: E; None: as many as there are demonstrations.
        seed: of everything random.
        scan: training interactions that decide about a factor on R.
        tuning: settings of the gradient.
        folder: for checkpoints and records.
    """

    known: Demonstrations
    primitive: InteractionPrimitive
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
        primitive = InteractionPrimitive.fit(known, select_basis(known)).to(device)
        return cls(known, primitive, task, members, seed, scan, tuning, folder)

    @property
    def n_members(self) -> int:
        """E."""
        return len(self.primitive) if self.members is None else self.members

    @property
    def ahead(self) -> tuple[float, ...]:
        """What is asked for: seconds, and the end."""
        return (*self.task.ahead, math.inf)

    def tuned(self) -> Tuned:
        """What a filter is tuned for that `learn` does not make: as `learn` has it."""
        layout, device = self.primitive.layout, self.primitive.weights.device
        targets = layout.mask(self.task.targets).to(device)
        subsets = {subset: layout.mask(names).to(device) for subset, names in self.task.subsets.items()}
        ahead = reached(self.primitive, AHEAD)
        if self.task.arm is None:
            return Tuned(self.primitive, ForecastObjective(self.primitive, targets, ahead=ahead), targets, subsets)
        arm, joints = self.task.arm
        loss = ForwardKinematicsLoss(arm, rotation_weight=0.1)
        objective = ForecastObjective(
            self.primitive, targets, weights=Weights(tool=1.0), arm=loss, arm_dofs=layout.mask([joints]).to(device),
            ahead=ahead,
        )  # fmt: skip
        return Tuned(self.primitive, objective, targets, subsets)

    def held_out(self) -> HeldOut:
        """Its interactions, each filtered by others."""
        return HeldOut(self.known, self.tuned(), self.tuning)

    def factor(self) -> float:
        """The best one on R."""
        return best_factor(self.held_out(), scaled, self.scan, FACTORS, self.folder / "scan_scaled.json")

    def model(self, name: str = "ebip_tuned", **options: Any) -> InteractionModel:
        """What `learn` makes of it, with further options, in a folder of that name."""
        layout, task = self.known.layout, self.task
        settings = {field.name: getattr(self.tuning, field.name) for field in fields(self.tuning)}
        model = learn(
            self.known,
            targets=task.targets,
            sensors=[name for name in layout.names if name not in task.targets or name in _shown(task)],
            subsets=task.subsets,
            folder=self.folder / name,
            progress=lambda _: None,
            arm=None if task.arm is None else task.arm[0],
            joints=None if task.arm is None else task.arm[1],
            basis=self.primitive.basis,
            scan=self.scan,
            members=settings.pop("n_members"),
            ranks=Ranks(device=self.primitive.weights.device),
            **(settings | options),
        )
        if model.report["interrupted"]:
            raise KeyboardInterrupt
        return model if self.members is None else model.rebuilt(self.members)


def _shown(task: Task) -> set[str]:
    """Names of the modalities in any of its subsets."""
    return {name for names in task.subsets.values() for name in names}


def _filter(build: Callable[[Fold], InteractionFilter]) -> Callable[[Fold], Method | None]:
    return lambda fold: FilterMethod(build(fold), fold.seed)


def _ebip_minus(fold: Fold) -> InteractionFilter:
    with warnings.catch_warnings():
        # That no mixture fits is a finding of the paper, and says so once a fold.
        warnings.filterwarnings("ignore", message="no mixture of up to")
        return ebip_minus(fold.primitive, fold.n_members, seed=fold.seed)


def _ebip_scaled(fold: Fold) -> InteractionFilter:
    return scaled(fold.primitive, fold.factor(), fold.members)


def particle_tunable(primitive: InteractionPrimitive, factor: float, members: int | None = None) -> ParticleFilter:
    """A particle filter to be tuned: R depends on phase, particles move a little, gradients pass resampling."""
    return particle_filter(
        primitive,
        members,
        residual_variance=factor * primitive.residual_variance,
        weight_noise=0.05,
        context=BSplineBasis(4),
        softness=0.1,
    )


def _particle_filter_tuned(fold: Fold) -> InteractionFilter:
    record = fold.folder / "scan_particle.json"
    start = best_factor(fold.held_out(), particle_tunable, fold.scan, FACTORS, record)
    filter = particle_tunable(fold.primitive, start, fold.members)
    checkpoint = fold.folder / "particle_filter_tuned.pt"
    result = Tuner(filter, fold.known, *fold.tuned(), fold.tuning, checkpoint=checkpoint).run()
    if result.interrupted_at is not None:
        raise KeyboardInterrupt
    return filter


def _ballistic(fold: Fold) -> Method | None:
    """None where nothing is thrown."""
    return BallisticMethod(fold.known) if "ball" in fold.task.targets else None


def _gru(fold: Fold) -> Method:
    tuned, settings = fold.tuned(), RecurrentSettings(seed=fold.seed)
    targets, subsets = tuned.targets.cpu(), {name: mask.cpu() for name, mask in tuned.subsets.items()}
    return RecurrentMethod(fold.known, targets, subsets, settings, fold.ahead)


METHODS: dict[str, Callable[[Fold], Method | None]] = {
    "mean": lambda fold: MeanMethod(fold.primitive),
    "nearest": lambda fold: NearestMethod(fold.primitive),
    "ballistic": _ballistic,
    "ridge": lambda fold: RidgeMethod(fold.known, fold.tuned().targets.cpu(), fold.task.fractions, fold.ahead),
    "trees": lambda fold: TreesMethod(
        fold.known, fold.tuned().targets.cpu(), fold.task.fractions, fold.ahead, seed=fold.seed
    ),
    "trees_untold": lambda fold: UntoldTreesMethod(
        fold.known, fold.tuned().targets.cpu(), fold.task.fractions, fold.ahead, seed=fold.seed
    ),
    "gru": _gru,
    "bip": _filter(lambda fold: bip(fold.primitive)),
    "particle_filter": _filter(lambda fold: particle_filter(fold.primitive, fold.members)),
    "particle_filter_tuned": _filter(_particle_filter_tuned),
    "ebip_minus": _filter(_ebip_minus),
    "ebip": _filter(lambda fold: ebip(fold.primitive, fold.members)),
    "ebip_scaled": _filter(_ebip_scaled),
    "ebip_tuned": _filter(lambda fold: fold.model().filter),
}
"""Builders; one that does not apply to the recordings returns None."""

WITHOUT: dict[str, dict[str, Any]] = {
    "ebip_tuned_end_alone": {"ahead": (math.inf,)},
    "ebip_tuned_one_memory": {"memories": 1},
    "ebip_tuned_not_drawn": {"shrink": False},
    "ebip_tuned_no_gradient": {"steps": 0},
    "ebip_tuned_no_analogues": {"analogues": False},
}
"""What `learn` makes without one of its parts, by options of it."""


def without(name: str) -> Callable[[Fold], Method | None]:
    """The builder of one of `WITHOUT`, by its name."""
    return _filter(lambda fold: fold.model(name, **WITHOUT[name]).filter)
