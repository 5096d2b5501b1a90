"""Flight of the ball: gravity and quadratic air drag, no spin.

    dv/dt = g - k |v| v,    k = rho c_d A / (2 m)

(e.g. Mehta, "Aerodynamics of sports balls", Annu. Rev. Fluid Mech. 17, 1985; c_d = 0.47 for a smooth sphere
at the Reynolds numbers of a toss, about 3e4.) Everything is vectorised over throws.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from experiments.ball_catching.geometry import GRAVITY, Array

BALL_RADIUS = 0.045
"""m"""
BALL_MASS = 0.11
"""kg, a soft play ball"""
AIR_DENSITY = 1.2
"""kg/m^3"""
DRAG_COEFFICIENT = 0.47
DRAG = 0.5 * AIR_DENSITY * DRAG_COEFFICIENT * math.pi * BALL_RADIUS**2 / BALL_MASS
"""k of the equation above, 1/m"""

STEP = 1.0 / 240.0
"""s, of the Runge-Kutta grid; its error over a toss is below a nanometre"""


def acceleration(velocity: Array) -> Array:
    """Acceleration of the free ball, m/s^2, at `velocity` [..., 3], m/s."""
    speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
    result: Array = -DRAG * speed * velocity
    result[..., 2] -= GRAVITY
    return result


@dataclass(frozen=True)
class Flight:
    """N flights on a common grid of times since the release.

    `position`, `velocity`: [N, K, 3] at times k * STEP.
    """

    position: Array
    velocity: Array

    def at(self, seconds: Array) -> Array:
        """Positions [N, T, 3] at times since the release [N, T], s; clamped to the grid.

        Cubic Hermite between grid points: exact in position and velocity there, below 1e-9 m in between.
        """
        last = self.position.shape[1] - 1
        grid = np.clip(seconds / STEP, 0.0, last)
        index = np.minimum(grid.astype(np.int64), last - 1)
        s = (grid - index)[..., None]
        rows = np.arange(len(self.position))[:, None]
        p0, p1 = self.position[rows, index], self.position[rows, index + 1]
        m0, m1 = STEP * self.velocity[rows, index], STEP * self.velocity[rows, index + 1]
        result: Array = (
            (2 * s**3 - 3 * s**2 + 1) * p0
            + (s**3 - 2 * s**2 + s) * m0
            + (3 * s**2 - 2 * s**3) * p1
            + (s**3 - s**2) * m1
        )
        return result

    def velocity_at(self, seconds: Array) -> Array:
        """Velocities [N, T, 3], m/s, at times since the release [N, T], s (linear between grid points)."""
        last = self.position.shape[1] - 1
        grid = np.clip(seconds / STEP, 0.0, last)
        index = np.minimum(grid.astype(np.int64), last - 1)
        s = (grid - index)[..., None]
        rows = np.arange(len(self.position))[:, None]
        result: Array = (1 - s) * self.velocity[rows, index] + s * self.velocity[rows, index + 1]
        return result


def fly(position: Array, velocity: Array, seconds: float) -> Flight:
    """Integrates N flights from release states [N, 3] for `seconds` (classical Runge-Kutta)."""
    n_steps = math.ceil(seconds / STEP)
    positions, velocities = [position], [velocity]
    p, v, h = position, velocity, STEP
    for _ in range(n_steps):
        a1 = acceleration(v)
        v2 = v + 0.5 * h * a1
        a2 = acceleration(v2)
        v3 = v + 0.5 * h * a2
        a3 = acceleration(v3)
        v4 = v + h * a3
        a4 = acceleration(v4)
        p = p + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        positions.append(p)
        velocities.append(v)
    return Flight(np.stack(positions, axis=1), np.stack(velocities, axis=1))


def flight_time(position: Array, target: Array, elevation: Array) -> Array:
    """Seconds [N] from `position` to `target` [N, 3] of a drag-free throw at `elevation` [N], rad."""
    distance = np.hypot(target[:, 0] - position[:, 0], target[:, 1] - position[:, 1])
    rise = target[:, 2] - position[:, 2]
    # A throw too flat to reach the target has no time; such a thrower aims a little higher.
    fall = np.maximum(distance * np.tan(elevation) - rise, 0.5)
    result: Array = np.sqrt(2.0 * fall / GRAVITY)
    return result


def release_velocity(position: Array, target: Array, seconds: Array) -> Array:
    """Velocities [N, 3] that bring the ball from `position` to `target` [N, 3] in `seconds` [N], with drag.

    Shooting: the miss divided by the flight time is the correction of the velocity. Drag is a small share of
    gravity here, so each round shrinks the miss about tenfold.
    """
    drop = np.zeros_like(position)
    drop[:, 2] = 0.5 * GRAVITY * seconds**2
    velocity: Array = (target - position + drop) / seconds[:, None]
    for _ in range(12):
        arrival = fly(position, velocity, float(seconds.max()) + STEP).at(seconds[:, None])[:, 0]
        velocity = velocity + (target - arrival) / seconds[:, None]
    return velocity
