"""From methods to values: what every method says of every test interaction, cell by cell."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from experiments.results import Cell, Values
from torch_ebip import Demonstrations, Filter, Forecast, InteractionPrimitive, RobotArm
from torch_ebip.common.draws import seeded
from torch_ebip.learning import metrics as measure
from torch_ebip.learning.references import ends, nearest


class Task(NamedTuple):
    """What is asked of the methods.

    Attributes:
        subsets: sensors that are shown together, modality names by subset.
        fractions: of the interaction that is shown.
        skipped: (subset, fraction) cells in which nothing can have been measured.
        targets: modalities to forecast, reported one by one.
        leading: how many of a target's first DoFs count for its squared error; default: all.
        arm: for the tool error, with the modality that holds its joints.
    """

    subsets: Mapping[str, Sequence[str]]
    fractions: Sequence[float]
    skipped: Sequence[tuple[str, float]]
    targets: Sequence[str]
    leading: Mapping[str, int]
    arm: tuple[RobotArm, str] | None


class Answer(NamedTuple):
    """What a method says of the end of B interactions at K fractions.

    Attributes:
        forecast: of phase 1, mean and variance [B, K, D]; NaN where the method has no opinion or no variance.
        phase: [B, K], where it believes the interaction is; NaN if it has no opinion.
    """

    forecast: Forecast
    phase: Tensor


class Method(Protocol):
    """Anything that answers."""

    def __call__(self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor) -> Answer:
        """Look at y [B, T, D] where observed, up to samples keep [B, K]; forecast the DoFs bool [D]."""


class FilterMethod:
    """A filter, on the device where it is, in float64.

    An overconfident filter, such as the closed form is, enlarges rounding errors of float32 to a percent of its
    results; what a table says should not depend on how a batch is cut.

    Args:
        filter: that answers, as it is now.
        seed: of the draws; each interaction has its own.
        numbers: of the interactions that will be asked about, for their draws; default: 0, 1, ...
        dtype: another one, for a study in which a percent does not matter.
        thinning: how many samples each one that it is shown stands for; see `Filter.restrict`.
    """

    def __init__(
        self,
        filter: Filter,
        seed: int,
        numbers: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float64,
        thinning: int = 1,
    ) -> None:
        self.filter, self.seed, self.numbers = filter, seed, numbers
        self.dtype, self.thinning = dtype, thinning
        self._filter = copy.deepcopy(filter).to(dtype)

    @torch.no_grad()
    def __call__(self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor) -> Answer:
        """See `Method`. DoFs that are neither shown nor asked for are left out of the filter."""
        used = observed.any(0).any(0) | dofs
        part = self._filter.restrict(used, self.thinning)
        device = next(part.buffers()).device
        numbers = range(len(y)) if self.numbers is None else self.numbers
        draws = [seeded(self.seed, number) for number in numbers]
        seen = (y[..., used].to(device, self.dtype), observed[..., used].to(device))
        trace = part(*seen, generator=draws, keep=keep.to(device), project=False)
        assert trace.kept is not None
        forecast = part.forecast(trace.kept, y.new_ones(1)).select(dofs[used].to(device)).at(0)
        tensors = (value.to(y) if isinstance(value, Tensor) else value for value in forecast)
        return Answer(Forecast(*tensors), part.phase(trace.kept).to(y))


class MeanMethod:
    """The mean of the training set, whatever is seen."""

    def __init__(self, primitive: InteractionPrimitive) -> None:
        self.ends = ends(copy.deepcopy(primitive).cpu())

    def __call__(self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor) -> Answer:
        """See `Method`."""
        members = self.ends[:, dofs].expand(*keep.shape, -1, -1)
        forecast = Forecast(members.mean(-2), members.var(-2), y.new_ones(keep.shape), members)
        return Answer(forecast, y.new_full(keep.shape, torch.nan))


class NearestMethod:
    """The training demonstration that is nearest so far, each running at its own speed.

    Distance: mean squared difference over what was measured, DoFs in units of their deviation.
    """

    def __init__(self, primitive: InteractionPrimitive) -> None:
        self.primitive = copy.deepcopy(primitive).cpu()
        self.ends = ends(self.primitive)

    def __call__(self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor) -> Answer:
        """See `Method`."""
        primitive = self.primitive
        chosen = nearest(primitive, y, observed, keep, 1 / primitive.rate)
        mean = self.ends[:, dofs][chosen]
        at = (keep / primitive.rate * primitive.phase_velocity[chosen]).to(y)
        return Answer(Forecast(mean, torch.full_like(mean, torch.nan), y.new_ones(keep.shape)), at)


def evaluate(
    task: Task, methods: Mapping[str, Method], tests: Demonstrations, shown: Demonstrations | None = None
) -> Values:
    """Values of every metric for every cell, method and test interaction.

    Args:
        task: what is asked.
        methods: that answer.
        tests: what really happened.
        shown: what methods get to see of it, sample by sample; default: all that was measured.
    """
    y, measured = (tests if shown is None else shown).pad()
    lengths = tests.lengths
    layout = tests.layout
    targets = layout.mask(task.targets)
    truth = torch.stack([last_measured(trajectory) for trajectory in tests])
    steps = torch.stack([(lengths * fraction).round().long() - 1 for fraction in task.fractions], -1).clamp(min=0)
    length = int(steps.max()) + 1
    within = torch.arange(length).view(1, -1, 1) <= steps.amax(-1).view(-1, 1, 1)
    true_phase = steps / (lengths - 1).unsqueeze(-1)
    values: Values = {}
    for subset, names in task.subsets.items():
        observed = measured[:, :length] & layout.mask(names) & within
        for name, method in methods.items():
            answer = method(y[:, :length], observed, steps, targets)
            for k, fraction in enumerate(task.fractions):
                if (subset, fraction) not in task.skipped:
                    for cell, array in _metrics(task, tests, subset, fraction, answer, k, truth, true_phase[:, k]):
                        values.setdefault(cell, {})[name] = array.numpy().astype(np.float64)
    return values


def _metrics(
    task: Task,
    tests: Demonstrations,
    subset: str,
    fraction: float,
    answer: Answer,
    k: int,
    truth: Tensor,
    phase: Tensor,
) -> list[tuple[Cell, Tensor]]:
    layout = tests.layout
    targets = layout.mask(task.targets)
    order = targets.nonzero().squeeze(-1).tolist()
    found: list[tuple[Cell, Tensor]] = []
    for modality in task.targets:
        part = layout.slice(modality)
        columns = [order.index(dof) for dof in range(part.start, part.stop)]
        target = truth[:, part]
        forecast = answer.forecast.at(k).select(torch.tensor(columns))
        unit = layout[modality].unit
        lead = torch.arange(task.leading.get(modality, len(columns)))
        squares = measure.mse(forecast.select(lead), target[:, lead])
        found.append((Cell(subset, fraction, "mse", modality, f"{unit}^2"), squares))
        found.append((Cell(subset, fraction, "mae", modality, unit), measure.mae(forecast, target)))
        if not forecast.variance.isnan().all():
            inside = measure.coverage_95(forecast, target)
            found.append((Cell(subset, fraction, "coverage_95", modality, "1"), inside))
            found.append((Cell(subset, fraction, "crps", modality, unit), measure.crps(forecast, target)))
    if task.arm is not None:
        arm, modality = task.arm
        names = layout[modality].dofs
        # By name where they have the arm's, as the loss takes them.
        joints = arm.joint_names if set(arm.joint_names) <= set(names) else names
        places = [layout.dofs.index(name) for name in joints]
        columns = [order.index(dof) for dof in places]
        distance = measure.tool_error(arm, answer.forecast.at(k).mean[..., columns], truth[:, places])
        found.append((Cell(subset, fraction, "tool_error", None, "m"), distance))
    if not answer.phase.isnan().any():
        found.append(
            (Cell(subset, fraction, "phase_error", None, "1"), measure.phase_error(answer.phase[:, k], phase))
        )
    return found


def last_measured(trajectory: Tensor) -> Tensor:
    """[D]: the last measured value of each DoF, NaN for one that was not measured in the last twentieth."""
    recent = trajectory[-max(1, len(trajectory) // 20) :]
    steps = torch.arange(len(recent)).unsqueeze(-1)
    last = torch.where(recent.isnan(), -1, steps).amax(0)
    return torch.where(last >= 0, recent.gather(0, last.clamp(min=0).unsqueeze(0))[0], torch.nan)
