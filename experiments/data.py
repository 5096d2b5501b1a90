"""Recordings, and what is asked of them."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.evaluate import Task
from torch_ebip import Demonstrations, Layout

FRACTIONS = (0.43, 0.82)
"""Shares of an interaction that the paper shows: before the ball is thrown, and on its way."""
SAMPLES = 14
"""How many samples of an interaction are used while tuning."""


def load(data: str | None, count: int, seed: int) -> tuple[Demonstrations, Task]:
    """Recordings and what is asked of them."""
    if count < 1:
        raise SystemExit(f"--demonstrations must be at least 1, got {count}")
    if data is not None:
        try:
            demonstrations = Demonstrations.load(data)
        except (ValueError, OSError) as error:
            raise SystemExit(str(error)) from error
        layout = demonstrations.layout
        sensors = [modality.name for modality in layout.modalities if not modality.controlled]
        targets = [modality.name for modality in layout.modalities if modality.controlled]
        if not sensors or not targets:
            raise SystemExit(f"{data}: needs observed and controlled modalities, has {', '.join(layout.names)}")
        return demonstrations, Task({"all": sensors}, FRACTIONS, [], targets, {}, None)
    from experiments.ball_catching import SUBSETS, load_or_generate, teacher

    task = Task(
        SUBSETS, FRACTIONS, [("ball", FRACTIONS[0])], ["robot", "ball"], {"robot": 3}, (teacher.arm(), "robot")
    )
    return load_or_generate(count, seed), task


def choose_subsets(task: Task, layout: Layout, asked: Sequence[str], alone: bool) -> Task:
    """The task with other subsets of sensors.

    Args:
        task: with its own subsets.
        layout: of the recordings.
        asked: names of the task's subsets, or modality names joined by ``+``; none: see ``alone``.
        alone: if none are asked for, add each sensor modality alone before the task's subsets.

    Raises:
        SystemExit: a subset that names no modality, or one that is to be forecast.
    """
    sensors = [modality.name for modality in layout.modalities if not modality.controlled]
    subsets = {}
    for subset in asked:
        names = task.subsets.get(subset, tuple(subset.split("+")))
        for name in names:
            if name not in sensors:
                raise SystemExit(f"--subsets {subset}: {name!r} is no sensor; known: {', '.join(sensors)}, all")
        subsets[subset] = names
    if not asked:
        subsets = {**({name: (name,) for name in sensors} if alone and len(sensors) > 1 else {}), **task.subsets}
    skipped = [(subset, fraction) for subset, fraction in task.skipped if subset in subsets]
    return task._replace(subsets=subsets, skipped=skipped)


def thinning(demonstrations: Demonstrations) -> int:
    """Every how many samples suffice for tuning: neighbouring ones say nearly the same."""
    return max(1, round(float(demonstrations.lengths.double().median()) / SAMPLES))
