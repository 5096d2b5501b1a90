"""A filter led from tick to tick, and back when what happened at a tick that is past becomes known late."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.live.engine import Engine
from torch_ebip.live.intake import Freshness, Intake

REPEATS = 3
"""Ticks of the past that are repeated with each new one for sensors that are always late."""
_NONE = 1 << 62


class Track:
    """Ticks that are filtered one after the other; the states of the last of them are kept.

    Where a tick that is past has changed, all since then is repeated: at once, or a few ticks with each new one while
    the filter goes on from where it is. What is repeated so arrives a little later, and no tick costs much more than
    another; once it has, the state is the same.

    Args:
        engine: with two slots more than ticks are kept.
        slots: how many ticks are kept.
        patience: [M] seconds for which each sensor may say the same.
        like: dtype and device of the samples.

    Attributes:
        head: the newest tick filtered; -1 before the first.
        ticks: how many the filter was led through so far, repeated ones included.
    """

    def __init__(self, engine: Engine, slots: int, patience: list[float], like: Tensor) -> None:
        self._engine, self._slots, self._patience, self._like = engine, slots, patience, like
        self._first, self._front = slots, slots + 1
        engine.save(self._first)
        self.ticks = 0

    def begin(self, intake: Intake) -> None:
        """From the state before anything was seen, with what is to arrive there."""
        self._intake = intake
        self._freshness = [intake.fresh() for _ in range(self._slots)]
        self.freshness = self._freshness[-1]
        self.head = self._done = -1
        self._dirty, self._at_once = _NONE, False
        self._engine.load(self._first)
        self._engine.save(-1 % self._slots)
        self._in_ring = True  # whether the engine is in the state of the tick that was repeated last

    def changed(self, tick: int, always_late: bool) -> None:
        """Something arrived for a tick; whether from a sensor that is always late."""
        if tick <= self.head and not always_late:
            self._at_once = True
        if tick <= self._done:
            self._dirty = min(self._dirty, tick)

    def advance(self, newest: int, whole: bool) -> None:
        """Filter up to a tick; with ``whole``, all that is to be repeated too."""
        newest = max(newest, self.head)
        budget = REPEATS * (newest - self.head)
        level = self._done == self.head
        first = min(self._dirty - 1, self._done) if level else self._done
        if whole or self._at_once or first + budget >= newest:
            if self._dirty <= self._done and (level or whole or self._at_once):
                self._back()
            self._on(newest)
            self.head, self._at_once = newest, False
            self.freshness = self._freshness[self._done % self._slots]
            return
        if level:  # go on from here, while the past is repeated
            self._engine.save(self._front)
            self._back()
        elif newest > self.head or self._in_ring:
            self._engine.load(self._front)
        while self.head < newest:
            self.head += 1
            self.freshness = self._step(self.head, self.freshness, self._front)
            self._engine.save(self._front)
        self._in_ring = False
        if budget:
            self._on(self._done + budget)
            self._engine.load(self._front)
            self._in_ring = False

    def _back(self) -> None:
        """To the last tick that is as it should be."""
        self._done, self._dirty, self._in_ring = self._dirty - 1, _NONE, False

    def _on(self, newest: int) -> None:
        """Each tick from the state of the one before; all are kept."""
        if not self._in_ring:
            self._engine.load(self._done % self._slots)
            self._in_ring = True
        while self._done < newest:
            before, slot = self._freshness[self._done % self._slots], self._done % self._slots
            self._done += 1
            self._freshness[self._done % self._slots] = self._step(self._done, before, slot)
            self._engine.save(self._done % self._slots)

    def _step(self, tick: int, before: Freshness, slot: int) -> Freshness:
        """One more tick, from a state that a slot holds."""
        freshness = before.copy()
        self.ticks += 1
        if tick > 0:
            self._engine.predict()
        values, usable = self._intake.usable(tick, freshness, self._patience)
        if usable.any():
            y = torch.as_tensor(values, dtype=self._like.dtype, device=self._like.device)
            try:
                self._engine.update(y, tuple(usable.tolist()))
                done = self._engine.finite()
            except ValueError:
                done = False
            if not done:
                # Back to before the tick: this one is left out, as if nothing had been measured.
                freshness.failed += 1
                self._engine.load(slot)
                if tick > 0:
                    self._engine.predict()
        return freshness
