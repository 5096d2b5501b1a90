"""Ways in which clocks and their stamps are wrong, as changes to an interaction that is shown sample by sample."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from torch_ebip import Demonstrations

EPOCH = 1_790_000_000.0
"""When an interaction begins, s, on the clock that is right."""
LATE = 0.3
"""Seconds by which stamps on arrival are late."""
SLOW = 0.2
"""Seconds after which a sensor's samples arrive, their stamps right."""


class Sample(NamedTuple):
    """What a sensor says, on the way to a session; times in seconds since the interaction began.

    Attributes:
        taken: when it was measured.
        arrives: when the session has it.
        stamp: when it says that it was measured.
        sensor: whose.
        values: [k], units of the DoFs.
    """

    taken: float
    arrives: float
    stamp: float
    sensor: str
    values: Any


class Scene(NamedTuple):
    """What a change may look at.

    Attributes:
        sensors: their names; the first is singled out.
        half: when clocks jump, s.
        step: between samples, s.
    """

    sensors: tuple[str, ...]
    half: float
    step: float

    @property
    def one(self) -> str:
        """The sensor that is singled out."""
        return self.sensors[0]


Change = Callable[[Sample, Scene], Sample]


def samples(shown: Demonstrations, number: int, sensors: tuple[str, ...]) -> Iterator[Sample]:
    """One interaction, all sensors in step, stamped as taken."""
    values = shown[number]
    parts = {name: values[:, shown.layout.slice(name)].double().numpy() for name in sensors}
    for i in range(len(values)):
        time = i / shown.rate
        for name in sensors:
            yield Sample(time, time, time, name, parts[name][i])


def as_it_is(sample: Sample, scene: Scene) -> Sample:
    """Nothing is wrong."""
    return sample


def jump(sample: Sample, scene: Scene, seconds: float, alone: bool) -> Sample:
    """From half-way on clocks show so much more; of one sensor alone, or of all."""
    jumped = sample.taken >= scene.half and (sample.sensor == scene.one or not alone)
    return sample._replace(stamp=sample.stamp + seconds) if jumped else sample


def on_arrival(sample: Sample, scene: Scene, alone: bool) -> Sample:
    """What says when it was measured is who receives it, later."""
    if alone and sample.sensor != scene.one:
        return sample
    return sample._replace(arrives=sample.arrives + LATE, stamp=sample.stamp + LATE)


def slow(sample: Sample, scene: Scene) -> Sample:
    """One sensor's samples come later, and say when they were taken."""
    return sample._replace(arrives=sample.arrives + SLOW) if sample.sensor == scene.one else sample


def one_ahead(sample: Sample, scene: Scene) -> Sample:
    """The first sample of each sensor after half of the time is stamped two seconds ahead."""
    bad = -1e-9 <= sample.taken - scene.half < scene.step - 1e-9
    return sample._replace(stamp=sample.stamp + 2) if bad else sample


def shaken(sample: Sample, scene: Scene) -> Sample:
    """Stamps of all sensors run back and forth by up to ten milliseconds."""
    of_its_own = zlib.crc32(f"{sample.sensor} {round(sample.taken / scene.step)}".encode())
    return sample._replace(stamp=sample.stamp + np.random.default_rng(of_its_own).uniform(-0.01, 0.01))


@dataclass(frozen=True)
class Case:
    """Something that is wrong.

    Attributes:
        what: in words.
        change: to each sample.
        now: what the robot says that time is, s since the beginning, at a time; None: it does not say.
        settings: of the session.
        epoch: when the interaction begins, s.
        scale: what stamps are multiplied by.
        first: how many interactions are shown before, in the same session.
        restarts: whether it is told where one ends.
        knowable: whether anything in the data can tell.
    """

    what: str
    change: Change = as_it_is
    now: Callable[[float, float], float] | None = lambda time, half: time
    settings: Mapping[str, Any] = field(default_factory=dict)
    epoch: float = EPOCH
    scale: float = 1.0
    first: int = 0
    restarts: bool = False
    knowable: bool = True


def cases(one: str, sensors: tuple[str, ...]) -> list[Case]:
    """All of them, the undisturbed first; ``one`` of the sensors is singled out."""
    found = [
        Case("undisturbed"),
        Case("undisturbed, now not said", now=None),
        Case("the robot's clock is another one", now=lambda time, half: time + 1.0e4),
        Case("stamps before 1970", epoch=-5.0e5),
        Case("stamps in milliseconds", scale=1e3),
    ]
    for seconds in (2.0, -0.5):
        everyone = partial(jump, seconds=seconds, alone=False)
        for text, options in (("", {}), (", corrected", {"correct_clocks": True})):
            by = f"by {seconds:+g} s{text}"
            found += [
                Case(f"all clocks jump {by}, the robot's too", everyone, _jumping(seconds), options),
                Case(f"all clocks jump {by}, now right", everyone, settings=options),
                Case(f"all clocks jump {by}, now not said", everyone, None, options),
                Case(f"{one}'s clock jumps {by}", partial(jump, seconds=seconds, alone=True), settings=options),
            ]
    late, start = partial(on_arrival, alone=False), {"start": EPOCH}
    found += [
        Case(f"all stamped on arrival, {LATE:g} s late", late, knowable=False),
        Case(f"all stamped on arrival, {LATE:g} s late, start given", late, settings=start),
        Case(f"all stamped on arrival, {LATE:g} s late, which is known", late,
             settings={"delays": dict.fromkeys(sensors, LATE), "window": 2 * LATE}),
        Case(f"{one} stamped on arrival, {LATE:g} s late", partial(on_arrival, alone=True)),
        Case(f"{one} stamped on arrival, {LATE:g} s late, which is known", partial(on_arrival, alone=True),
             settings={"delays": {one: LATE}, "window": 2 * LATE}),
        Case(f"{one} arrives {SLOW:g} s late, stamped as taken", slow),
        Case("one sample of each sensor 2 s ahead, now not said", one_ahead, None),
        Case("all stamps shaken by 10 ms", shaken),
        Case("a second interaction, not told", first=1),
        Case("a second interaction, restart", first=1, restarts=True),
        Case("a ninth interaction, restarts", first=8, restarts=True),
    ]  # fmt: skip
    return found


def _jumping(seconds: float) -> Callable[[float, float], float]:
    return lambda time, half: time + (seconds if time >= half else 0.0)
