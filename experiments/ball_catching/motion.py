"""Smooth motion of generalised coordinates: quintic segments between via points, and physiological wobble.

Both give position, velocity and acceleration in closed form, so that what the sensors derive from them is
exact. Vectorised over N throws; C coordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from experiments.ball_catching.geometry import Array


class Motion(NamedTuple):
    """Coordinates [N, T, C] and their first and second time derivatives."""

    q: Array
    qd: Array
    qdd: Array

    def __add__(self, other: object) -> Motion:
        if not isinstance(other, Motion):
            return NotImplemented
        return Motion(self.q + other.q, self.qd + other.qd, self.qdd + other.qdd)


def smoothstep(s: Array) -> Array:
    """Minimum-jerk step from 0 to 1 (Flash and Hogan, J. Neurosci. 5, 1985); flat outside [0, 1]."""
    s = np.clip(s, 0.0, 1.0)
    result: Array = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return result


def through(t: Array, knots: Array, q: Array, qd: Array, qdd: Array) -> Motion:
    """Piecewise quintic through via points, continuous up to the acceleration; held before and after them.

    Args:
        t: times [N, T], s.
        knots: via times [N, K], increasing, s.
        q, qd, qdd: via position, velocity and acceleration [N, K, C]; the first and last should be at rest.
    """
    clipped = np.clip(t, knots[:, :1], knots[:, -1:])
    segment = np.clip((clipped[:, :, None] >= knots[:, None, :]).sum(-1) - 1, 0, knots.shape[1] - 2)
    rows = np.arange(len(t))[:, None]
    start = knots[rows, segment]
    h = (knots[rows, segment + 1] - start)[..., None]
    s = (clipped - start)[..., None] / h
    q0, v0, a0 = (x[rows, segment] for x in (q, qd, qdd))
    q1, v1, a1 = (x[rows, segment + 1] for x in (q, qd, qdd))
    c0, c1, c2 = q0, h * v0, 0.5 * h**2 * a0
    # The quintic's upper three coefficients follow from the state at the segment's end.
    dq = q1 - c0 - c1 - c2
    dv = h * v1 - c1 - 2 * c2
    da = h**2 * a1 - 2 * c2
    c3 = 10 * dq - 4 * dv + 0.5 * da
    c4 = -15 * dq + 7 * dv - da
    c5 = 6 * dq - 3 * dv + 0.5 * da
    return Motion(
        c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5)))),
        (c1 + s * (2 * c2 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h,
        (2 * c2 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5))) / h**2,
    )


class Wobble:
    """What no two repetitions share: for each throw and coordinate slow sinusoids of random phase.

    Args:
        scale: standard deviation [C] of each coordinate.
        fastest: highest frequency [C], Hz; the lowest is 0.3 Hz and the power falls as 1/f^2.
    """

    def __init__(self, rng: np.random.Generator, n: int, scale: Array, fastest: Array) -> None:
        shape = (n, len(scale), 5)
        frequency = rng.uniform(0.3, fastest[:, None], shape)
        amplitude = 1.0 / frequency
        amplitude *= np.sqrt(2.0) / np.linalg.norm(amplitude, axis=-1, keepdims=True)
        self.omega = 2 * np.pi * frequency
        self.amplitude = amplitude * scale[:, None]
        self.offset = rng.uniform(0.0, 2 * np.pi, shape)

    def at(self, t: Array) -> Motion:
        """Motion [N, T, C] at times [N, T], s."""
        angle = self.omega[:, None] * t[:, :, None, None] + self.offset[:, None]
        sine, cosine = self.amplitude[:, None] * np.sin(angle), self.amplitude[:, None] * np.cos(angle)
        w = self.omega[:, None]
        return Motion(sine.sum(-1), (w * cosine).sum(-1), (-(w**2) * sine).sum(-1))
