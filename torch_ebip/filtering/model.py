"""A state-space model: dynamics g, measurement h and their noise; whole, or narrowed to some of its DoFs.

Any modules will do. What they may say beyond computing their values is in `protocols`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_ebip.common.arguments import as_count, as_mask, as_number
from torch_ebip.common.draws import Generators
from torch_ebip.common.modules import sharing
from torch_ebip.filtering import functional
from torch_ebip.filtering.noise.measurement import SaysWhatItDependsOn, SelectedNoise
from torch_ebip.filtering.noise.process import NoProcessNoise
from torch_ebip.filtering.protocols import (
    AddsInPlace,
    Entries,
    MakesNewMembers,
    MayLeaveSpan,
    Moves,
    Narrows,
    Rows,
    View,
)

PARTS = ("dynamics", "measurement", "process_noise", "measurement_noise")
"""Of a `StateSpace`: about these it asks when they are put in."""


class StateSpace(nn.Module):
    """x' = g(x, dt) + N(0, Q), y = h(x) + N(0, R): an immutable bundle of modules.

    Args:
        dynamics: g, maps members [..., E, n] and dt [...] (s) to members.
        measurement: h, maps members [..., E, n] to values [..., E, D], units of the DoFs.
        process_noise: Q, maps members, dt and a generator to members with noise added; default: none.
        measurement_noise: R, maps the mean of what moves, [..., m], to standard deviations [D] or [..., D].
        dofs: names of the DoFs, for error messages; or their number D.
        dt: seconds between samples where none is given.

    Attributes:
        leading: m, how many leading entries the dynamics move; None for all of them, as of dynamics that do not say.
        moving: how many leading entries move or are stirred, the rest stands still; None for all, or if nobody says.
        noise_depends_on_state: whether R changes during a sequence; assumed of noises that do not say.

    Raises:
        ValueError: no DoF, a dt that is not a positive number of seconds, a measurement noise of another width.

    Example:
        >>> import torch
        >>> from torch_ebip import MeasurementNoise, StateSpace
        >>> class Still(torch.nn.Module):
        ...     def forward(self, x, *dt):
        ...         return x
        >>> model = StateSpace(Still(), Still(), None, MeasurementNoise(torch.ones(2)), ("x", "y"), dt=0.1)
    """

    leading: int | None
    moving: int | None
    noise_depends_on_state: bool

    def __init__(
        self,
        dynamics: nn.Module,
        measurement: nn.Module,
        process_noise: nn.Module | None,
        measurement_noise: nn.Module,
        dofs: Sequence[str] | int,
        dt: float,
    ) -> None:
        super().__init__()
        self.dynamics = dynamics
        self.measurement = measurement
        self.process_noise = NoProcessNoise() if process_noise is None else process_noise
        self.measurement_noise = measurement_noise
        self.dof_names = None if isinstance(dofs, int) else tuple(dofs)
        self.n_dofs = as_count("dofs", dofs if isinstance(dofs, int) else len(dofs))
        self.dt = as_number("dt", dt, 0, above=True, of="of seconds")
        self.stride = 1
        if not self.noise_depends_on_state:
            with torch.no_grad():
                self.deviation(None)

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        if name in PARTS and "measurement_noise" in self._modules:
            self._ask_parts()

    def _ask_parts(self) -> None:
        """What parts say of themselves, asked once when they are put in: a protocol takes longer than a product."""
        dynamics, noise, measured = self.dynamics, self.process_noise, self.measurement_noise
        self.leading = dynamics.moving if isinstance(dynamics, Moves) else None
        stirred = noise.moving if isinstance(noise, Moves) else None
        self.moving = None if self.leading is None or stirred is None else max(self.leading, stirred)
        self.noise_depends_on_state = measured.depends_on_state if isinstance(measured, SaysWhatItDependsOn) else True
        measurement = self.measurement
        self._rows = measurement.rows if isinstance(measurement, Rows) else None
        new = isinstance(dynamics, MakesNewMembers) and dynamics.makes_new_members
        self._adds_in_place = new and isinstance(noise, AddsInPlace)

    @property
    def leaves_span(self) -> str | None:
        """Why members leave the span of the first ensemble while they are propagated; None if they do not."""
        parts = (part for part in (self.dynamics, self.process_noise) if isinstance(part, MayLeaveSpan))
        return next((part.leaves_span for part in parts if part.leaves_span is not None), None)

    def difference(self, a: Tensor, b: Tensor) -> Tensor:
        """a - b of states [..., n]. A model on a circle or of rotations says otherwise."""
        return a - b

    def mean(self, members: Tensor, member_weights: Tensor | None = None) -> Tensor:
        """Mean [..., m] of entries of members [..., E, m], their ``member_weights`` [..., E]; see `difference`."""
        return functional.ensemble_mean(members, member_weights)

    def project(
        self,
        members: Tensor,
        rows: Tensor | None = None,
        centre: Tensor | None = None,
        parts: tuple[Tensor, Tensor] | None = None,
    ) -> Tensor:
        """h [..., E, k] of members [..., E, n], for some DoFs int64 [k], ascending; None for all.

        Args:
            members: [..., E, n], as they are, or as deviations from a centre.
            rows: int64 [k].
            centre: [..., n].
            parts: what `split` makes of the members, [..., E, m] and [..., E, n - m], where that is known.

        Raises:
            ValueError: a measurement that gives another number of values than there are DoFs.
        """
        if self._rows is not None and self.leading is not None:
            moving, still = self.split(members) if parts is None else parts
            centre = None if centre is None or not bool(centre.any()) else centre[..., self.leading :]
            return self._rows(moving, still, None if rows is None else rows.tolist(), centre)
        values: Tensor = self.measurement(members if centre is None else members + centre.unsqueeze(-2))
        if values.shape != (*members.shape[:-1], self.n_dofs):
            raise ValueError(
                f"the measurement, a {type(self.measurement).__name__}, must map members {list(members.shape)} to "
                f"values {[*members.shape[:-1], self.n_dofs]}, one for each DoF, but gave {list(values.shape)}"
            )
        return values if rows is None else values[..., rows]

    def split(self, members: Tensor) -> tuple[Tensor, Tensor]:
        """What moves [..., E, m] and what stands still [..., E, n - m] of members [..., E, n].

        A split, not two slices: its backward pass is one concatenation instead of two mostly empty tensors.
        """
        m = self.leading
        if m is None:
            return members, members[..., :0]
        moving, still = torch.split(members, [m, members.shape[-1] - m], dim=-1)
        return moving, still

    def advance(self, members: Tensor, dt: Tensor, generator: Generators) -> Tensor:
        """g(x) + N(0, Q): members [..., E, n] after dt [...] seconds, drawn with a generator."""
        moved: Tensor = self.dynamics(members, dt)
        noise: Any = self.process_noise
        add = noise.add_ if self._adds_in_place else noise
        return add(moved, dt, generator)  # type: ignore[no-any-return]

    def deviation(self, moving: Tensor | None) -> Tensor:
        """Standard deviations of a sample, [D] or [..., D], units of the DoFs.

        Args:
            moving: [..., m], mean of what moves; None where R does not depend on the state.
        """
        deviation: Tensor = self.measurement_noise(moving)
        if deviation.shape[-1:] != (self.n_dofs,):
            noise, width = type(self.measurement_noise).__name__, list(deviation.shape[-1:])
            raise ValueError(f"the measurement noise, a {noise}, is of {width} DoFs, the model has {self.n_dofs}")
        return deviation

    def view(self, dofs: Tensor, stride: int = 1) -> View:
        """What of the model some DoFs, bool [D], need.

        Args:
            dofs: bool [D], at least one of them True.
            stride: how many samples each one stands for.

        Raises:
            ValueError: a mask of another length or kind.
            TypeError: a measurement that does not know what a DoF depends on.
        """
        if not isinstance(self.measurement, Entries) or self.leading is None:
            raise TypeError(
                f"a {type(self.measurement).__name__} does not say on which entries of a state each DoF depends, or "
                "everything moves: the model cannot be restricted to some DoFs"
            )
        device = next((tensor.device for tensor in [*self.parameters(), *self.buffers()]), torch.device("cpu"))
        dofs = as_mask("dofs", dofs, self.n_dofs).cpu()
        entries = self.measurement.entries(dofs)
        state = torch.cat([torch.arange(self.leading, device="cpu"), entries.cpu()])
        return View(dofs.nonzero().squeeze(-1).to(device), state.to(device), as_count("stride", stride))

    def select(self, view: View) -> StateSpace:
        """The model of a view, with the same parameters, not copies of them.

        Raises:
            TypeError: a part that cannot be narrowed.
        """
        part = sharing(self)
        for name in ("dynamics", "measurement", "process_noise"):
            whole = getattr(self, name)
            if not isinstance(whole, Narrows):
                raise TypeError(f"a {type(whole).__name__} cannot be restricted to some DoFs: it has no `select`")
            setattr(part, name, whole.select(view))
        noise = self.measurement_noise
        part.measurement_noise = noise.select(view) if isinstance(noise, Narrows) else SelectedNoise(noise, view)
        names = self.dof_names
        part.dof_names = None if names is None else tuple(names[i] for i in view.dofs.tolist())
        part.n_dofs = len(view.dofs)
        part.dt, part.stride = self.dt * view.stride, self.stride * view.stride
        return part

    def named(self, error: functional.FactorisationError, rows: Tensor | None) -> ValueError:
        """The error of a factorisation over some DoFs, with their names.

        Args:
            error: that was raised.
            rows: int64 [k], which of the model's DoFs it numbers; None for all.
        """
        if self.dof_names is None:
            return error
        names = (self.dof_names[i if rows is None else int(rows[i])] for i in error.dofs)
        return ValueError(f"{error} ({', '.join(names)})")

    def extra_repr(self) -> str:
        """How many DoFs, and how often they are measured."""
        return f"n_dofs={self.n_dofs}, dt={self.dt:g}"
