"""Throws to be caught: what the ball will do, what each sensor will say and when it will have said it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.ball_catching import flight as ballistics
from experiments.ball_catching import sensors, thrower
from experiments.ball_catching.geometry import DISTANCE, RATE, TABLE_HEIGHT, Array
from experiments.ball_catching.hesitation import hesitating
from experiments.ball_catching.scene import Limits, Reach, travel_time
from experiments.ball_catching.sensors import LAYOUT
from experiments.ball_catching.teacher import HABITS, LOWEST

CONDITIONS = ("aimed", "blindfolded")
LATENCY = {
    "hands": 0.006,
    "feet": 0.006,
    "imu_acceleration": 0.008,
    "imu_gyro": 0.008,
    "shoe_left": 0.012,
    "shoe_right": 0.012,
    "head": 0.008,
    "ball": 0.016,
}
"""s from a sample to its arrival: motion capture, radio links, a depth camera with its image processing."""
DISTURBANCES = ("hesitate", "late")
"""A thrower who stops in the wind-up; sensors that start when the throw is under way."""
LATE = (0.2, 0.5)
"""Shares of the way to the release, between which sensors start that do so late."""
JITTER = 0.003
"""s, mean of what comes on top, exponentially distributed."""
OUTSTRETCHED = 1.12
"""m, from the arm's base to the box's centre, nearly stretched: further away nobody tries to catch."""


@dataclass(frozen=True)
class Packet:
    """One sample of one sensor: `values` [k] in its units, taken at `time`, there at `arrival`, s."""

    arrival: float
    time: float
    sensor: str
    values: Array


@dataclass(frozen=True)
class Toss:
    """One throw. Times in seconds since the interaction began.

    Attributes:
        number: of the throw, for seeds.
        release: when the ball leaves the hand; `position` [3] m and `velocity` [3] m/s there.
        end: when the ball has passed the robot or is on the floor.
        packets: everything the sensors send, by arrival.
        hand: [K, 3] m, the throwing hand at `times` [K], for pictures; `figure` [K, P, 3] the other points.
        catchable: whether the arm could have caught it, had it set out at the release knowing all (see `catchable`).
    """

    number: int
    style: str
    release: float
    position: Array
    velocity: Array
    end: float
    packets: list[Packet]
    times: Array
    hand: Array
    figure: Array
    catchable: bool


def draw(
    condition: str, count: int, seed: int, limits: Limits | None = None, disturbance: str | None = None
) -> list[Toss]:
    """Throws of a condition: ``count`` of them, fixed by the seed; a longer series begins with the shorter one.

    Args:
        condition: one of `CONDITIONS`.
        count: how many.
        seed: of everything about them.
        limits: of the arm, for what is catchable.
        disturbance: one of `DISTURBANCES`, of every second throw; None: of none.
    """
    limits = Limits() if limits is None else limits
    made: list[Toss] = []
    reach, batch = Reach(), 0
    while len(made) < count:
        rng = np.random.default_rng([seed, CONDITIONS.index(condition), batch, 5])
        made += _batch(rng, condition == "blindfolded", reach, len(made), limits, disturbance)
        batch += 1
    return made[:count]


def _batch(
    rng: np.random.Generator,
    blindfolded: bool,
    reach: Reach,
    first: int,
    limits: Limits,
    disturbance: str | None = None,
    n: int = 50,
) -> list[Toss]:
    throw = thrower.plan(rng, n, blindfolded)
    # Draws of their own: the throws are otherwise the same.
    other = np.random.default_rng([first, int(blindfolded), 23])
    if disturbance == "hesitate":
        throw = hesitating(other, throw)
    silent = np.where(np.arange(n) % 2 == 1, other.uniform(*LATE, n), 0.0) if disturbance == "late" else np.zeros(n)
    hand = throw.body(throw.release[:, None]).right_hand
    flight = ballistics.fly(hand.p[:, 0], hand.v[:, 0], 2.0)
    t = np.arange(int((throw.release.max() + 2.0) * RATE)) / RATE * np.ones((n, 1))
    since = t - throw.release[:, None]
    body = throw.body(t)
    ball = np.where((since < 0)[..., None], body.right_hand.p, flight.at(since))
    truth = sensors.exact(rng, throw, t, ball, np.zeros((n, t.shape[1], 6)))
    gone = (flight.position[..., 0] > DISTANCE + 0.5) | (flight.position[..., 2] < 0.2)
    end = throw.release + gone.argmax(axis=1) * ballistics.STEP
    seen = throw.release + rng.uniform(0.01, 0.06, n)
    feet = throw.feet(t)
    figure = np.stack([body.left_hand.p, body.head, feet[0].q, feet[1].q, body.trunk.p], axis=2)
    tosses = []
    for i in range(n):
        length = min(int(end[i] * RATE) + 1, t.shape[1])
        values = sensors.measure(rng, truth[i, :length], int((t[i, :length] < seen[i]).sum()))
        tosses.append(
            Toss(
                first + i,
                thrower.STYLES[throw.style[i]].name,
                float(throw.release[i]),
                flight.position[i, 0],
                flight.velocity[i, 0],
                float(end[i]),
                _packets(rng, values, float(silent[i] * throw.release[i])),
                t[i, :length],
                body.right_hand.p[i, :length],
                figure[i, :length],
                catchable(flight, i, reach, limits),
            )
        )
    return tosses


def _packets(rng: np.random.Generator, values: Array, silent: float) -> list[Packet]:
    """Samples [T, D] of all sensors at `RATE`, as they arrive, from ``silent`` s on; what was not measured is not
    sent."""
    packets = []
    for name, latency in LATENCY.items():
        part = values[:, LAYOUT.slice(name)]
        delays = latency + rng.exponential(JITTER, len(part))
        for k, (sample, delay) in enumerate(zip(part, delays, strict=True)):
            if not np.isnan(sample).all() and k / RATE >= silent:
                packets.append(Packet(k / RATE + delay, k / RATE, name, sample))
    return sorted(packets, key=lambda packet: packet.arrival)


def catchable(flight: ballistics.Flight, index: int, reach: Reach, limits: Limits) -> bool:
    """Whether some posture holds the box in the ball's way, open towards it, and can be reached in time.

    In time: from the usual waiting posture, within the arm's limits, setting out when the ball is released. Who knows
    earlier where the ball will go has more.
    """
    ready = np.array(HABITS[0].ready)
    start = ready
    for k in range(24, flight.position.shape[1], 6):  # every 25 ms from a tenth of a second on
        point, velocity = flight.position[index, k], flight.velocity[index, k]
        offset = point - np.array([DISTANCE, 0.0, TABLE_HEIGHT])
        if np.linalg.norm(offset) > OUTSTRETCHED or point[2] < LOWEST or offset[0] > 0.3:
            continue
        posture = reach.solve(point, -velocity / np.linalg.norm(velocity), start, ready)
        start = posture.joints
        needed = travel_time(posture.joints - ready, np.zeros(6), limits).max()
        if posture.miss < 0.02 and posture.turn < 0.5 and needed < k * ballistics.STEP:
            return True
    return False
