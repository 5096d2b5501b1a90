"""What was seen of late: a line through the last samples of each DoF, older ones forgotten exponentially.

A state says where an interaction is and which it may be, not what a sensor last showed. A forecast that compares the
present with what was demonstrated needs that: values and their velocities, of what was believed.

The line is that of least squares (Holt's double exponential smoothing, 1957, with the weights of every sample told):
gaps and clocks that differ need no care, and a sensor that fell silent fades.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_number
from torch_ebip.common.brief import brief
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.part import Part
from torch_ebip.filtering.updates.weighting import Seen

WINDOW = 0.03
"""s, over which the last samples of a DoF make a line."""
SUMS = 5
"""Of each window."""
FAINT = 1e-9
"""Belief below which nothing is believed: what is left of a sensor that fell silent, until its numbers underflow."""
LEAST = 1e-30
"""Samples that must be left of a DoF, after forgetting, for a line to be drawn."""
HOLD = 0.15
"""s, a deviation: how long a line is believed that has no new samples."""
SHORTEST = 0.1
"""Deviation of the times of a line, as a share of the window, below which it has no slope."""


class Line(NamedTuple):
    """Where DoFs are now and how they move, by what was seen of late; of several windows, [..., W, D] each.

    Attributes:
        value: [..., D], at present, units of the DoFs; 0 where there are no samples.
        velocity: [..., D], units of the DoFs a second; 0 where there is no slope.
        belief: [..., D], in [0, 1], how far the value may be believed: less, the older the samples are, and nothing
            where there are none.
        moves: bool [..., D], where there is a slope.
        age: [..., D], s, mean age of the samples, as they count; 0 where there are none.
    """

    value: Tensor
    velocity: Tensor
    belief: Tensor
    moves: Tensor
    age: Tensor

    def __repr__(self) -> str:
        return brief(self)


class Recent(Part):
    """Remembers discounted sums of 1, t, t^2, y and t y over the samples of each DoF, t in seconds before now.

    What it remembers is of all DoFs of the model, whatever view of it is at work. With several windows it is a
    recurrent memory of what was before, too: sums of each window, one below the other.

    Args:
        centre: [D], near which values lie, units of the DoFs: it is taken off before they are summed.
        window: s, after which a sample counts 1/e.
        slower: s, further windows, W - 1 of them.

    Raises:
        ValueError: a window that is not positive.

    Example:
        >>> import torch
        >>> from torch_ebip.filtering.updates.recent import Recent
        >>> from torch_ebip.filtering.updates.weighting import Seen
        >>> recent, sums = Recent(torch.zeros(1)), torch.zeros(5, 1)
        >>> for value in (1.0, 1.5, 2.0):
        ...     sums = recent.forget(sums, torch.tensor(0.1))
        ...     seen = Seen(torch.tensor([value]), None, None, None, *torch.zeros(3, 1))
        ...     sums = recent.learn(sums, seen)
        >>> line = recent.line(sums)
        >>> line.value.round(decimals=3).tolist(), line.velocity.round(decimals=3).tolist()
        ([2.0], [5.0])
    """

    centre: Tensor
    columns: Tensor
    spans: Tensor

    def __init__(self, centre: Tensor, window: float = WINDOW, slower: Sequence[float] = ()) -> None:
        super().__init__()
        self._windows = tuple(as_number("window", each, 0, above=True) for each in (window, *slower))
        self.register_buffer("centre", owned(centre))
        self.register_buffer("spans", centre.new_tensor(self._windows).unsqueeze(-1), persistent=False)  # [W, 1]
        self.register_buffer("columns", torch.arange(len(centre), device=centre.device), persistent=False)
        self._kept: tuple[Tensor, int, Tensor] | None = None

    @property
    def windows(self) -> tuple[float, ...]:
        """W windows, s, the one of the present first."""
        return self._windows

    def check(self, model: StateSpace) -> None:
        """See `Part.check`: it is for as many DoFs as the model has."""
        if len(self.columns) != model.n_dofs:
            raise ValueError(f"what was seen of late is of {len(self.columns)} DoFs, the model has {model.n_dofs}")

    def select(self, view: View) -> Recent:
        """See `Part.select`."""
        part = sharing(self)
        part.register_buffer("columns", self.columns[view.dofs], persistent=False)
        part._kept = None
        return part

    def start(self, like: Tensor) -> Tensor:
        """[..., 5 W, D], nothing seen, batch dimensions of members ``like`` [..., E, n]."""
        return self.centre.new_zeros(*like.shape[:-2], SUMS * len(self._windows), len(self.centre))

    def forget(self, sums: Tensor, dt: Tensor) -> Tensor:
        """What is left of sums after some seconds: all samples are that much older, and count less.

        Args:
            sums: [..., 5 W, D], see `start`.
            dt: [...], seconds.
        """
        if dt.requires_grad or dt.is_inference() or torch.is_inference_mode_enabled():
            return self._ageing(dt) @ sums
        kept = self._kept  # another thread may exchange it
        if kept is None or kept[0] is not dt or kept[1] != dt._version:
            self._kept = kept = dt, dt._version, self._ageing(dt)
        return kept[2] @ sums

    def _ageing(self, dt: Tensor) -> Tensor:
        """[..., 5 W, 5 W]: (t - dt)^k in powers of t, times what is left after dt [...] s, window by window."""
        zero, one = torch.zeros_like(dt), torch.ones_like(dt)
        rows = (
            (one, zero, zero, zero, zero),
            (-dt, one, zero, zero, zero),
            (dt * dt, -2 * dt, one, zero, zero),
            (zero, zero, zero, one, zero),
            (zero, zero, zero, -dt, one),
        )
        ageing = torch.stack([torch.stack(row, -1) for row in rows], -2)
        left = torch.exp(-dt.unsqueeze(-1) / self.spans[:, 0])  # [..., W]
        each = ageing.unsqueeze(-3) * left[..., None, None]  # [..., W, 5, 5]
        apart = torch.eye(len(self._windows), dtype=dt.dtype, device=dt.device)
        return torch.einsum("...wij,wv->...wivj", each, apart).flatten(-4, -3).flatten(-2)

    def learn(self, sums: Tensor, seen: Seen) -> Tensor:
        """Sums [..., 5 W, D] after a sample.

        Args:
            sums: before it, [..., 5 W, D].
            seen: the sample; of each value as much as it was believed.
        """
        columns = self.columns if seen.rows is None else self.columns[seen.rows]
        y, counts = seen.y, seen.trust
        if seen.observed is not None:
            y = torch.where(seen.observed, y, 0)
            counts = seen.observed.to(y) if counts is None else torch.where(seen.observed, counts, 0)
        if counts is None:
            counts = torch.ones_like(y)
        value, none = counts * (y - self.centre[columns]), torch.zeros_like(y)
        added = torch.stack([counts, none, none, value, none] * len(self._windows), -2)
        if added.ndim < sums.ndim:
            added = added.expand(*sums.shape[:-2], *added.shape[-2:])
        return sums.expand(*added.shape[:-2], *sums.shape[-2:]).index_add(-1, columns, added)

    def line(self, sums: Tensor) -> Line:
        """Of the present: the lines of sums [..., 5 W, D], units of the DoFs and a second; differentiable."""
        return self._lines(sums[..., :SUMS, :].unbind(-2), self.spans[0])

    def lines(self, sums: Tensor) -> Line:
        """Of all windows, parts [..., W, D]: see `line`."""
        apart = sums.reshape(*sums.shape[:-2], len(self._windows), SUMS, sums.shape[-1])
        return self._lines(apart.unbind(-2), self.spans)

    def _lines(self, sums: Sequence[Tensor], span: Tensor) -> Line:
        samples, times, squares, values, products = sums
        some = samples > LEAST
        samples = torch.where(some, samples, 1)
        time, value = times / samples, values / samples
        variance = squares / samples - time.square()
        moves = some & (variance > (SHORTEST * span).square())
        velocity = torch.where(moves, products / samples - time * value, 0) / torch.where(moves, variance, 1)
        present = torch.where(some, value - time * velocity + self.centre, 0)
        # As if the samples were from now: what the last ones count.
        counted = (samples * torch.exp(-time / span)).clamp(max=1)
        belief = torch.where(some, counted * torch.exp(-0.5 * (time / HOLD).square()), 0)
        belief = torch.where(belief > FAINT, belief, 0)
        return Line(present, velocity, belief, moves, torch.where(some, -time, 0))

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have nothing kept."""
        return {**self.__dict__, "_kept": None}

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return "window=" + ", ".join(f"{window:g}" for window in self._windows)

    def extra_repr(self) -> str:
        """The windows."""
        return f"{self.meant()} s"
