"""A recurrent expert: what was seen, of late and long before, read by a small network.

A filter asks how far each demonstration explains what it sees, and analogues which of them is near; a network may
find what neither has. What it remembers are lines through windows of different length (`Recent` with several
windows), a linear recurrence: exact for any clock, and what was not measured changes nothing (Voelker, Kajic &
Eliasmith 2019; Gu, Goel & Re 2022). The network reads them with two hidden layers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_count, as_mask, as_number
from torch_ebip.common.brief import brief
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.recent import WINDOW, Line
from torch_ebip.interaction.horizons import SECONDS, horizon_hats
from torch_ebip.interaction.present import Present
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.readout import Lead, increasing
from torch_ebip.interaction.table import DemonstrationTable

SLOWER = (0.1, 0.3, 1.0)
"""s, windows that are remembered beside that of the present."""
HIDDEN = 64
"""Units of each hidden layer."""
NETWORKS = 2
"""That are trained alike from different starts; what they say is averaged."""
FAR = 5.0
"""Deviations beyond which all is equally far."""
LIMIT = 4.0
"""Deviations of the targets within which it speaks."""
GONE = 2.0
"""Of the slowest window: mean age of samples from which on a sensor that fell silent counts as one never seen."""


class Layers(NamedTuple):
    """Weights of M networks: I inputs, H units, O outputs.

    Attributes:
        first: [M, I, H].
        first_bias: [M, 1, H].
        second: [M, H, H].
        second_bias: [M, 1, H].
        last: [M, H, O].
        last_bias: [M, 1, O].
        direct: [M, I, O], from inputs to outputs: what is linear need not go through the units.
    """

    first: Tensor
    first_bias: Tensor
    second: Tensor
    second_bias: Tensor
    last: Tensor
    last_bias: Tensor
    direct: Tensor

    def __repr__(self) -> str:
        return brief(self)

    def read(self, inputs: Tensor, keep: Tensor | None = None) -> Tensor:
        """Outputs [M, R, O] of inputs [M, R, I].

        Args:
            inputs: of R moments.
            keep: [M, R, H], factors on the units of the second layer, in training; default: none.
        """
        units = nn.functional.silu(torch.baddbmm(self.first_bias, inputs, self.first))
        units = nn.functional.silu(torch.baddbmm(self.second_bias, units, self.second))
        units = units if keep is None else units * keep
        return torch.baddbmm(torch.baddbmm(self.last_bias, units, self.last), inputs, self.direct)


class Expert(nn.Module):
    """Says r(lead) + sum_k a_k(lead) (e_k - r_k): e_k is what the network says of the horizon k.

    r is the path of the mean demonstration from the present phase on, at the mean pace, r_k where it will be at
    horizon k, and a_k the weights of `horizon_hats`. So at horizon k it says e_k, and between horizons how far it is
    off the mean is linear. The network's inputs are, of each DoF that is seen and each window, value and velocity of
    a line in deviations, held within 5, its samples' mean age and 1; all of them times how far the present is
    believed, so that what is not seen is 0. It speaks within 4 deviations of the targets, and is believed as far as
    the least of the sensors that it lately read, see `believed`.

    Args:
        path: of a single demonstration, the mean.
        pace: 1/s, the mean phase velocity.
        seen: int64 [k], DoFs that it reads.
        said: int64 [T], DoFs that it speaks of; of others it says what the mean does.
        seconds: [K] increasing, its horizons; infinity, the last, is the end.
        windows: W, s, those that are remembered, that of the present first.
        hidden: units of a layer.
        networks: how many.

    Raises:
        ValueError: a path of several demonstrations, no DoF that it reads or speaks of, seconds that do not increase,
            windows that are not positive, no units or networks.

    Example:
        >>> import torch
        >>> from torch_ebip import InteractionPrimitive
        >>> from torch_ebip.interaction.expert import Expert
        >>> from torch_ebip.recordings import example
        >>> primitive = InteractionPrimitive.fit(example())
        >>> controlled = primitive.layout.controlled
        >>> Expert.of(primitive, ~controlled, controlled).extra_repr()
        'reads 5 DoFs in 4 windows, says 6 at 5 horizons, 2 networks of 64 units'
    """

    seen: Tensor
    said: Tensor
    middle: Tensor
    scale: Tensor
    centre: Tensor
    unit: Tensor
    seconds: Tensor
    pace: Tensor

    def __init__(
        self,
        path: DemonstrationTable,
        pace: float,
        seen: Tensor,
        said: Tensor,
        seconds: Sequence[float] = SECONDS,
        windows: Sequence[float] = (WINDOW, *SLOWER),
        hidden: int = HIDDEN,
        networks: int = NETWORKS,
    ) -> None:
        super().__init__()
        places = increasing("seconds", seconds, path.cells)
        if len(path.cells) != 1 or not len(seen) or not len(said):
            raise ValueError(
                f"a path of one demonstration, DoFs that are read and DoFs that are said are needed, got "
                f"{len(path.cells)}, {len(seen)} and {len(said)}"
            )
        if not len(windows):
            raise ValueError("no window: an expert reads lines through at least one")
        new, k, K, T = path.cells.new_zeros, len(seen), len(places), len(said)
        self.path, self.windows = path, tuple(as_number("window", window, 0, above=True) for window in windows)
        self.hidden, self.networks = as_count("hidden", hidden), as_count("networks", networks)
        self.register_buffer("pace", new(()) + as_number("pace", pace))
        self.register_buffer("seen", owned(seen), persistent=False)
        self.register_buffer("said", owned(said), persistent=False)
        self.register_buffer("middle", new(k))
        self.register_buffer("scale", new(2, k) + 1)
        self.register_buffer("centre", new(K, T))
        self.register_buffer("unit", new(K, T) + 1)
        self.register_buffer("seconds", owned(places))
        inputs = k * (2 * len(self.windows) + 2)
        for name, rows, columns in (("first", inputs, hidden), ("second", hidden, hidden), ("last", hidden, K * T)):
            self.register_buffer(name, new(networks, rows, columns))
            self.register_buffer(f"{name}_bias", new(networks, 1, columns))
        self.register_buffer("direct", new(networks, inputs, K * T))
        # Of each DoF of the view, which of those that are said it is, and whether it is one.
        D = path.n_dofs
        place = torch.zeros(D, dtype=torch.long, device=said.device)
        place[said] = torch.arange(T, device=said.device)
        self.register_buffer("place", place, persistent=False)
        self.register_buffer("spoken", torch.isin(torch.arange(D, device=said.device), said), persistent=False)

    place: Tensor
    spoken: Tensor

    @classmethod
    def of(
        cls,
        primitive: InteractionPrimitive,
        seen: Tensor,
        said: Tensor,
        seconds: Sequence[float] = SECONDS,
        windows: Sequence[float] = (WINDOW, *SLOWER),
        hidden: int = HIDDEN,
        networks: int = NETWORKS,
    ) -> Expert:
        """One that says nothing yet, beside a primitive's demonstrations.

        Args:
            primitive: of the demonstrations.
            seen, said: bool [D], DoFs that it reads, and speaks of.
            seconds, windows, hidden, networks: see `Expert`.
        """
        table = DemonstrationTable.of(primitive)
        mean = DemonstrationTable(table.values.mean(0, keepdim=True), table.slopes.mean(0, keepdim=True))
        masks = (as_mask(name, mask, table.n_dofs) for name, mask in (("seen", seen), ("said", said)))
        reads, says = (mask.nonzero().squeeze(-1).to(primitive.weights.device) for mask in masks)
        return cls(mean, primitive.phase_velocity.mean().item(), reads, says, seconds, windows, hidden, networks)

    @property
    def layers(self) -> Layers:
        """Of all networks, [M, ...]."""
        return Layers(*(getattr(self, name) for name in Layers._fields))

    def inputs(self, before: Line) -> Tensor:
        """What the network reads, [..., k, 2 W + 2], of lines [..., W, D] through all windows."""
        parts = torch.stack([before.value, before.velocity, before.belief, before.age]).index_select(-1, self.seen)
        value, velocity, belief, age = parts.unbind(0)
        # Lines without samples are at 0, not where the DoF lies.
        value = torch.where(belief > 0, value - self.middle, 0)
        lines = (torch.cat([value, velocity], -2) / self.scale.repeat_interleave(len(self.windows), 0)).clamp(
            -FAR, FAR
        )
        old = age[..., -1:, :] / self.windows[-1]
        return (torch.cat([lines, old, torch.ones_like(old)], -2) * belief[..., :1, :]).transpose(-1, -2)

    def read(self, inputs: Tensor) -> Tensor:
        """[..., K, T], what the networks say of the horizons, units of the DoFs, from `inputs` [..., k, 2 W + 2]."""
        layers = self.layers
        flat = inputs.reshape(-1, layers.first.shape[-2]).expand(self.networks, -1, -1)
        said = layers.read(flat).mean(0).view(*inputs.shape[:-2], *self.unit.shape)
        return torch.addcmul(self.centre, said.clamp(-LIMIT, LIMIT), self.unit)

    def believed(self, before: Line) -> Tensor:
        """[...], from 0 to 1, how far the present is believed of the DoF that it reads of which that is least.

        A sensor that fades is none that was never there, which networks learned to do without: until it is forgotten
        nobody knows what they make of it.

        Args:
            before: lines [..., W, D] through all windows.
        """
        now, age = (part.index_select(-1, self.seen) for part in (before.belief[..., 0, :], before.age[..., -1, :]))
        # Gone from twice the slowest window on, wholly half a window later; never there: without an age.
        there = torch.where(age > 0, 1 - (2 * (age / self.windows[-1] - GONE)).clamp(0, 1), 0)
        return (1 - there * (1 - now)).amin(-1)

    def forward(self, present: Present, lead: Lead) -> Tensor:
        """Forecasts [..., P, D]; differentiable.

        Args:
            present: of a state whose update remembers the windows.
            lead: of P horizons.

        Raises:
            ValueError: the update remembers other windows.
        """
        before = self.before(present)
        said = self.read(self.inputs(before)).index_select(-1, self.place)  # [..., K, D]
        phase, K = present.phase.unsqueeze(-1), len(self.seconds)
        asked = lead.phase if lead.asked is None else torch.where(lead.end > 0, 1, phase + self.pace * lead.seconds)
        mean = self._mean(torch.cat([self._after(phase, self.seconds), asked], -1))
        off = torch.where(self.spoken, said - mean[..., :K, :], 0)
        return mean[..., K:, :] + horizon_hats(lead, self.seconds) @ off

    def before(self, present: Present) -> Line:
        """The lines [..., W, D] that it reads, of the ``present``.

        Raises:
            ValueError: the update remembers other windows.
        """
        lines = present.before
        if lines is None or lines.value.shape[-2] != len(self.windows):
            raise ValueError(f"the expert reads what was seen in windows of {self.windows} s: `Recent` of these")
        return lines

    def _after(self, phase: Tensor, seconds: Tensor) -> Tensor:
        """Phases [..., P] so many seconds [P] after a phase [..., 1], at the mean pace; 1 where the end is asked."""
        end = seconds.isinf()
        return torch.where(end, 1, phase + self.pace * torch.where(end, 0, seconds))

    def _mean(self, phase: Tensor) -> Tensor:
        """The mean path [..., P, D] at phases [..., P]."""
        return self.path.at(torch.zeros(phase.shape[:-1], dtype=torch.long, device=phase.device), phase)

    def select(self, view: View) -> Expert:
        """The same for a view of the model: forecasts of its DoFs; what is read stays."""
        part = sharing(self)
        part.path = self.path.select(view)
        dofs = view.dofs.to(self.place.device)
        part.register_buffer("place", self.place[dofs], persistent=False)
        part.register_buffer("spoken", self.spoken[dofs], persistent=False)
        return part

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return f"windows={self.windows}"

    def extra_repr(self) -> str:
        """Sizes."""
        return (
            f"reads {len(self.seen)} DoFs in {len(self.windows)} windows, says {len(self.said)} at "
            f"{len(self.seconds)} horizons, {self.networks} networks of {self.hidden} units"
        )
