"""From methods to values: what every method says of every test interaction, cell by cell."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from experiments.results import Cell, Values
from torch_ebip import (
    Demonstrations,
    Forecast,
    InteractionFilter,
    InteractionPrimitive,
    Layout,
    RobotArm,
)
from torch_ebip.common.draws import seeded
from torch_ebip.learning import metrics as measure
from torch_ebip.learning.references import last_measured, nearest, paths_after, recorded


class Task(NamedTuple):
    """What is asked of the methods.

    Attributes:
        subsets: sensors that are shown together, modality names by subset.
        fractions: of the interaction that is shown.
        skipped: (subset, fraction) cells in which nothing can have been measured.
        targets: modalities to forecast, reported one by one.
        leading: how many of a target's first DoFs count for its squared error; default: all.
        arm: for the tool error, with the modality that holds its joints.
        ahead: seconds after the last sample that is shown, to forecast beside the end.
    """

    subsets: Mapping[str, Sequence[str]]
    fractions: Sequence[float]
    skipped: Sequence[tuple[str, float]]
    targets: Sequence[str]
    leading: Mapping[str, int]
    arm: tuple[RobotArm, str] | None
    ahead: tuple[float, ...] = ()


END = (math.inf,)
"""What is asked if nothing else is: the end."""


class Answer(NamedTuple):
    """What a method says of B interactions at K fractions, for A horizons.

    Attributes:
        forecast: mean and variance [B, K, A, D]; NaN where the method has no opinion or no variance.
        phase: [B, K], where it believes the interaction is; NaN if it has no opinion.
    """

    forecast: Forecast
    phase: Tensor


class Method(Protocol):
    """Anything that answers."""

    def __call__(
        self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor, ahead: Sequence[float] = END
    ) -> Answer:
        """Look at y [B, T, D] where observed, up to samples keep [B, K]; forecast the DoFs bool [D], ahead [A] s."""


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
        filter: InteractionFilter,
        seed: int,
        numbers: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float64,
        thinning: int = 1,
    ) -> None:
        self.filter, self.seed, self.numbers = filter, seed, numbers
        self.dtype, self.thinning = dtype, thinning
        self._filter = copy.deepcopy(filter).to(dtype)

    @torch.no_grad()
    def __call__(
        self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor, ahead: Sequence[float] = END
    ) -> Answer:
        """See `Method`. DoFs that are neither shown nor asked for are left out of the filter."""
        used = observed.any(0).any(0) | dofs
        part = self._filter.restrict(used, self.thinning)
        device = next(part.buffers()).device
        numbers = range(len(y)) if self.numbers is None else self.numbers
        draws = [seeded(self.seed, number) for number in numbers]
        seen = (y[..., used].to(device, self.dtype), observed[..., used].to(device))
        trace = part(*seen, generator=draws, keep=keep.to(device), project=False)
        assert trace.kept is not None
        forecast = part.forecast(trace.kept, ahead=list(ahead)).select(dofs[used].to(device))
        tensors = (value.to(y) if isinstance(value, Tensor) else value for value in forecast)
        phase = part.phase(trace.kept).to(y)
        # On a circle it is not the share of the interaction that is over.
        return Answer(Forecast(*tensors), phase * torch.nan if part.phase_model.periodic else phase)


class MeanMethod:
    """The mean of the training set, whatever is seen: at the time that will have passed since the beginning."""

    def __init__(self, primitive: InteractionPrimitive) -> None:
        self.primitive = copy.deepcopy(primitive).cpu()

    def __call__(
        self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor, ahead: Sequence[float] = END
    ) -> Answer:
        """See `Method`."""
        time = keep.unsqueeze(-1) / self.primitive.rate + torch.tensor(ahead)  # [B, K, A]
        every = torch.arange(len(self.primitive)).expand(*time.shape, -1)
        members = paths_after(self.primitive, time.unsqueeze(-1), every, dofs).to(y)
        forecast = Forecast(members.mean(-2), members.var(-2), y.new_ones(time.shape), members)
        return Answer(forecast, y.new_full(keep.shape, torch.nan))


class NearestMethod:
    """The training demonstration that is nearest so far, each running at its own speed.

    Distance: mean squared difference over what was measured, DoFs in units of their deviation.
    """

    def __init__(self, primitive: InteractionPrimitive) -> None:
        self.primitive = copy.deepcopy(primitive).cpu()

    def __call__(
        self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor, ahead: Sequence[float] = END
    ) -> Answer:
        """See `Method`."""
        primitive = self.primitive
        chosen = nearest(primitive, y, observed, keep, 1 / primitive.rate)
        time = keep.unsqueeze(-1) / primitive.rate + torch.tensor(ahead)  # [B, K, A]
        mean = paths_after(primitive, time, chosen.unsqueeze(-1).expand(time.shape), dofs).to(y)
        at = (primitive.first_phase[chosen] + keep / primitive.rate * primitive.phase_velocity[chosen]).to(y)
        return Answer(Forecast(mean, torch.full_like(mean, torch.nan), torch.full_like(mean[..., 0], torch.nan)), at)


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
    ahead = (*task.ahead, math.inf)
    ending = torch.stack([last_measured(trajectory) for trajectory in tests])
    steps = torch.stack([(lengths * fraction).round().long() - 1 for fraction in task.fractions], -1).clamp(min=0)
    length = int(steps.max()) + 1
    within = torch.arange(length).view(1, -1, 1) <= steps.amax(-1).view(-1, 1, 1)
    true_phase = steps / (lengths - 1).unsqueeze(-1)
    happened = recorded(tests.pad()[0], lengths, ending, steps, ending.new_tensor(ahead), tests.rate)
    values: Values = {}
    for subset, names in task.subsets.items():
        observed = measured[:, :length] & layout.mask(names) & within
        for name, method in methods.items():
            answer = method(y[:, :length], observed, steps, targets, ahead)
            for k, fraction in enumerate(task.fractions):
                if (subset, fraction) in task.skipped:
                    continue
                for a, seconds in enumerate(ahead):
                    truth, forecast = happened[:, k, a], answer.forecast.at(a).at(k)
                    # Where all of them end sooner there is nothing but NaN, of which a table makes no row.
                    asked = None if math.isinf(seconds) else seconds
                    for cell, array in _metrics(task, layout, subset, fraction, asked, forecast, truth):
                        values.setdefault(cell, {})[name] = array.numpy().astype(np.float64)
                if not answer.phase.isnan().any():
                    wrong = measure.phase_error(answer.phase[:, k], true_phase[:, k])
                    cell = Cell(subset, fraction, "phase_error", None, "1")
                    values.setdefault(cell, {})[name] = wrong.numpy().astype(np.float64)
    return values


def _metrics(
    task: Task,
    layout: Layout,
    subset: str,
    fraction: float,
    ahead: float | None,
    said: Forecast,
    truth: Tensor,
) -> list[tuple[Cell, Tensor]]:
    targets = layout.mask(task.targets)
    order = targets.nonzero().squeeze(-1).tolist()
    found: list[tuple[Cell, Tensor]] = []
    for modality in task.targets:
        part = layout.slice(modality)
        columns = [order.index(dof) for dof in range(part.start, part.stop)]
        target = truth[:, part]
        forecast = said.select(torch.tensor(columns))
        unit = layout[modality].unit
        lead = torch.arange(task.leading.get(modality, len(columns)))
        squares = measure.mse(forecast.select(lead), target[:, lead])
        found.append((Cell(subset, fraction, "mse", modality, f"{unit}^2", ahead), squares))
        found.append((Cell(subset, fraction, "mae", modality, unit, ahead), measure.mae(forecast, target)))
        if not forecast.variance.isnan().all():
            inside = measure.coverage_95(forecast, target)
            found.append((Cell(subset, fraction, "coverage_95", modality, "1", ahead), inside))
            found.append((Cell(subset, fraction, "crps", modality, unit, ahead), measure.crps(forecast, target)))
    if task.arm is not None:
        arm, modality = task.arm
        names = layout[modality].dofs
        # By name where they have the arm's, as the loss takes them.
        joints = arm.joint_names if set(arm.joint_names) <= set(names) else names
        places = [layout.dofs.index(name) for name in joints]
        columns = [order.index(dof) for dof in places]
        distance = measure.tool_error(arm, said.mean[..., columns], truth[:, order][:, columns])
        found.append((Cell(subset, fraction, "tool_error", None, "m", ahead), distance))
    return found
