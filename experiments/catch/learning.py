"""What the catchers know before the first throw: demonstrations, and filters of 80 of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch_ebip
from experiments.data import load
from torch_ebip import Filter, InteractionPrimitive, ebip, load_model, particle_filter, select_basis
from torch_ebip.learning import Progress
from torch_ebip.learning.starts import scaled

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
    progress: Callable[[Progress], None] | None,
    scan: int = 48,
    **options: Any,
) -> None:
    """Learn a model of 80 members for all sensors together, of all demonstrations; what is finished is kept.

    Args:
        folder: gets the model, its report, checkpoints and TensorBoard's data.
        demonstrations: how many, simulated from the seed.
        seed: of data and draws.
        steps: gradient steps at most.
        progress: called with a `Progress`.
        scan: interactions that decide where tuning starts.
        options: further ones of `torch_ebip.learn`.
    """
    known, task = load(None, demonstrations, seed)
    assert task.arm is not None
    sensors = task.subsets["all"]
    model = torch_ebip.learn(
        known,
        targets=task.targets,
        sensors=[name for name in known.layout.names if name not in task.targets or name in sensors],
        subsets={"all": sensors},
        steps=steps,
        seed=seed,
        folder=folder,
        progress=progress,
        members=MEMBERS,
        arm=task.arm[0],
        joints=task.arm[1],
        scan=scan,
        horizons=HORIZONS,
        **options,
    )
    if model.report["interrupted"]:
        raise KeyboardInterrupt


def filters(folder: Path, primitive: InteractionPrimitive, factor: float) -> dict[str, Callable[[], Filter]]:
    """How to make each filter that is compared, by name.

    Args:
        folder: see `learn`.
        primitive: see `know`.
        factor: the best single factor on R (`report.json`).
    """
    return {
        "ebip_tuned": lambda: load_model(folder).rebuilt(MEMBERS).filter,
        "ebip_tuned_all": lambda: load_model(folder).rebuilt(len(primitive)).filter,
        "ebip_scaled": lambda: scaled(primitive, factor, MEMBERS),
        "ebip": lambda: ebip(primitive, MEMBERS),
        "particle_filter": lambda: particle_filter(primitive, MEMBERS),
    }
