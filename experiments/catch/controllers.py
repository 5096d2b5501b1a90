"""Who moves the arm: filters through a live session, the mean response, and a catcher that only reacts."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np
import torch

from experiments.ball_catching.flight import DRAG
from experiments.ball_catching.geometry import DISTANCE, GRAVITY, TABLE_HEIGHT, Array
from experiments.ball_catching.scene import Limits, Posture, Reach, travel_time
from experiments.ball_catching.teacher import LOWEST
from experiments.catch.throws import OUTSTRETCHED
from torch_ebip import Filter, InteractionPrimitive, InteractionSession, SessionSettings

SETTLE = 0.02
"""s for which a session waits for the sensors of a moment, a little more than the slowest takes."""
LEAD = 0.5
"""s ahead of now of what the arm is told to do: it makes up for delays, and lets the arm begin early."""


class Controller(Protocol):
    """What drives the arm in one throw.

    Attributes:
        seconds: how long each cycle's decision took.
    """

    seconds: list[float]

    def push(self, sensor: str, values: Array, time: float) -> None:
        """A sample has arrived."""

    def command(self, now: float, joints: Array) -> Array | None:
        """Where the arm should be, [6] rad, given where it is measured to be; None leaves it as it is."""


class SessionController:
    """Follows what a filter expects of the robot: the paper's eBIP, and what is compared with it."""

    def __init__(self, filter: Filter, primitive: InteractionPrimitive, seed: int, lead: float | None = LEAD) -> None:
        self.session = InteractionSession(
            filter, primitive, settings=SessionSettings(start=0.0, settle=SETTLE, seed=seed)
        )
        self.lead = lead
        self.seconds: list[float] = []

    def push(self, sensor: str, values: Array, time: float) -> None:
        """See `Controller`."""
        self.session.push(sensor, values, time)

    def command(self, now: float, joints: Array) -> Array | None:
        """See `Controller`."""
        began = time.perf_counter()
        expected = self.session.forecast(self.lead, now)
        self.seconds.append(time.perf_counter() - began)
        goal: Array = expected.mean.double().numpy()
        return goal


class MeanController:
    """Plays the mean of the demonstrations at their mean speed, whatever is seen."""

    def __init__(self, primitive: InteractionPrimitive, lead: float | None = LEAD) -> None:
        self.primitive, self.lead = primitive, lead
        self.speed = float(primitive.phase_velocity.mean())
        self.seconds: list[float] = []

    def push(self, sensor: str, values: Array, time: float) -> None:
        """Not looked at."""

    def command(self, now: float, joints: Array) -> Array | None:
        """See `Controller`."""
        phase = 1.0 if self.lead is None else min(1.0, (now + self.lead) * self.speed)
        goal: Array = mean_posture(self.primitive, phase)
        return goal


def mean_posture(primitive: InteractionPrimitive, phase: float) -> Array:
    """The robot's joints [6], rad, at a phase, averaged over the demonstrations."""
    paths = primitive.basis.project(torch.full((len(primitive),), phase), primitive.weights)
    mean: Array = paths.mean(0)[primitive.layout.slice("robot")].double().numpy()
    return mean


class ReactiveController:
    """Sees the ball only: fits its flight, finds where it can be met, and goes there at full speed.

    It is given what a filter has to learn: gravity, the drag of this very ball, the arm's kinematics and limits.

    Args:
        reach: inverse kinematics.
        liked: joints [6], rad, around which postures are sought: those of the mean demonstration's end.
        limits: of the arm.
        least: samples of the ball that it wants to see first.
    """

    def __init__(self, reach: Reach, liked: Array, limits: Limits, least: int = 4) -> None:
        self.limits = limits
        self.reach, self.liked, self.least = reach, liked, least
        self.seen: list[tuple[float, Array]] = []
        self.seconds: list[float] = []
        self._before: tuple[float, Array] | None = None
        self._meeting: float | None = None
        self._start = liked

    def push(self, sensor: str, values: Array, time: float) -> None:
        """See `Controller`."""
        if sensor == "ball" and np.isfinite(values).all():
            self.seen.append((time, values))

    def command(self, now: float, joints: Array) -> Array | None:
        """See `Controller`."""
        began = time.perf_counter()
        speed = np.zeros(6) if self._before is None else (joints - self._before[1]) / max(now - self._before[0], 1e-3)
        self._before = now, joints
        goal = self._best(now, joints, speed) if len(self.seen) >= self.least else None
        self.seconds.append(time.perf_counter() - began)
        return goal

    def _best(self, now: float, joints: Array, speed: Array) -> Array | None:
        """Where to go: the point on the ball's way with the most time to spare, kept as long as it is feasible.

        An arm that changes its mind is still moving when the ball comes, and flings it out again.
        """
        times, path, velocities = predict_flight(self.seen, now)
        if len(times) == 0:
            return None
        if self._meeting is not None:
            k = int(np.abs(times - self._meeting).argmin())
            posture = self._posture(path[k], velocities[k], self._start)
            if posture.miss < 0.03 and self._spare(times[k] - now, posture.joints - joints, speed) > -0.02:
                self._start = posture.joints
                return posture.joints
        offset = path - np.array([DISTANCE, 0.0, TABLE_HEIGHT])
        near = (np.linalg.norm(offset, axis=-1) < OUTSTRETCHED) & (path[:, 2] > LOWEST) & (offset[:, 0] < 0.3)
        best: tuple[float, float, Array] | None = None
        start = self.liked
        for k in np.nonzero(near)[0][::5]:  # every 25 ms
            posture = self._posture(path[k], velocities[k], start)
            start = posture.joints
            spare = self._spare(times[k] - now, posture.joints - joints, speed)
            if posture.miss < 0.03 and (best is None or spare > best[0]):
                best = spare, float(times[k]), posture.joints
        if best is None:
            return None
        _, self._meeting, self._start = best
        return self._start

    def _posture(self, point: Array, velocity: Array, start: Array) -> Posture:
        return self.reach.solve(point, -velocity / np.linalg.norm(velocity), start, self.liked, rounds=12)

    def _spare(self, seconds: float, way: Array, speed: Array) -> float:
        return float(seconds - travel_time(way, speed, self.limits).max())


def predict_flight(seen: list[tuple[float, Array]], now: float) -> tuple[Array, Array, Array]:
    """Times [K], positions [K, 3] and velocities [K, 3] every 5 ms from now on, of a ball that was seen.

    Least squares of position and velocity at the middle of what was seen, with gravity, and with the drag of the
    fit before.
    """
    t = np.array([time for time, _ in seen])
    p = np.stack([position for _, position in seen])
    middle = t.mean()
    s = t - middle
    design = np.stack([np.ones_like(s), s], axis=-1)
    fall = np.zeros_like(p)
    pull = np.array([0.0, 0.0, -GRAVITY])
    start = np.zeros((2, 3))
    for _ in range(3):
        speed = start[1]
        acceleration = pull - DRAG * np.linalg.norm(speed) * speed
        fall = 0.5 * s[:, None] ** 2 * acceleration
        start = np.linalg.lstsq(design, p - fall, rcond=None)[0]
    position, velocity, h = start[0], start[1], 0.005
    times, path, velocities = [], [], []
    moment = middle
    while moment < now + 1.5 and position[2] > 0.2:
        acceleration = pull - DRAG * np.linalg.norm(velocity) * velocity
        position = position + h * velocity + 0.5 * h**2 * acceleration
        velocity = velocity + h * acceleration
        moment += h
        if moment >= now:
            times.append(moment)
            path.append(position)
            velocities.append(velocity)
    return np.array(times), np.array(path).reshape(-1, 3), np.array(velocities).reshape(-1, 3)
