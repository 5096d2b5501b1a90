"""One throw, one controller: the closed loop, and what came of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from experiments.ball_catching.geometry import RATE, Array
from experiments.ball_catching.scene import World
from experiments.catch.controllers import Controller
from experiments.catch.throws import Toss

ENCODER_NOISE = 0.0002
"""rad, of each joint's measurement."""
NEAR = 0.20
"""m, from its final place: the arm has understood."""
HELD = 1.0
"""s that a ball must stay in the box."""
LONGEST = 3.0
"""s after the release at which a throw is over in any case."""


class Outcome(NamedTuple):
    """What came of a throw.

    Attributes:
        caught: the ball was in the box a second after it touched it.
        touched: it touched the box.
        distance: m, from the ball to the centre of the box at its closest, before it touched anything else.
        ahead: s before the release from which on the box stayed within 20 cm of its final place; negative: after.
        seconds: of each control cycle.
    """

    caught: bool
    touched: bool
    distance: float
    ahead: float
    seconds: list[float]


class Drop(NamedTuple):
    """Sensors that fall silent at a time, a share of the way from the start to the end of the throw."""

    sensors: tuple[str, ...]
    share: float


def run(
    world: World,
    toss: Toss,
    controller: Controller,
    ready: Array,
    drop: Drop | None = None,
    watch: Callable[[World], None] | None = None,
) -> Outcome:
    """Throw, and let the controller catch.

    Args:
        world: the scene; its last throw is forgotten.
        toss: the throw.
        controller: drives the arm until the ball has touched something or passed.
        ready: joints [6], rad, where the arm waits.
        drop: what is cut off.
        watch: called at every control cycle, 60 times a second, until the end; for pictures.
    """
    rng = np.random.default_rng([toss.number, 17])
    world.reset(ready)
    packets, waiting = toss.packets, 0
    released, cycle, closest = False, 0, np.inf
    places: list[tuple[float, Array]] = []
    while world.time < toss.release + LONGEST:
        now = world.time
        if not released and now >= toss.release:
            world.release(toss.position, toss.velocity)
            released = True
        if now >= cycle / RATE - 1e-9:
            if not released:
                world.carry(toss.hand[min(cycle, len(toss.hand) - 1)])
            cycle += 1
            if world.touched is None and now <= toss.end:
                while waiting < len(packets) and packets[waiting].arrival <= now:
                    packet = packets[waiting]
                    waiting += 1
                    cut = drop is not None and packet.sensor in drop.sensors and packet.time > drop.share * toss.end
                    if not cut:
                        controller.push(packet.sensor, packet.values, packet.time)
                goal = controller.command(now, world.joints + rng.normal(0.0, ENCODER_NOISE, 6))
                if goal is not None:
                    world.servo.command(now, goal)
                places.append((now, world.box[0]))
            if watch is not None:
                watch(world)
        world.step()
        if released and (world.touched is None or world.touched == world.touched_box == world.time):
            closest = min(closest, float(np.linalg.norm(world.ball - world.box[0])))
        if world.touched_box is not None and world.time >= world.touched_box + HELD:
            break
        if world.touched_box is None and world.time > toss.end + 0.5:
            break
    final = places[-1][1]
    away = [time for time, place in places if np.linalg.norm(place - final) > NEAR]
    ahead = toss.release - (away[-1] if away else 0.0)
    touched = world.touched_box is not None
    return Outcome(touched and world.holds_ball(), touched, closest, ahead, controller.seconds)
