"""Throwers who hesitate: in the wind-up they come to a stop, wait, and go on as if nothing had been."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from experiments.ball_catching import body
from experiments.ball_catching.geometry import Array
from experiments.ball_catching.motion import Motion, smoothstep
from experiments.ball_catching.thrower import Throw

RAMP = 0.15
"""s, in which a thrower comes to a stop, and in which they get going again."""


class Clock(NamedTuple):
    """The thrower's own time [N, T], s, at some times, its speed (1: as planned), and the change of that, 1/s."""

    time: Array
    speed: Array
    change: Array


@dataclass(frozen=True)
class Hesitation:
    """When N throwers stop, and for how long they wait, s [N]; infinity and 0: they do not."""

    at: Array
    wait: Array

    @property
    def lost(self) -> Array:
        """s [N], by which all that comes after is later."""
        return np.where(np.isfinite(self.at), self.wait + RAMP, 0.0)

    def clock(self, t: Array) -> Clock:
        """At times [N, T]."""
        at, wait = np.where(np.isfinite(self.at), self.at, 1e9)[:, None], self.wait[:, None]
        slowing, going = (t - at) / RAMP, (t - at - RAMP - wait) / RAMP
        speed = 1 - smoothstep(slowing) + smoothstep(going)
        change = (_slope(going) - _slope(slowing)) / RAMP
        time = np.minimum(t, at) + RAMP * (np.clip(slowing, 0, 1) - _area(slowing) + _area(going))
        time = time + np.maximum(t - at - 2 * RAMP - wait, 0)
        return Clock(time, speed, change)

    def later(self, when: Array) -> Array:
        """The times [N] at which what was planned for ``when`` happens; infinity stays."""
        return np.where(when > self.at, when + self.lost, when)


class Hesitating(Throw):
    """A planned throw whose throwers hesitate; its times are those at which things happen."""

    planned: Throw
    hesitation: Hesitation

    @classmethod
    def of(cls, planned: Throw, hesitation: Hesitation) -> Hesitating:
        """The same throw with times moved."""
        content = {field.name: getattr(planned, field.name) for field in fields(Throw)}
        for name in ("look", "release", "lift", "land"):
            content[name] = hesitation.later(content[name])
        made = cls(**content)
        object.__setattr__(made, "planned", planned)
        object.__setattr__(made, "hesitation", hesitation)
        return made

    def motion(self, t: Array) -> Motion:
        """See `Throw.motion`; who waits sways on."""
        clock = self.hesitation.clock(t)
        planned = self.planned.motion(clock.time)
        swaying = self.planned.wobble.at(clock.time)
        still = Motion(*(a - b for a, b in zip(planned, swaying, strict=True)))
        return _at(clock, still) + self.planned.wobble.at(t)

    def feet(self, t: Array) -> tuple[Motion, Motion]:
        """See `Throw.feet`."""
        clock = self.hesitation.clock(t)
        left, right = self.planned.feet(clock.time)
        return _at(clock, left), _at(clock, right)

    def body(self, t: Array) -> body.Body:
        """See `Throw.body`."""
        return body.move(self.motion(t), self.stature, self.mass, self.feet(t))


def hesitating(rng: np.random.Generator, planned: Throw, shortest: float = 0.3, longest: float = 1.0) -> Hesitating:
    """Every second thrower stops between a third and nine tenths of the way to the release, for so many seconds."""
    n = len(planned.release)
    at = planned.release * rng.uniform(0.33, 0.9, n)
    # Nobody stops in the last moments before a release: the arm is under way.
    at = np.minimum(at, planned.release - 0.35)
    wait = rng.uniform(shortest, longest, n)
    some = np.arange(n) % 2 == 1
    return Hesitating.of(planned, Hesitation(np.where(some, at, np.inf), np.where(some, wait, 0.0)))


def _at(clock: Clock, motion: Motion) -> Motion:
    """A motion over the thrower's own time, by the clock: the chain rule."""
    speed, change = clock.speed[..., None], clock.change[..., None]
    return Motion(motion.q, motion.qd * speed, motion.qdd * speed**2 + motion.qd * change)


def _slope(s: Array) -> Array:
    """Derivative of `smoothstep`."""
    s = np.clip(s, 0.0, 1.0)
    return 30 * s**2 * (1 - s) ** 2


def _area(s: Array) -> Array:
    """Integral of `smoothstep` from 0 to s within [0, 1]."""
    s = np.clip(s, 0.0, 1.0)
    return 2.5 * s**4 - 3 * s**5 + s**6
