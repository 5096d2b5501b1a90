"""How a session treats its sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class SessionSettings:
    """How a session treats its sensors; times in seconds.

    Attributes:
        start: time of phase 0 on the clock of all other times.
        window: by how much a sample may arrive late; later ones are dropped and counted.
        settle: for how long a tick waits for its samples before it is filtered. Sensors that arrive within it cost no
            replay; forecasts go on from the last tick at the speed of the interaction.
        margin: how far outside the range of the demonstrations a value may lie, in widths of that range. Nothing else
            protects the filter from values that are finite and absurd.
        frozen_after: for how long a sensor may repeat itself to the last digit before it is taken for frozen.
        stale_after: without anything usable for how long a sensor is reported stale.
        longest_gap: by how much the present, or a sample, may be ahead of what was filtered last.
        seed: of all draws.

    Raises:
        ValueError: a setting outside its range.
    """

    start: float = 0.0
    window: float = 0.25
    settle: float = 0.0
    margin: float = 1.0
    frozen_after: float = 0.25
    stale_after: float = 0.1
    longest_gap: float = 10.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Checks, and makes plain numbers of those of other libraries."""
        for field in fields(self):
            kind = int if field.name == "seed" else float
            object.__setattr__(self, field.name, kind(getattr(self, field.name)))
        for name in ("window", "frozen_after", "stale_after", "longest_gap"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be a positive number of seconds, got {getattr(self, name)}")
        for name in ("start", "window", "longest_gap"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")
        if not self.margin >= 0:
            raise ValueError(f"margin must not be negative, got {self.margin}")
        if not 0 <= self.settle < self.window:
            raise ValueError(
                f"settle must be at least 0 and less than the window of {self.window} s, got {self.settle}"
            )
