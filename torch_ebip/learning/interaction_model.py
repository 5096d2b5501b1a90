"""What was learned, as a thing: kept in one file, loaded and run by the library alone."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torch_ebip.common.ambient import in_own_modes
from torch_ebip.filtering.updates.trust import RobustWeights
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.learning.agreement import check_agreement
from torch_ebip.learning.descriptions import (
    build_filter,
    describe_filter,
    describe_layout,
    describe_stack,
    fill,
    layout_of,
    own_tensors,
    stack_of,
    tensors_of,
    updated,
)
from torch_ebip.learning.groups import groups_of
from torch_ebip.learning.model_file import read_model_file, write_model_file
from torch_ebip.learning.recorded import forecast_recorded
from torch_ebip.learning.report import Report
from torch_ebip.live.intake import training_ranges
from torch_ebip.live.session import InteractionSession
from torch_ebip.live.settings import SessionSettings
from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.layout import Layout

NAME = "model.safetensors"
"""Of the model in a run folder."""


@dataclass(frozen=True, eq=False)
class InteractionModel:
    """All that a robot needs of an interaction: made by `learn`, or of a filter that `ebip` made and its primitive.

    Attributes:
        filter: over all DoFs of the layout.
        primitive: of the demonstrations that are its members.
        report: how it came about and what it is worth, see `Report`.
        targets: names of the modalities that it forecasts; default: those that are controlled.
        labels: which interaction each of the N demonstrations shows; default: those of the primitive.

    Raises:
        ValueError: a filter of other columns than the primitive, or whose members are other demonstrations; labels
            that are not those of the primitive.

    Example:
        >>> import torch
        >>> from torch_ebip import InteractionModel, InteractionPrimitive, ebip
        >>> from torch_ebip.recordings import example
        >>> recorded = example()
        >>> primitive = InteractionPrimitive.fit(recorded)
        >>> model = InteractionModel(ebip(primitive, square_root=True), primitive)
        >>> model.forecast(recorded[0][:30], ahead=[0.25, float("inf")]).mean.shape
        torch.Size([30, 2, 11])
    """

    filter: InteractionFilter
    primitive: InteractionPrimitive
    report: Report = field(default_factory=lambda: Report({}))
    targets: tuple[str, ...] = ()
    labels: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        """Checks, and what is left out."""
        layout = self.primitive.layout
        if self.filter.dof_names != layout.dofs:
            raise ValueError("the filter has other columns than the primitive, or in another order")
        if abs(self.filter.dt * self.primitive.rate - 1) > 1e-6:
            raise ValueError(f"the filter takes {1 / self.filter.dt:g} samples a second, the primitive {self.rate:g}")
        dtypes = {tensor.dtype for tensor in (*self.filter.parameters(), self.filter.prior.states)}
        if dtypes != {self.primitive.weights.dtype}:
            raise ValueError(
                f"filter and primitive must have one dtype, got {dtypes}, {self.primitive.weights.dtype}"
            )
        states = self.filter.prior.states
        if not torch.equal(states[:, self.filter.phase_model.moving :], self.primitive.weights):  # type: ignore[index]
            raise ValueError("the filter's members are not the demonstrations of this primitive")
        named = tuple(m.name for m in layout.modalities if m.controlled) if not self.targets else tuple(self.targets)
        for name in named:
            layout.slice(name)
        object.__setattr__(self, "targets", named)
        labels = self.primitive.labels if self.labels is None else tuple(self.labels)
        if labels is not None and len(labels) != len(self.primitive):
            raise ValueError(f"{len(labels)} labels for {len(self.primitive)} demonstrations")
        if labels != self.primitive.labels:
            raise ValueError("the labels are not those of the primitive: `InteractionPrimitive.fit` takes them over")
        object.__setattr__(self, "labels", labels)

    @property
    def layout(self) -> Layout:
        """What the D columns are; what is controlled is forecast."""
        return self.primitive.layout

    @property
    def rate(self) -> float:
        """Samples a second, Hz, of the demonstrations, and of what `forecast` is given."""
        return self.primitive.rate

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the modalities that are shown."""
        return tuple(modality.name for modality in self.layout.modalities if not modality.controlled)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The least and the largest value of each DoF that the demonstrations give, in its unit."""
        ranges = training_ranges(self.primitive, 0.0)
        pairs = zip(ranges.low.tolist(), ranges.high.tolist(), strict=True)
        return dict(zip(self.layout.dofs, pairs, strict=True))

    def __repr__(self) -> str:
        return (
            f"InteractionModel({', '.join(self.sensors)} -> {', '.join(self.targets)}, {self.rate:g} Hz, "
            f"{len(self.primitive)} demonstrations; {self.report.verdict})"
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one file that `load_model` reads, to a path; atomic.

        Raises:
            TypeError: the filter has a part that is not the library's, or is not made by `ebip`; nothing is written.
            ImportError: safetensors is not installed.
        """
        primitive = self.primitive
        options = describe_filter(self.filter, primitive)
        description = {
            "layout": describe_layout(self.layout),
            "rate": self.rate,
            "ranges": {dof: list(pair) for dof, pair in self.ranges.items()},
            "basis": describe_stack(primitive.basis),
            "filter": options,
            "targets": list(self.targets),
            "labels": None if self.labels is None else list(self.labels),
            "report": self.report.plain(),
        }
        tensors = {f"primitive.{name}": tensor for name, tensor in primitive.named_buffers() if "." not in name}
        # What follows from the primitive is not kept twice.
        own = own_tensors(self.filter, build_filter(primitive, options))
        write_model_file(path, description, tensors | {f"filter.{name}": tensor for name, tensor in own.items()})

    @classmethod
    @in_own_modes
    def load(cls, path: str | os.PathLike[str]) -> InteractionModel:
        """Read what `save` wrote at a path; executes nothing of it.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is none of a model, of a later version, cut off or damaged; says which.
            ImportError: safetensors is not installed.
        """
        description, tensors = read_model_file(path)
        try:
            parts: dict[str, dict[str, Tensor]] = {"primitive": {}, "filter": {}}
            for name, tensor in tensors.items():
                owner, _, rest = name.partition(".")
                parts[owner][rest] = tensor
            layout, basis = layout_of(description["layout"]), stack_of(description["basis"])
            labels = description["labels"]
            primitive = InteractionPrimitive(
                layout, basis, float(description["rate"]), **parts["primitive"], labels=labels
            )
            filter = build_filter(primitive, description["filter"])
            fill(filter, updated(description["filter"], parts["filter"]))
            return cls(filter, primitive, Report(description["report"]), tuple(description["targets"]))
        except (AttributeError, ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: a model whose parts do not fit together: {error}") from error

    def session(
        self,
        sensors: Sequence[str] | None = None,
        record: str | os.PathLike[str] | None = None,
        **settings: Any,
    ) -> InteractionSession:
        """A session on the robot: asynchronous sensors in, forecasts of the controlled DoFs out.

        Args:
            sensors: names of the modalities that will be pushed; default: all that are shown.
            record: path of a file to write everything to, for `replay`; must not exist.
            settings: of `SessionSettings`, times in seconds: ``start="first sample"`` by default.

        Raises:
            ValueError: see `InteractionSession` and `SessionSettings`.
        """
        return InteractionSession(self.filter, self.primitive, sensors, SessionSettings(**settings), record)

    def forecast(self, values: Any, ahead: Sequence[float], seed: int = 0) -> Forecast:
        """What would have been said of a recording while it went on.

        Args:
            values: [T, D] at `rate` on the model's layout, in its units: a tensor, an array or a frame with columns
                by name. NaN: not measured. What is controlled is not looked at.
            ahead: A times in seconds after each sample; ``math.inf``: the end.
            seed: of the filter's draws, where it makes any.

        Returns:
            Mean, variance [T, A, D] from what was measured up to each sample, and phase [T, A]; without members.
            Where there are labels, the probability [T] of each.

        Raises:
            ValueError: other columns; no time ahead, NaN or a negative one; infinite values.
        """
        return forecast_recorded(self.filter, self.layout, values, ahead, seed)

    def prepare(self, demonstrations: Demonstrations) -> Demonstrations:
        """Recordings as this model needs them, with its roles; what it does not need is left out.

        Raises:
            ValueError: a modality that is missing, or has other DoFs, another order or another unit; another rate.
        """
        check_agreement(demonstrations, self.layout, self.rate)
        assigned = demonstrations.assign(self.targets, self.sensors)
        if not bool(self.layout.angles.any()):
            return assigned
        # Within half a turn of where those that were learned from are.
        parts = (assigned.trajectories, assigned.rate, assigned.columns)
        return Demonstrations(self.layout, *parts, remarks=assigned.remarks)

    def extend(self, demonstrations: Demonstrations) -> InteractionModel:
        """A model with more members: the same basis and noise, nothing is tuned again.

        Args:
            demonstrations: at least one, of the same interaction; see `prepare`.

        Raises:
            ValueError: recordings that do not fit, see `prepare`; labels here and none there, or the other way round.
        """
        mine = self.primitive
        new = self.prepare(demonstrations).to(dtype=mine.weights.dtype, device=mine.weights.device)
        if self.labels is not None and new.labels is None and self.report.get("groups"):
            # Nobody named the groups of the first ones either.
            new = new.labelled(groups_of(mine, self.labels, mine.like(new))[: len(new)])
        if (new.labels is None) != (self.labels is None):
            raise ValueError("labels: the model and the recordings must both have them, or neither")
        primitive = mine.extend(new)
        description = describe_filter(self.filter, mine)
        if description["n_members"] == len(mine):
            description["n_members"] = len(primitive)
        report = Report({**self.report.plain(), "extended_by": self.report.get("extended_by", 0) + len(new)})
        filter = build_filter(primitive, description)
        fill(filter, own_tensors(self.filter, build_filter(mine, description)))
        return replace(self, filter=filter, primitive=primitive, report=report, labels=primitive.labels)

    def starting_at(self, phases: Sequence[float]) -> InteractionModel:
        """The same model for people who are first seen at one of some ``phases`` in [0, 1), each as likely: see
        `InteractionPrimitive.starting_at`.

        Raises:
            ValueError: phases outside [0, 1).
        """
        primitive, description = self.primitive.starting_at(phases), describe_filter(self.filter, self.primitive)
        filter = build_filter(primitive, description)
        fill(filter, own_tensors(self.filter, build_filter(self.primitive, description)))
        return replace(self, filter=filter, primitive=primitive)

    def rebuilt(self, n_members: int | None = None, robust: RobustWeights | None = None) -> InteractionModel:
        """The same model with an ensemble of another size, or that weighs surprising values less.

        Args:
            n_members: E; default: as it is. With fewer nobody knows what is familiar: that was learned with all of
                them, and fewer are surprised by everything.
            robust: `StudentT`, `Huber`, `Gate` or `Cauchy`, as they are; default: as it is.

        Raises:
            ValueError: fewer than two members.
        """
        description = describe_filter(self.filter, self.primitive)
        own = tensors_of(self.filter)
        report = self.report
        if n_members is not None:
            description["n_members"] = n_members
            had = min(len(self.primitive), describe_filter(self.filter, self.primitive)["n_members"])
            if n_members < had and description["surprise"] is not None:
                description["surprise"] = description["doubt"] = None
                own = {
                    name: value for name, value in own.items() if not name.startswith(("analysis.surprise", "doubt"))
                }
                remark = f"familiarity is NaN: it was learned with more than {n_members} members"
                report = Report({**report.plain(), "surprise": {}, "remarks": [*report.get("remarks", []), remark]})
        if robust is not None:
            description["robust"] = type(robust).__name__
            own = {name: tensor for name, tensor in own.items() if ".trust." not in name}
            own |= {f"analysis.trust.0.{name}": tensor for name, tensor in tensors_of(robust).items()}
        filter = build_filter(self.primitive, description).to(self.primitive.weights)
        fill(filter, own)
        return replace(self, filter=filter, report=report)
