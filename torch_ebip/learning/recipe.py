"""From recordings to a model: basis by BIC, closed form, best factor, best start, gradient, shrinkage.

Every stage is scored on interactions that its ensembles do not contain, and the best of them is what is returned.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from typing import Any

from torch_ebip.common.ambient import in_own_modes
from torch_ebip.common.arguments import as_count
from torch_ebip.interaction.basis.stacked import StackedBasis
from torch_ebip.interaction.tail import as_chances
from torch_ebip.kinematics import RobotArm
from torch_ebip.learning.horizons import AHEAD
from torch_ebip.learning.interaction_model import InteractionModel
from torch_ebip.learning.losses import ForwardKinematicsLoss
from torch_ebip.learning.monitor import Monitor
from torch_ebip.learning.procedure import Procedure
from torch_ebip.learning.progress import Progress, Reporter
from torch_ebip.learning.ranks import Ranks
from torch_ebip.learning.settings import settings_for
from torch_ebip.recordings.copies import copies
from torch_ebip.recordings.demonstrations import Demonstrations


@in_own_modes
def learn(
    demonstrations: Demonstrations,
    *,
    targets: Sequence[str] | None = None,
    sensors: Sequence[str] | None = None,
    steps: int = 100,
    seed: int = 0,
    folder: str | os.PathLike[str] | None = None,
    progress: Callable[[Progress], None] | None = None,
    subsets: Mapping[str, Sequence[str]] | None = None,
    members: int | None = None,
    arm: RobotArm | ForwardKinematicsLoss | None = None,
    joints: str | None = None,
    basis: StackedBasis | None = None,
    shrink: bool = True,
    analogues: bool = True,
    expert: bool = True,
    pace: bool = True,
    periodic: bool | Sequence[str] | None = None,
    ahead: Sequence[float] = AHEAD,
    memories: int = 2,
    scan: int = 48,
    suspect: float = 0.03,
    rejected: float = 0.005,
    ranks: Ranks | None = None,
    **tuning: Any,
) -> InteractionModel:
    """The whole recipe, from recordings to a model that can be kept, loaded and run.

    Basis by BIC, the closed form, the best single factor on R, the best start of the tuned filter, the gradient, and
    how far forecasts are drawn towards the training mean. The next 0.1, 0.25, 0.5 and 1 s and the end count alike.
    Where nobody labelled the demonstrations groups are looked for. `InteractionModel.report` says what each gave on
    interactions left out. With fewer than ten demonstrations there is no gradient, because nothing could tell when to
    stop; with fewer than twenty the pull towards the start is stronger.

    Args:
        demonstrations: at least 3.
        targets: names of the modalities to forecast; default: those that are controlled.
        sensors: names of those that are shown; default: all others. What is neither is left out of the model.
        steps: of the gradient, at most; 0 for none.
        seed: of everything random.
        folder: path for records, checkpoints, TensorBoard's data and the model; an interrupted call with the same
            folder goes on, a finished one is read. Default: nothing is kept.
        progress: called with a `Progress`; default: a bar, where there is a terminal.
        subsets: sets of sensors that may be shown together, modality names by the name of the set; default: all.
        members: E, of ensembles while tuning and of the model's filter; default: all demonstrations.
        arm: whose tool's distance (m) is a term of what is minimised; default: none. A loss says how much
            the rotation counts, otherwise 0.1.
        joints: name of the target that holds the arm's joints (rad, or m where one slides); default: the one whose
            DoFs have their names, or are as many.
        basis: default: `select_basis`.
        shrink: whether forecasts are drawn towards the training mean, see `HorizonShrinkage`.
        analogues: whether they may be put together with those of analogues, where that is better; see
            `AnalogueReadout`.
        expert: whether a recurrent network may be heard beside analogues, where that is better; see `Expert`.
        pace: whether people may pause, start late or start over, where a `PhaseBank` makes that better; of those who
            repeat themselves a bank follows the phase in any case, unless this finds that it is better without.
        periodic: whether they repeat, as waves do, so that their phase goes round a circle, see `CyclicPhase`; or the
            labels of those that do, which must be all; default: where they seem to, and forecasts of interactions
            left out are better then. Nobody knows when a wave ends: the end is then not scored.
        ahead: horizons that count alike, in s, increasing; the last is infinity, the end.
        memories: of the evidence: 2, a fast and a slow one, or the fast one alone.
        scan: how many interactions decide where the gradient starts.
        suspect, rejected: chances with which a sensor that is well seems suspect, or is rejected, in an interaction
            like those demonstrated; see `InteractionSurprise`.
        ranks: the processes that share the work; default: this one.
        tuning: further settings of `TuningSettings`, such as ``batch_size``.

    Returns:
        The best of the stages. Interrupted (Ctrl-C), the best so far; its report says so.

    Raises:
        ValueError: fewer than 3 demonstrations; names that there are not; a target that no demonstration moves; an
            arm whose joints are not targets; periodic ones that do not repeat, hold less than a cycle, or are only
            some; a folder of another learning; says which, and writes nothing.
        KeyboardInterrupt: there was nothing to keep yet.

    Example:
        >>> from torch_ebip import learn
        >>> from torch_ebip.recordings import example
        >>> model = learn(example().subset(range(6)), sensors=["hand"], scan=6)
        >>> model.sensors, model.targets, model.report["chosen"] in ("closed_form", "factor", "start")
        (('hand',), ('robot',), True)
    """
    if len(demonstrations) < 3:
        raise ValueError(f"learning needs at least 3 demonstrations, got {len(demonstrations)}")
    as_count("steps", steps, 0)
    as_count("scan", scan)
    targets, sensors = (None if names is None else _names(role, names) for role, names in
                        (("targets", targets), ("sensors", sensors)))  # fmt: skip
    known = demonstrations.assign(targets, sensors)
    if targets is None:
        targets = [m.name for m in demonstrations.layout.modalities if m.controlled]
    if sensors is None:
        sensors = [name for name in demonstrations.layout.names if name not in targets]
    if subsets is not None and (not isinstance(subsets, Mapping) or not subsets):
        raise ValueError(f"subsets must be names of modalities by the name of the set, got {str(subsets)[:80]}")
    if joints is not None and arm is None:
        raise ValueError(f"joints={joints!r} without an arm that they are of")
    shown = (
        {"all": tuple(sensors)}
        if subsets is None
        else {name: _names(f"subset {name!r}", names) for name, names in subsets.items()}
    )
    strangers = {name for names in shown.values() for name in names} - set(sensors)
    if strangers:
        raise ValueError(f"subsets name {', '.join(sorted(strangers))}; the sensors are {', '.join(sensors)}")
    ahead = tuple(float(a) for a in ahead)
    if not ahead or not math.isinf(ahead[-1]) or any(b <= a for a, b in pairwise(ahead)):
        raise ValueError(f"ahead must be increasing seconds, math.inf (the end) the last, got {list(ahead)}")
    if as_count("memories", memories) > 2:
        raise ValueError(f"memories must be 1 or 2, got {memories}")
    chances = as_chances(suspect, rejected)
    settings = settings_for(known, max(steps, 1), seed, members, tuning)
    ranks = Ranks() if ranks is None else ranks
    run = Procedure(
        known,
        tuple(targets),
        shown,
        settings,
        members,
        scan,
        steps,
        shrink,
        analogues,
        expert,
        pace,
        periodic,
        ahead,
        memories,
        chances,
        ranks,
    )
    run.prepare(arm, joints, basis)
    run.remarks += [
        f"recordings {', '.join(map(str, same))} are the same: what is left out is then known, scores are too good"
        for same in copies(known)
    ]
    place = None if folder is None else Path(folder)
    if place is not None:
        done = run.enter(place)
        if done is not None:
            return done
    reporter = Reporter(progress if ranks.first else (lambda _: None), run.work)
    try:
        with Monitor(place / "tensorboard") if place is not None and ranks.first else nullcontext() as monitor:
            return run.go(place, monitor, reporter)
    finally:
        reporter.close()


def _names(role: str, names: Sequence[str]) -> tuple[str, ...]:
    """Names of modalities, at least one."""
    if isinstance(names, str) or not hasattr(names, "__iter__"):
        raise ValueError(f"{role} must be different names of modalities, got {names!r}")
    several = tuple(names)
    if not several:
        raise ValueError(f"no {role}: name at least one modality")
    return several
