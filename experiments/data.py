"""Recordings, and what is asked of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from experiments.evaluate import Task
from torch_ebip import Demonstrations, Layout, RobotArm
from torch_ebip.learning import horizons
from torch_ebip.learning.objective import joints_of
from torch_ebip.learning.settings import settings_for
from torch_ebip.recordings import read

FRACTIONS = (0.43, 0.82)
"""Shares of an interaction that the paper shows: before the ball is thrown, and on its way."""

AHEAD = horizons.AHEAD[:-1]
"""Seconds after the last sample that is shown: what a partner needs is what comes next."""


@dataclass(frozen=True)
class Roles:
    """What recordings of one's own are asked for, beside what they say themselves.

    Attributes:
        sensors, targets: names of modalities; None: as the recordings say.
        arm: path of a URDF; None for no arm.
        tip: link of it whose frame carries the tool.
    """

    sensors: tuple[str, ...] | None = None
    targets: tuple[str, ...] | None = None
    arm: str | None = None
    tip: str | None = None


def load(data: str | None, count: int, seed: int, roles: Roles | None = None) -> tuple[Demonstrations, Task]:
    """Recordings and what is asked of them: a file, a folder of CSV files, or (None) the simulation."""
    if count < 1:
        raise SystemExit(f"--demonstrations must be at least 1, got {count}")
    roles = Roles() if roles is None else roles
    if data is not None:
        try:
            demonstrations = read(data)
            given = demonstrations.layout
            if roles.targets is None and not bool(given.controlled.any()):
                raise ValueError(
                    f"{data}: needs observed and controlled modalities, has {', '.join(given.names)}; say with "
                    "--targets which are to be forecast"
                )
            demonstrations = demonstrations.assign(roles.targets, roles.sensors)
            layout = demonstrations.layout
            targets = [name for name in layout.names if name in (roles.targets or ()) or layout[name].controlled]
            sensors = [name for name in layout.names if not layout[name].controlled]
            arm = None
            if roles.arm is not None:
                if roles.tip is None:
                    raise ValueError("--arm needs --tip, the link of it that carries the tool")
                made = RobotArm(roles.arm, roles.tip)
                arm = made, joints_of(made, layout, targets)[0]
        except (ValueError, OSError, ImportError) as error:
            raise SystemExit(str(error)) from error
        return demonstrations, Task({"all": sensors}, FRACTIONS, [], targets, {}, arm, AHEAD)
    if roles != Roles():
        raise SystemExit("--sensors, --targets, --arm and --tip go with --data")
    from experiments.ball_catching import SUBSETS, load_or_generate, teacher

    task = Task(
        SUBSETS, FRACTIONS, [("ball", FRACTIONS[0])], ["robot", "ball"], {"robot": 3}, (teacher.arm(), "robot"), AHEAD
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
    return settings_for(demonstrations, 1, 0, None, {}).thinning
