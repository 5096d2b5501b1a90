"""Sessions under clocks that are wrong: how far off forecasts are, how sure of that, and what is said about it."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from experiments.clocks.cases import Case, Scene, samples
from experiments.soak.watch import resident
from torch_ebip import Demonstrations, InteractionModel, InteractionSession

HORIZON = 0.1
"""Seconds ahead that forecasts are looked at."""
PAUSE = 0.5
"""Seconds between one interaction and the next."""
FAR = 4.0
"""Deviations beyond which a forecast is sure and wrong."""


class Outcome(NamedTuple):
    """Of the second half of an interaction.

    Attributes:
        error: [n], root mean square over controlled DoFs of what was forecast minus what happened, units of the DoFs.
        deviation: [n], root mean square of what it said of itself.
        far: [n], share of DoFs further off than `FAR` of their deviations.
        notes: everything that the session said about time, or its error.
    """

    error: np.ndarray
    deviation: np.ndarray
    far: np.ndarray
    notes: tuple[str, ...]


def outcome(model: InteractionModel, shown: Demonstrations, number: int, case: Case) -> Outcome:
    """One interaction of those shown, with something wrong.

    Args:
        model: that was learned.
        shown: interactions.
        number: of the one that is looked at.
        case: what is wrong.
    """
    sensors = tuple(m.name for m in shown.layout.modalities if not m.controlled)
    said: dict[str, None] = {}
    with model.session(**case.settings) as session:
        begin = 0.0
        for before in range(case.first):
            other = (number + 1 + before) % len(shown)
            play(session, shown, other, case, sensors, begin, said)
            begin += len(shown[other]) / shown.rate + PAUSE
            if case.restarts:
                session.restart()
        return play(session, shown, number, case, sensors, begin, said)


def play(
    session: InteractionSession, shown: Demonstrations, number: int, case: Case, sensors: tuple[str, ...],
    begin: float, said: dict[str, None],
) -> Outcome:  # fmt: skip
    """Show an interaction that begins so many seconds after the first; new notes are added to what was ``said``."""
    layout, values, step = shown.layout, shown[number].double().numpy(), 1 / shown.rate
    controlled, half = layout.controlled.numpy(), len(values) * step / 2
    scene = Scene(sensors, half, step)
    changed = (case.change(sample, scene) for sample in samples(shown, number, sensors))
    waiting = [(sample.arrives, i, sample) for i, sample in enumerate(changed)]
    heapq.heapify(waiting)
    error, deviation, far = [], [], []
    for i in range(len(values)):
        time = i * step
        while waiting and waiting[0][0] <= time + 1e-9:
            sample = heapq.heappop(waiting)[2]
            session.push(sample.sensor, sample.values, case.scale * (case.epoch + begin + sample.stamp))
        now = None if case.now is None else case.scale * (case.epoch + begin + case.now(time, half))
        try:
            told = session.forecast(HORIZON, now)
        except ValueError as refused:
            said.setdefault(f"refused: {refused}")
            continue
        said.update(dict.fromkeys(told.notes))
        said.update(dict.fromkeys(f"{name} is {state}" for name, state in told.states.items() if state != "ok"))
        if time < half or i + round(HORIZON / step) >= len(values):
            continue
        off = told.mean.double().numpy() - values[i + round(HORIZON / step), controlled]
        own = told.deviation.double().numpy()
        error.append(_size(off))
        deviation.append(_size(own))
        far.append(np.mean(np.abs(off) > FAR * own))
    return Outcome(np.array(error), np.array(deviation), np.array(far), tuple(said))


def _size(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def long_session(
    model: InteractionModel, shown: Demonstrations, minutes: float, bar: Callable[[float], object]
) -> dict[str, Any]:
    """One session for so many minutes of interaction time, as fast as it goes, `restart` between interactions.

    Args:
        model: that was learned.
        shown: interactions, shown round and round.
        minutes: how long, on the sensors' clock.
        bar: told how many seconds passed.
    """
    sensors = tuple(m.name for m in shown.layout.modalities if not m.controlled)
    begin, number, forecasts = 0.0, 0, 0
    first: dict[int, np.ndarray] = {}
    track: list[dict[str, float]] = []
    with model.session() as session:
        while begin < 60 * minutes:
            which = number % len(shown)
            result = play(session, shown, which, Case("undisturbed"), sensors, begin, {})
            before = first.setdefault(which, result.error)
            track.append({
                "minutes": begin / 60, "memory": resident(), "error": float(np.mean(result.error)),
                "drift": float(np.abs(result.error - before).max()),
            })  # fmt: skip
            length = len(shown[which]) / shown.rate + PAUSE
            forecasts += len(shown[which])
            begin, number = begin + length, number + 1
            session.restart()
            bar(length)
    return {"interactions": number, "forecasts": forecasts, "track": track}
