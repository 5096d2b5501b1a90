"""The arm's own controller: set points at 125 Hz within its limits, after a transport delay, and a stiff servo.

Limits: 180 degrees a second for each joint (UR5 data sheet; the URDF's `velocity`). For accelerations the data sheet
has no figure; ours is a little above what hand-guided demonstrations reach (22 rad/s^2), and the joints' torques (the
URDF's `effort`) hold in any case. A CB3 controller takes a new set point every 8 ms; what it is told shows in the
motion some cycles later.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np

from experiments.ball_catching.geometry import Array
from experiments.ball_catching.scene.model import load_mujoco

CYCLE = 0.008
"""s between set points."""


class Limits(NamedTuple):
    """What set points keep to: `speed` rad/s, `acceleration` rad/s^2; `delay` s until a command shows."""

    speed: float = float(np.pi)
    acceleration: float = 25.0
    delay: float = 3 * CYCLE

    def slowed(self, share: float) -> Limits:
        """An arm of that share of the speed and acceleration."""
        return self._replace(speed=share * self.speed, acceleration=share * self.acceleration)


STIFFNESS = 100.0
"""rad/s, bandwidth of the inner loop, critically damped."""


class Servo:
    """Drives the arm's six joints towards the newest goal that has come through.

    Args:
        model: from `model.build`.
        data: its state; motor torques are written to ``data.ctrl[:6]``.
        limits: of the set points.
    """

    def __init__(self, model: Any, data: Any, limits: Limits | None = None) -> None:
        self.limits = Limits() if limits is None else limits
        self._mujoco, self._model, self._data = load_mujoco(), model, data
        self._effort = np.array(model.jnt_actfrcrange[:6, 1])
        self._pending: deque[tuple[float, Array]] = deque()
        self._next = 0.0
        self._torque = np.zeros(model.nv)
        self.start(np.zeros(6))

    def start(self, joints: Array) -> None:
        """At rest at joints [6], rad, which is the goal until another comes."""
        self.goal = np.array(joints, dtype=np.float64)
        self._from, self._to = self.goal.copy(), self.goal.copy()
        self._speed, self._speed_before = np.zeros(6), np.zeros(6)
        self._pending.clear()
        self._next = 0.0

    def command(self, time: float, joints: Array) -> None:
        """A new goal, joints [6], rad, sent at a time, s."""
        self._pending.append((time + self.limits.delay, np.array(joints, dtype=np.float64)))

    def drive(self, time: float) -> None:
        """Torques for the physics step that begins at a time, s; times must not decrease."""
        if time >= self._next - 1e-9:
            while self._pending and self._pending[0][0] <= time + 1e-9:
                self.goal = self._pending.popleft()[1]
            self._from, self._speed_before = self._to, self._speed
            self._speed = next_speed(self._to, self._speed, self.goal, self.limits)
            self._to = self._to + 0.5 * CYCLE * (self._speed_before + self._speed)
            self._next += CYCLE
        # Within a cycle the set point accelerates evenly.
        s = 1.0 - (self._next - time) / CYCLE
        acceleration = (self._speed - self._speed_before) / CYCLE
        elapsed = s * CYCLE
        wanted = self._from + self._speed_before * elapsed + 0.5 * acceleration * elapsed**2
        rate = self._speed_before + acceleration * elapsed
        data = self._data
        pull = STIFFNESS**2 * (wanted - data.qpos[:6]) + 2 * STIFFNESS * (rate - data.qvel[:6])
        demand = np.zeros(self._model.nv)
        demand[:6] = acceleration + pull
        self._mujoco.mj_mulM(self._model, data, self._torque, demand)
        data.ctrl[:6] = np.clip(self._torque[:6] + data.qfrc_bias[:6], -self._effort, self._effort)


def next_speed(joints: Array, speed: Array, goal: Array, limits: Limits) -> Array:
    """Speed at the end of the next cycle that reaches the goal soonest and stops there, within the limits.

    Args:
        joints, speed, goal: [..., 6], rad and rad/s, of the set point and where it is to go.
        limits: of the arm.
    """
    a = limits.acceleration
    ahead = goal - joints - 0.5 * CYCLE * speed
    # v with v^2 / 2a + v T / 2 = |rest|: what can still be braked from, one cycle on.
    reach = np.sqrt((0.5 * a * CYCLE) ** 2 + 2 * a * np.abs(ahead))
    wanted = np.sign(ahead) * np.minimum(reach - 0.5 * a * CYCLE, limits.speed)
    limited: Array = np.clip(wanted, speed - a * CYCLE, speed + a * CYCLE)
    return limited


def travel_time(distance: Array, speed: Array, limits: Limits) -> Array:
    """Least seconds [...] that a joint takes over a distance, rad, from a speed, rad/s, to rest, delay included.

    Bang-bang or trapezoidal.
    """
    a, top = limits.acceleration, limits.speed
    speed = np.clip(speed, -top, top)
    # Mirror so that the way that remains after braking at once is positive.
    sign = np.where(distance - 0.5 * speed * np.abs(speed) / a >= 0, 1.0, -1.0)
    d, v = sign * distance, sign * speed
    peak = np.minimum(np.sqrt(np.maximum(a * d + 0.5 * v**2, 0.0)), top)
    cruise = np.maximum(d - (2 * top**2 - v**2) / (2 * a), 0.0) / top
    seconds: Array = (2 * peak - v) / a + cruise + limits.delay
    return seconds
