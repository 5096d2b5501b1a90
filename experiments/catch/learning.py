"""What the catchers know before the first throw: demonstrations, and filters of 80 of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from experiments import methods
from experiments.data import load, thinning
from experiments.methods import Problem, restore, scaled
from torch_ebip import Filter, InteractionPrimitive, TuningSettings, ebip, particle_filter, select_basis

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
    known, task = load(None, demonstrations, seed)
    primitive = know(demonstrations, seed)
    layout = known.layout
    assert task.arm is not None
    arm = task.arm[0], layout.mask([task.arm[1]])
    problem = Problem(known, primitive, layout.mask(task.targets), {"all": layout.mask(task.subsets["all"])}, arm)
    settings = TuningSettings(seed=seed, steps=steps, thinning=thinning(known), n_members=MEMBERS, horizons=HORIZONS)
    methods.learn(folder, problem, settings, scan, MEMBERS, progress)


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
