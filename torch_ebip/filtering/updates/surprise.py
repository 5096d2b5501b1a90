"""Surprise: how far what sensors say is from what was expected, remembered; and what a sensor counts by it.

It is asked before robust weights are, of the innovations as they are: what those hide would look as if it agreed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.part import Part
from torch_ebip.filtering.updates.trust import LEAST


class Noticed(NamedTuple):
    """A sample beside what was expected of it, over K DoFs.

    Attributes:
        y: [..., K], units of the DoFs; ignored where not observed.
        observed: bool [..., K]; None for all.
        rows: int64 [K], which of the filter's DoFs these are; None for all.
        expected: [..., K], mean of h(x) over members, units of the DoFs.
        variance: [..., K], of h(x) over members, squared units.
        mean: [..., m], of what moves.
    """

    y: Tensor
    observed: Tensor | None
    rows: Tensor | None
    expected: Tensor
    variance: Tensor
    mean: Tensor

    def __repr__(self) -> str:
        return brief(self)


class Surprise(Part, ABC):
    """Judges S sensors by their innovations; a subclass says how.

    What it remembers is a NamedTuple of tensors that gives, among others, ``level`` [..., S], how surprising each
    sensor is, and ``counts`` [..., S], in [0, 1], what each of them counts.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stride = 1

    def select(self, view: View) -> Surprise:
        """See `Part.select`."""
        part = sharing(self)
        part.stride = self.stride * view.stride
        return part

    @abstractmethod
    def start(self, like: Tensor) -> Any:
        """What is remembered before anything was seen, batch dimensions of members ``like`` [..., E, n]."""

    @abstractmethod
    def forget(self, memory: Any, dt: Tensor) -> Any:
        """What is left of a memory after dt [...] seconds."""

    @abstractmethod
    def judge(self, memory: Any, noticed: Noticed) -> tuple[Any, Tensor | None]:
        """The memory after a sample that was noticed, and what each value counts, [..., K]; None for all alike."""

    @abstractmethod
    def familiarity(self, memory: Any) -> Tensor:
        """[...], in [0, 1], how usual a memory's largest surprise so far would be; NaN where nobody knows."""


def believed(noticed: Noticed, deviation: Tensor, counts: Tensor, stride: int = 1) -> tuple[Tensor, Tensor]:
    """Values and deviations of their noise [..., K] as an update takes them from sensors that count less.

    As robust weights w do: with S = var h(x) + R the noise becomes R + S (1/w - 1). What counts nothing is
    replaced by what was expected.

    Args:
        noticed: the sample.
        deviation: [K] or [..., K], standard deviations of the noise, units of the DoFs.
        counts: [..., K], w, in [0, 1].
        stride: how many samples each one stands for.
    """
    noise = deviation.square() * stride
    inverse = 1 / counts.clamp(min=LEAST)
    wider = ((noise + (noticed.variance + noise) * (inverse - 1)) / stride).sqrt()
    y = torch.where(counts > LEAST, noticed.y, noticed.expected)
    return y, torch.where(counts < 1, wider, deviation)
