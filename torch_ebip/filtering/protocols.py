"""What parts of a model may say beyond computing their values, and the view by which they narrow themselves.

A filter asks for a protocol, never for a class, so that a model of somebody else's gets all that it says it can do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from torch_ebip.common.brief import brief


class View(NamedTuple):
    """Some of a model.

    Attributes:
        dofs: int64 [k], which DoFs, ascending.
        state: int64 [m], which entries of the state, ascending; what moves is always among them.
        stride: how many samples each one stands for, on top of what it did.
    """

    dofs: Tensor
    state: Tensor
    stride: int = 1

    def __repr__(self) -> str:
        return brief(self)


@runtime_checkable
class Moves(Protocol):
    """Dynamics or an additive process noise that say which part of a state they touch."""

    @property
    def moving(self) -> int | None:
        """How many leading entries; None for all."""


@runtime_checkable
class MayLeaveSpan(Protocol):
    """A part that may move what stands still out of the span of the first ensemble."""

    @property
    def leaves_span(self) -> str | None:
        """Why it does; None if it does not."""


@runtime_checkable
class Narrows(Protocol):
    """A part that can be narrowed to some of the DoFs and of the state, with its parameters, not copies of them."""

    def select(self, view: View) -> Any:
        """The same for a view of the model."""


@runtime_checkable
class Rows(Protocol):
    """A measurement that can be asked for some DoFs, of what moves and what stands still of a state, apart."""

    def rows(self, moving: Tensor, still: Tensor, dofs: Sequence[int] | None, centre: Tensor | None = None) -> Tensor:
        """h [..., E, k] for ascending dofs, None for all.

        Of entries that move [..., E, m] and others [..., E, n - m], the latter as deviations from a centre [..., n
        - m].
        """


@runtime_checkable
class AddsInPlace(Protocol):
    """A process noise that can be added to members that nobody else holds: one copy less."""

    def add_(self, members: Tensor, dt: Tensor, generator: Any = None) -> Tensor:
        """Members [..., E, n] with noise added, in place."""


@runtime_checkable
class MakesNewMembers(Protocol):
    """Dynamics whose result is never their argument, nor a view of it."""

    makes_new_members: bool


@runtime_checkable
class Entries(Protocol):
    """A measurement that knows on which entries of the state a DoF depends, beside those that move."""

    def entries(self, dofs: Tensor) -> Tensor:
        """int64 [m], ascending, for some DoFs, bool [D]."""
