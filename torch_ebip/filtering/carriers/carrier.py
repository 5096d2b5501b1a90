"""What an update needs of whoever holds the members."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.filtering.functional import Spread, Taper
from torch_ebip.filtering.states import Memory
from torch_ebip.filtering.updates.rules import Rule


class Measured(NamedTuple):
    """What was measured, and with which noise, over K DoFs.

    Attributes:
        y: [..., K], units of the DoFs; anything where not observed.
        observed: bool [..., K]; None for all.
        deviation: [K] or [..., K], square root of R.
        rows: int64 [K], which of the model's DoFs; None for all.
    """

    y: Tensor
    observed: Tensor | None
    deviation: Tensor
    rows: Tensor | None

    def __repr__(self) -> str:
        return brief(self)


class Carrier(ABC):
    """Holds the members of an ensemble, and what the parts of its update remember."""

    memory: Memory

    @property
    @abstractmethod
    def moving(self) -> Tensor:
        """[..., E, m], what moves of each member."""

    @property
    @abstractmethod
    def mean(self) -> Tensor:
        """[..., m], its mean."""

    @abstractmethod
    def expected(self) -> Tensor:
        """[..., K], mean of h(x) over members, of the DoFs that are being measured."""

    @abstractmethod
    def variance(self) -> Tensor:
        """[..., K], of h(x) over members, of the DoFs that are being measured; squared units."""

    @abstractmethod
    def move(
        self, rule: Rule, measured: Measured, taper: Taper | None, spread: Spread, perturbations: Tensor | None
    ) -> Tensor:
        """Move the members by a rule, and give the log-likelihood [...] of what was measured.

        Args:
            rule: what turns the innovation into moves.
            measured: with the values and deviations that the update believes.
            taper: localisation over all of the model's DoFs.
            spread: what becomes of the anomalies.
            perturbations: standard-normal draws of a rule that perturbs, [..., E, K], or as the carrier has them.
        """
