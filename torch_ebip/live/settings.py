"""How a session treats its sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from torch_ebip.common.arguments import as_count, as_number
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.live.opening import FIRST_SAMPLE

FROZEN_AFTER = 0.25
"""Seconds: a sensor whose demonstrations never repeat themselves is frozen then."""


@dataclass(frozen=True)
class SessionSettings:
    """How a session treats its sensors; times in seconds.

    Attributes:
        start: time of phase 0 on the clock of all other times; ``"first sample"``: the earliest time within
            ``window`` of the first sample that arrives, whatever the order.
        window: by how much a sample may arrive late; later ones are dropped and counted.
        settle: for how long a tick waits for its samples before it is filtered. Sensors that arrive within it cost no
            replay; forecasts go on from the last tick at the speed of the interaction.
        margin: how far outside the range of the demonstrations a value may lie, in widths of that range. Nothing else
            protects the filter from values that are finite and absurd.
        frozen_after: for how long a sensor may repeat itself to the last digit before it is taken for frozen: one
            number for all of them, or by name (infinity: it never is). Default: a quarter of a second, or half as
            long again as it ever did in the demonstrations, whichever is more; a switch may say the same for long.
        stale_after: without anything usable for how long a sensor is reported stale.
        longest_gap: by how much the present, or a sample, may be ahead of what was filtered last.
        seed: of all draws.
        delays: by name of a sensor, by how much its stamps are later than what it measured, where that is known: of a
            camera whose pictures are stamped on arrival, say. Taken off the stamps.
        correct_clocks: whether jumps of a sensor's clock are taken out of its stamps. They are reported in any case;
            uncorrected, a sensor whose clock is ahead of all others is refused. Where ``now`` is not given, a gap in
            which no sensor says anything is taken for a jump then.

    Raises:
        ValueError: a setting outside its range.
    """

    start: float | str = FIRST_SAMPLE
    window: float = 0.25
    settle: float = 0.0
    margin: float = 1.0
    frozen_after: float | Mapping[str, float] | None = None
    stale_after: float = 0.1
    longest_gap: float = 10.0
    seed: int = 0
    delays: Mapping[str, float] | None = None
    correct_clocks: bool = False

    def __post_init__(self) -> None:
        """Checks, and makes plain numbers of those of other libraries."""
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "start" and isinstance(value, str):
                if value != FIRST_SAMPLE:
                    raise ValueError(f"start must be a time in seconds or {FIRST_SAMPLE!r}, got {value[:40]!r}")
            elif field.name == "seed":
                value = as_count("seed", value, -(2**63))
            elif field.name == "correct_clocks":
                if str(value) not in ("True", "False"):
                    raise ValueError(f"correct_clocks must be True or False, got {str(value)[:40]!r}")
                value = bool(value)
            elif isinstance(value, Mapping):
                value = {
                    str(sensor): _real(f"{field.name} of {sensor!r}", number) for sensor, number in value.items()
                }
            elif value is not None:
                value = _real(field.name, value)
            object.__setattr__(self, field.name, value)
        positive = {name: getattr(self, name) for name in ("window", "stale_after", "longest_gap")}
        frozen = self.frozen_after
        if isinstance(frozen, Mapping):
            positive |= {f"frozen_after of {sensor!r}": number for sensor, number in frozen.items()}
        elif frozen is not None:
            positive["frozen_after"] = frozen
        for name, number in positive.items():
            if number is None or not number > 0:
                raise ValueError(f"{name} must be a positive number of seconds, got {number}")
        for name in ("start", "window", "longest_gap"):
            if getattr(self, name) != FIRST_SAMPLE and not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)}")
        for sensor, delay in (self.delays or {}).items():
            if not math.isfinite(delay):
                raise ValueError(f"delays of {sensor!r} must be a finite number of seconds, got {delay}")
        if not self.margin >= 0:
            raise ValueError(f"margin must not be negative, got {self.margin}")
        if not 0 <= self.settle < self.window:
            raise ValueError(
                f"settle must be at least 0 and less than the window of {self.window} s, got {self.settle}"
            )


def _real(name: str, value: Any) -> float:
    """A plain number of whatever library, which may be infinite; NaN is caught where its range is."""
    try:
        return as_number(name, value)
    except ValueError:
        if isinstance(value, float) or getattr(value, "ndim", None) == 0:
            return float(value)
        raise


def patience_of(
    frozen_after: float | Mapping[str, float] | None, primitive: InteractionPrimitive, sensors: Sequence[str]
) -> list[float]:
    """Seconds for which each sensor may repeat itself; see `SessionSettings`."""
    repeats = dict(zip(primitive.layout.names, primitive.longest_repeat.tolist(), strict=True))
    usual = {name: max(FROZEN_AFTER, 1.5 * repeats[name]) for name in sensors}
    if frozen_after is None:
        return list(usual.values())
    if not isinstance(frozen_after, Mapping):
        return [frozen_after] * len(sensors)
    strangers = [name for name in frozen_after if name not in usual]
    if strangers:
        raise ValueError(f"frozen_after names {', '.join(strangers)}; the sensors are {', '.join(sensors)}")
    return [frozen_after.get(name, usual[name]) for name in sensors]


def delays_of(delays: Mapping[str, float] | None, sensors: Sequence[str]) -> list[float]:
    """Seconds by which the stamps of each sensor are late; see `SessionSettings`."""
    delays = delays or {}
    strangers = [name for name in delays if name not in sensors]
    if strangers:
        raise ValueError(f"delays name {', '.join(strangers)}; the sensors are {', '.join(sensors)}")
    return [delays.get(name, 0.0) for name in sensors]
