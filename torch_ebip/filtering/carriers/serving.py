"""What the span carrier asks of a model, and whether it can serve one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from torch import Tensor

from torch_ebip.filtering.carriers.columns import ColumnMembers
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import Entries
from torch_ebip.filtering.updates.update import Update


@runtime_checkable
class ProjectsColumns(Protocol):
    """A measurement that projects members that are columns, into buffers."""

    def projector(
        self, members: ColumnMembers, centre: Tensor, rows: Sequence[int], out: Tensor, terms: Tensor
    ) -> Callable[[], None]:
        """What writes h(x) [..., K, E] of some DoFs into a buffer, whenever it is called.

        Args:
            members: that the carrier changes in place.
            centre: [..., k] of what stands still and sensors see, to which members are deviations.
            rows: the DoFs, ascending.
            out: [..., K, E], the buffer.
            terms: [B k E], memory for whatever is needed on the way, shared by all projectors of a carrier.
        """


@runtime_checkable
class AdvancesColumns(Protocol):
    """Dynamics that advance what moves in place."""

    def advancer(self, moving: Tensor) -> Callable[[float | Tensor], None]:
        """What advances members that are columns, [..., m, E], by so many seconds whenever it is called."""


@runtime_checkable
class HasFactor(Protocol):
    """A process noise of what moves, with a full covariance."""

    def factor(self, dt: Tensor) -> Tensor:
        """Lower factor [..., m, m] of Q for steps of dt [...] seconds."""


def why_not_span(model: StateSpace, update: Update) -> str | None:
    """Why a `SpanCarrier` cannot serve a model and an update; None if it can."""
    if model.leaves_span is not None or update.leaves_span is not None:
        return model.leaves_span or update.leaves_span
    if update.rule.columns is None:
        return f"a {type(update.rule).__name__} has no twin for columns"
    if model.moving is None:
        return "the model does not say that a part of its state stands still"
    for part, protocol, what in (
        (model.dynamics, AdvancesColumns, "dynamics with an `advancer`"),
        (model.process_noise, HasFactor, "a process noise with a `factor`"),
        (model.measurement, ProjectsColumns, "a measurement with a `projector`"),
        (model.measurement, Entries, "a measurement that knows its `entries`"),
    ):
        if not isinstance(part, protocol):
            return f"it takes {what}, which a {type(part).__name__} is not"
    return None
