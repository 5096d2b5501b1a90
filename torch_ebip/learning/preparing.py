"""What a learning stands on: a basis, a phase, a primitive, and what is asked of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from torch_ebip.interaction.basis.selection import CandidateFit, rank_candidates, select_basis
from torch_ebip.interaction.basis.stacked import StackedBasis
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.kinematics import RobotArm
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.course import course_error, why_not_periodic
from torch_ebip.learning.groups import labelled
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.horizons import horizon_name, reached
from torch_ebip.learning.losses import ForwardKinematicsLoss
from torch_ebip.learning.objective import objective_for
from torch_ebip.learning.ranks import Ranks
from torch_ebip.learning.settings import TuningSettings
from torch_ebip.recordings.demonstrations import Demonstrations


@dataclass(frozen=True)
class Asked:
    """What a caller asked for.

    Attributes:
        targets: names of modalities.
        subsets: sets of sensors, names of modalities by the name of the set.
        ahead: horizons, s.
        arm, joints: see `learn`.
    """

    targets: tuple[str, ...]
    subsets: Mapping[str, tuple[str, ...]]
    ahead: tuple[float, ...]
    arm: RobotArm | ForwardKinematicsLoss | None = None
    joints: str | None = None


@dataclass(frozen=True)
class Prepared:
    """What a learning stands on.

    Attributes:
        known: the demonstrations, with labels where there are any.
        primitive: of them.
        task, held_out: what is asked.
        ranking: of bases; None where one was given.
        remarks: what there is to say.
        course: CRPS by the phase that was tried, ``once`` and ``circle``; empty where only one was.
    """

    known: Demonstrations
    primitive: InteractionPrimitive
    task: Task
    held_out: HeldOut
    ranking: Sequence[CandidateFit] | None
    remarks: list[str]
    course: dict[str, float] = field(default_factory=dict)


def prepared(
    known: Demonstrations,
    asked: Asked,
    basis: StackedBasis | None,
    periodic: bool | Sequence[str] | None,
    settings: TuningSettings,
    ranks: Ranks,
) -> Prepared:
    """Basis, phase, primitive and task.

    Args:
        known: the demonstrations.
        asked: of them.
        basis: default: the best by BIC.
        periodic: whether they repeat, or labels of all those that do; default: as the basis says, or as forecasts of
            interactions left out do.
        settings: of ensembles and draws.
        ranks: the processes that share the work.

    Raises:
        ValueError: periodic demonstrations that do not repeat, or hold less than a cycle; labels that there are not,
            or not all of them; see `learn`.
    """
    periodic = periodic if periodic is None else _all_or_none(periodic, known)
    if basis is not None or periodic is not None:
        return _fitted(known, asked, basis, bool(periodic), settings, ranks)
    once = _fitted(known, asked, None, False, settings, ranks)
    if why_not_periodic(known) is not None:
        return once
    circle = _fitted(known, asked, None, True, settings, ranks)
    scale = once.task.objective.scale[: len(circle.task.objective.scale)]  # of the horizons that both have
    errors = [course_error(each.held_out, scale) for each in (once, circle)]
    best = once if errors[0] <= errors[1] else circle
    best.course.update({"once": round(errors[0], 5), "circle": round(errors[1], 5)})
    return best


def _all_or_none(periodic: bool | Sequence[str], known: Demonstrations) -> bool:
    """Whether all demonstrations repeat, by the labels of those that do."""
    if isinstance(periodic, bool):
        return periodic
    named = [periodic] if isinstance(periodic, str) else list(periodic)
    labels = list(dict.fromkeys(known.labels or ()))
    strange = [name for name in named if name not in labels]
    if strange:
        there = ", ".join(labels) or "none"
        raise ValueError(f"periodic names labels {', '.join(map(str, strange))}; the demonstrations have {there}")
    others = [label for label in labels if label not in named]
    if named and others:
        raise ValueError(
            f"{', '.join(named)} repeat and {', '.join(others)} do not: a phase cannot do both; learn a model of "
            "each, of the demonstrations with these labels"
        )
    return bool(named)


def _fitted(
    known: Demonstrations,
    asked: Asked,
    basis: StackedBasis | None,
    periodic: bool,
    settings: TuningSettings,
    ranks: Ranks,
) -> Prepared:
    layout = known.layout
    ranking = None if basis is not None else rank_candidates(known, periodic=periodic)
    basis = select_basis(known, ranking=ranking) if basis is None else basis
    primitive = InteractionPrimitive.fit(known, basis, periodic=periodic).to(ranks.device)
    targets = layout.mask(asked.targets).to(primitive.weights.device)
    known, remarks = labelled(known, primitive, settings.seed, ranks)
    primitive.labels = known.labels
    there = reached(primitive, asked.ahead)
    circle = primitive.periodic
    if circle and len(there) > 1:
        there = [a for a in there if not math.isinf(a)]
    short = ", ".join(horizon_name(a) for a in asked.ahead if a not in there)
    if short:
        why = "nobody knows when a wave ends" if circle else "hardly any demonstration goes on for so long"
        remarks.append(f"not scored, because {why}: {short}")
    objective = objective_for(primitive, targets, asked.targets, there, asked.arm, asked.joints)
    masks = {name: layout.mask(names).to(targets.device) for name, names in asked.subsets.items()}
    task = Task(primitive, objective, targets, masks)
    return Prepared(known, primitive, task, HeldOut(known, task, settings, ranks), ranking, remarks)
