"""The filters that `experiments.tune` compares: closed form, best single factor, tuned."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip import (
    AboveOne,
    BSplineBasis,
    Demonstrations,
    EnsembleFilter,
    Filter,
    InteractionPrimitive,
    ParticleFilter,
    RobotArm,
    RobustWeights,
    Tuner,
    TuningResult,
    TuningSettings,
    ebip,
    particle_filter,
)
from torch_ebip.common.files import read_json, write_json
from torch_ebip.learning.checkpoint import load_checkpoint, save_checkpoint
from torch_ebip.learning.losses import ForwardKinematicsLoss
from torch_ebip.learning.monitor import Monitor
from torch_ebip.learning.objective import ForecastObjective, Weights
from torch_ebip.learning.ranks import Ranks

FACTORS = (1.0, 10.0, 100.0, 1000.0, 10000.0)
"""Coarse grid of factors on the closed-form R; the best one is refined by half-decades."""
SHARPNESSES = (3.16, 10.0, 31.6)
"""Of the evidence weights, tried with every half-decade of R up to the best factor."""


class Start(NamedTuple):
    """Where the gradient starts: a factor on R, and the sharpness of the evidence weights."""

    factor: float
    sharpness: float


@dataclass(frozen=True)
class Problem:
    """What is tuned for.

    Attributes:
        demonstrations: of the training part only.
        primitive: of these demonstrations.
        targets: bool [D], DoFs to forecast.
        subsets: bool [D] of sensors by name.
        arm: with bool [D] of its joints, for the forward-kinematics term; None without one.
        ranks: the processes that share the work on it.
    """

    demonstrations: Demonstrations
    primitive: InteractionPrimitive
    targets: Tensor
    subsets: Mapping[str, Tensor]
    arm: tuple[RobotArm, Tensor] | None
    ranks: Ranks = field(default_factory=Ranks)

    def objective(self) -> ForecastObjective:
        """CRPS and squared error of the targets, plus the tool's distance where there is an arm."""
        targets = self.targets.to(self.primitive.weights.device)
        if self.arm is None:
            return ForecastObjective(self.primitive, targets)
        arm, joints = self.arm
        joints = joints.to(targets.device)
        weights = Weights(tool=1.0)
        loss = ForwardKinematicsLoss(arm, rotation_weight=0.1)
        return ForecastObjective(self.primitive, targets, weights=weights, arm=loss, arm_dofs=joints)


def scaled(primitive: InteractionPrimitive, factor: float, members: int | None = None) -> EnsembleFilter:
    """The paper's eBIP with its R times one factor."""
    return ebip(primitive, members, residual_variance=factor * primitive.residual_variance)


def tunable(
    primitive: InteractionPrimitive, start: Start, members: int | None = None, robust: RobustWeights | None = None
) -> EnsembleFilter:
    """What is tuned: square-root eBIP whose R depends on phase, with inflation and evidence weights."""
    return ebip(
        primitive,
        members,
        residual_variance=start.factor * primitive.residual_variance,
        context=BSplineBasis(4),
        robust=robust,
        inflation=AboveOne(primitive.weights.new_tensor(1.002)),
        square_root=True,
        weigh=True,
        sharpness=start.sharpness,
    )


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


def best_factor(
    problem: Problem,
    build: Callable[[InteractionPrimitive, float], Filter],
    settings: TuningSettings,
    interactions: int,
    factors: Sequence[float],
    record: Path,
) -> float:
    """The factor on R with the smallest loss on training interactions: what a sceptic does instead of gradients.

    Args:
        problem: the training part.
        build: a filter from a primitive and a factor.
        settings: of the ensembles and horizons, the same as for tuning.
        interactions: how many training interactions decide.
        factors: grid; half-decades around its best one are tried too.
        record: file of the losses, written when all are known; if it exists, its best factor is returned.
    """
    if record.exists():
        content = read_json(record)
        try:
            stored = {float(factor): loss for factor, loss in content.items()}
            return min(stored, key=lambda factor: stored[factor])
        except (AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"{record}: expected a loss for every factor: {error}") from error
    losses: dict[float, float] = {}
    order = torch.randperm(len(problem.primitive), generator=torch.Generator().manual_seed(settings.seed + 1))

    def measure(factors: Sequence[float]) -> None:
        for factor in factors:
            if factor not in losses:
                tuner = _tuner(problem, build(problem.primitive, factor), settings)
                losses[factor] = tuner.evaluate(order[:interactions])["loss"]

    measure(factors)
    best = min(losses, key=lambda factor: losses[factor])
    measure([float(f"{best * 10**half:.4g}") for half in (-0.5, 0.5)])
    if problem.ranks.first:
        write_json(record, losses)
    return min(losses, key=lambda factor: losses[factor])


def best_start(
    problem: Problem,
    settings: TuningSettings,
    interactions: int,
    factor: float,
    record: Path,
    members: int | None = None,
) -> Start:
    """The start of `tunable` with the smallest loss, among half-decades of R up to a factor, and `SHARPNESSES`.

    The factor is the best one without evidence weights, which take over a part of what a large R is for. `members` is
    the size of the filter's ensemble. Other arguments: see `best_factor`.
    """
    if not record.exists():
        order = torch.randperm(len(problem.primitive), generator=torch.Generator().manual_seed(settings.seed + 1))
        losses: list[dict[str, float]] = []
        for half, sharpness in product((-1.0, -0.5, 0.0), SHARPNESSES):
            start = Start(float(f"{factor * 10**half:.4g}"), sharpness)
            filter = tunable(problem.primitive, start, members)
            loss = _tuner(problem, filter, settings).evaluate(order[:interactions])["loss"]
            losses.append({**start._asdict(), "loss": loss})
        if problem.ranks.first:
            write_json(record, losses)
    else:
        losses = read_json(record)
    try:
        best = min(losses, key=lambda entry: entry["loss"])
        return Start(best["factor"], best["sharpness"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{record}: expected a list of starts with their losses: {error}") from error


def tune(
    problem: Problem,
    filter: Filter,
    settings: TuningSettings,
    monitor: Monitor | None,
    checkpoint: Path | None,
    progress: Callable[[int, float, float], None] | None,
) -> TuningResult:
    """Tune a filter in place."""
    return _tuner(problem, filter, settings, monitor, checkpoint, progress).run()


def _tuner(
    problem: Problem,
    filter: Filter,
    settings: TuningSettings,
    monitor: Monitor | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[int, float, float], None] | None = None,
) -> Tuner:
    return Tuner(
        filter,
        problem.demonstrations,
        problem.primitive,
        problem.objective(),
        problem.targets,
        problem.subsets,
        settings,
        monitor,
        checkpoint,
        progress,
        problem.ranks,
    )


def learn(
    folder: Path,
    problem: Problem,
    settings: TuningSettings,
    scan: int,
    members: int,
    progress: Callable[[int, float, float], None] | None,
) -> None:
    """Tune a filter of some members from the best start there is; what is finished is kept.

    Args:
        folder: gets the filter for `restore`, its report, checkpoints and TensorBoard's data.
        problem: what is tuned for.
        settings: with the same number of members.
        scan: interactions that decide where tuning starts.
        members: of the ensemble.
        progress: called with step, loss and validation.
    """
    if (folder / "filter.pt").exists():
        return

    def build(primitive: InteractionPrimitive, factor: float) -> Filter:
        return scaled(primitive, factor, members)

    factor = best_factor(problem, build, settings, scan, FACTORS, folder / "scan_scaled.json")
    start = best_start(problem, settings, scan, factor, folder / "scan_tunable.json", members)
    tuned = tunable(problem.primitive, start, members)
    with Monitor(folder / "tensorboard") as monitor:
        result = tune(problem, tuned, settings, monitor, folder / "checkpoint.pt", progress)
    report = {"start": start._asdict(), "factor_scaled": factor, "best_step": result.best_step}
    write_json(folder / "report.json", {**report, "validation": result.validation})
    keep(folder, start, tuned)


def keep(folder: Path, start: Start, tuned: EnsembleFilter) -> None:
    """Leave a tuned filter in a folder, for `restore`."""
    parameters = {name: p.detach().cpu() for name, p in tuned.named_parameters()}
    save_checkpoint(folder / "filter.pt", {"start": start._asdict()}, {"parameters": parameters})


def restore(
    folder: Path, primitive: InteractionPrimitive, members: int | None = None, robust: RobustWeights | None = None
) -> EnsembleFilter:
    """The tuned filter that an experiment left in a run (or fold) folder.

    Args:
        folder: with ``report.json`` and ``filter.pt``.
        primitive: of the demonstrations that it was tuned on.
        members: size of its ensemble; default: all demonstrations.
        robust: what surprising measurements count; default: as much as others, as while tuning.

    Raises:
        FileNotFoundError, ValueError: the files are not there, or not what a run writes.
    """
    report = read_json(folder / "report.json")
    try:
        start = Start(**{name: float(value) for name, value in report["start"].items()})
        filter = tunable(primitive, start, members, robust)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{folder / 'report.json'}: says of no filter where it started: {error}") from error
    parameters = load_checkpoint(folder / "filter.pt", {"start": start._asdict()}).get("parameters")
    try:
        names = {name for name, _ in filter.named_parameters() if not name.startswith("noise.robust.")}
        missing = names ^ set(parameters)
        if missing:
            raise ValueError(f"other parameters: {', '.join(sorted(map(str, missing)))[:200]}")
        if not all(bool(parameter.isfinite().all()) for parameter in parameters.values()):
            raise ValueError("parameters that are not finite")
        filter.load_state_dict(parameters, strict=False)  # buffers are the primitive's
    except (AttributeError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{folder / 'filter.pt'}: not the filter of this run: {error}") from error
    return filter
