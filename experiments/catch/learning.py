"""What the catchers know before the first throw: demonstrations, and filters of 80 of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from experiments.data import load, thinning
from experiments.methods import FACTORS, Problem, best_factor, best_start, keep, restore, scaled, tunable, tune
from experiments.run_folder import write_json
from torch_ebip import Filter, InteractionPrimitive, ebip, particle_filter, select_basis
from torch_ebip.monitor import Monitor
from torch_ebip.tuning import TuningSettings

MEMBERS = 80
"""Of an ensemble at work (the paper, section V)."""
HORIZONS = (0.4, 1.0)
"""Shares of an interaction after which forecasts are scored while tuning: from the middle of the wind-up on."""


def know(demonstrations: int, seed: int) -> InteractionPrimitive:
    """The primitive of the simulated demonstrations."""
    known, _ = load(None, demonstrations, seed)
    return InteractionPrimitive.fit(known, select_basis(known))


def learn(
    folder: Path,
    demonstrations: int,
    seed: int,
    steps: int,
    progress: Callable[[int, float, float], None] | None,
    scan: int = 48,
) -> None:
    """Tune a filter of 80 members for all sensors together, on all demonstrations; what is finished is kept.

    Args:
        folder: gets the filter, its report, checkpoints and TensorBoard's data.
        demonstrations: how many, simulated from the seed.
        seed: of data and draws.
        steps: gradient steps at most.
        progress: called with step, loss and validation.
        scan: interactions that decide where tuning starts.
    """
    if (folder / "filter.pt").exists():
        return
    known, task = load(None, demonstrations, seed)
    primitive = know(demonstrations, seed)
    layout = known.layout
    assert task.arm is not None
    arm = task.arm[0], layout.mask([task.arm[1]])
    problem = Problem(known, primitive, layout.mask(task.targets), {"all": layout.mask(task.subsets["all"])}, arm)
    settings = TuningSettings(seed=seed, steps=steps, thinning=thinning(known), n_members=MEMBERS, horizons=HORIZONS)

    def build(primitive: InteractionPrimitive, factor: float) -> Filter:
        return scaled(primitive, factor, MEMBERS)

    factor = best_factor(problem, build, settings, scan, FACTORS, folder / "scan_scaled.json")
    start = best_start(problem, settings, scan, factor, folder / "scan_tunable.json", MEMBERS)
    tuned = tunable(primitive, start, MEMBERS)
    with Monitor(folder / "tensorboard") as monitor:
        result = tune(problem, tuned, settings, monitor, folder / "checkpoint.pt", progress)
    report = {"start": start._asdict(), "factor_scaled": factor, "best_step": result.best_step}
    write_json(folder / "report.json", {**report, "validation": result.validation})
    keep(folder, start, tuned)


def filters(folder: Path, primitive: InteractionPrimitive, factor: float) -> dict[str, Callable[[], Filter]]:
    """How to make each filter that is compared, by name.

    Args:
        folder: see `learn`.
        primitive: see `know`.
        factor: the best single factor on R (`report.json`).
    """
    return {
        "ebip_tuned": lambda: restore(folder, primitive, MEMBERS),
        "ebip_tuned_all": lambda: restore(folder, primitive),
        "ebip_scaled": lambda: scaled(primitive, factor, MEMBERS),
        "ebip": lambda: ebip(primitive, MEMBERS),
        "particle_filter": lambda: particle_filter(primitive, MEMBERS),
    }
