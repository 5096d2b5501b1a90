"""What time it is, from the stamps of several sensors, any of which may be wrong.

A stamp that is far ahead of every other waits until the sensor's next ones bear it out: one that is wrong moves
nobody's present. A sensor whose stamps stay ahead while others go on as before has a clock that jumped; where all of
them do, either their clocks jumped or nothing came for a while: only ``now``, or who asked for corrections, can tell.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import median

from torch_ebip.live.intake import Sample
from torch_ebip.live.report import SensorReport

BORNE_OUT = 3
"""Samples in succession that make one far ahead believable, the first included."""
GOES_ON = 2
"""Samples of another sensor that show meanwhile that time goes on as before."""
SET_BACK = 5
"""Samples in succession, each after the last and all before one that came earlier, that show a clock set back."""
MOST_HELD = 64
"""Samples that wait for ``now`` to say whether a clock jumped."""
RECENT = 31
"""Samples over which the usual step and the lateness are taken."""
SOMETIMES = 8
"""Samples after which the usual step is looked at again."""
SLACK = 3.0
"""Usual steps by which samples may lie apart."""


@dataclass
class SensorClock:
    """The stamps of one sensor.

    Attributes:
        offset: subtracted from its stamps, s.
        usual: seconds between its samples; 0 before that is known.
        newest: of its stamps that were believed, corrected; minus infinity before the first.
        told: what the robot had said last that time was by then, s.
        last: the stamp that arrived last, as it was.
        steps: between successive ones, s.
        lags: how long before the newest of all it was, on arrival, s.
        held: samples far ahead, waiting.
        others: how many samples of each sensor had been believed when the first of them came.
        asked: how often the robot had said what time it is by then.
        expected: what the first of them would have been stamped, s.
        returning: stamps well before ``newest``, in succession.
        taken: how many samples were believed.
        backwards: how many stamps lay before the one that had arrived last.
        jumps: how often its clock jumped, or nothing came for as long.
        jump: by how much the last time, s.
        at: when that was, s.
    """

    offset: float = 0.0
    usual: float = 0.0
    newest: float = -math.inf
    told: float = -math.inf
    last: float = -math.inf
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    lags: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    held: list[Sample] = field(default_factory=list)
    others: list[int] = field(default_factory=list)
    asked: int = 0
    expected: float = math.nan
    returning: list[Sample] = field(default_factory=list)
    taken: int = 0
    backwards: int = 0
    jumps: int = 0
    jump: float = 0.0
    at: float = math.nan

    def step(self, seconds: float) -> None:
        """It said something so long after the last time."""
        self.steps.append(seconds)
        # A median costs as much as all else that is done to a sample: it is not taken anew each time.
        if len(self.steps) > 1 and (len(self.steps) < SOMETIMES or self.taken % SOMETIMES == 0):
            self.usual = median(self.steps)

    @property
    def lateness(self) -> float:
        """Seconds that each of its latest samples was late at least; 0 before that is known."""
        return max(min(self.lags), 0.0) if len(self.lags) == RECENT else 0.0

    def reported(self, report: SensorReport) -> SensorReport:
        """A report with what is known of the clock."""
        return replace(
            report, early=report.early + len(self.held), backwards=self.backwards, jumps=self.jumps, jumped=self.jump,
            lateness=self.lateness,
        )  # fmt: skip


class Clocks:
    """The clocks of all sensors of a session.

    Args:
        dt: seconds between ticks.
        reach: seconds by which samples of different sensors may lie apart.
        corrected: whether jumps are taken out of the stamps.
        delays: seconds by which the stamps of each sensor are later than what they are stamps of.
    """

    def __init__(self, dt: float, reach: float, corrected: bool, delays: Sequence[float]) -> None:
        self._dt, self._reach, self.corrected, self._delays = dt, reach, corrected, tuple(delays)
        self.sensors = [SensorClock(delay) for delay in delays]
        self._newest = self._told = -math.inf
        self._asked = 0
        self._refused: list[Sample] = []

    def forget(self, offsets: bool = False) -> None:
        """What comes next may be stamped anything; with ``offsets``, clocks are taken as they are again."""
        self._newest = self._told = -math.inf
        for clock, delay in zip(self.sensors, self._delays, strict=True):
            clock.newest = clock.last = clock.told = -math.inf
            clock.held, clock.returning = [], []
            clock.backwards = clock.jumps = 0
            if offsets:
                clock.offset = delay
                clock.lags.clear()

    def admit(self, sample: Sample) -> list[Sample]:
        """The samples that can be believed now that this one came, on corrected clocks; most often this one alone."""
        if sample.values is None:  # says nothing of the time either
            return [sample]
        clock = self.sensors[sample.number]
        clock.backwards += sample.time < clock.last
        clock.last = sample.time
        if clock.offset:
            sample = sample._replace(time=sample.time - clock.offset)
        if sample.time > self._ahead(clock):
            return [*self._released(clock), *self._hold(clock, sample)]
        caught_up = self._caught_up(clock)
        if clock.held:  # what waited was wrong
            self._refuse(clock)
        if sample.time < clock.newest - SLACK * max(clock.usual, self._dt):
            return [*caught_up, *self._return(clock, sample)]
        return [*caught_up, *self._released(clock), *self._believe(clock, [sample])]

    def believe(self, sample: Sample) -> None:
        """A sample on a corrected clock that needs nobody to bear it out."""
        self._believe(self.sensors[sample.number], [sample])

    def tell(self, now: float) -> list[Sample]:
        """The robot says what time it is, s; samples that waited for that, and are not ahead of it."""
        self._told = max(self._told, now)
        self._asked += 1
        return [sample for clock in self.sensors for sample in self._caught_up(clock)]

    def refused(self) -> list[Sample]:
        """Samples that turned out wrong since this was asked last."""
        refused, self._refused = self._refused, []
        return refused

    @property
    def _present(self) -> float:
        return max(self._newest, self._told)

    def _ahead(self, clock: SensorClock) -> float:
        """The latest stamp that nobody needs to bear out."""
        present = self._present
        if clock.told > -math.inf:  # the robot's clock may be another one: it is how far it went on that counts
            present = max(present, clock.newest + self._told - clock.told)
        return math.inf if present == -math.inf else present + max(self._reach, SLACK * clock.usual)

    def _believe(self, clock: SensorClock, samples: list[Sample]) -> list[Sample]:
        for sample in samples:
            if self._present > -math.inf:
                clock.lags.append(self._present - sample.time)
            clock.taken += 1
            if sample.says and sample.time > clock.newest:
                if clock.newest > -math.inf:
                    clock.step(sample.time - clock.newest)
                clock.newest, clock.told = sample.time, self._told
                self._newest = max(self._newest, sample.time)
        return samples

    def _caught_up(self, clock: SensorClock) -> list[Sample]:
        """What waited and is ahead no longer, because others are as far by now."""
        if not clock.held or clock.held[0].time > self._ahead(clock):
            return []
        held, clock.held = clock.held, []
        return self._believe(clock, held)

    def _refuse(self, clock: SensorClock) -> None:
        self._refused += clock.held
        clock.held = []

    def _hold(self, clock: SensorClock, sample: Sample) -> list[Sample]:
        """Keep a sample that is far ahead; those that are borne out by now."""
        if not clock.held:
            clock.others = [other.taken for other in self.sensors]
            clock.asked = self._asked
            clock.expected = max(clock.newest + clock.usual, self._present)
        clock.held.append(sample)
        if len(clock.held) < BORNE_OUT:
            return []
        alone, jumped = self._alone(clock), False
        if alone is None and len(clock.held) < MOST_HELD:
            return []
        if self._told > -math.inf:
            # What came before the robot said what time it is was not taken after that.
            jumped = self._asked > clock.asked
            if not (alone or jumped) and len(clock.held) < MOST_HELD:
                return []
        size = clock.held[0].time - clock.expected
        self._note(clock, size, sure=bool(alone) or jumped)
        if self.corrected:
            held, clock.held = clock.held, []
            return self._shift(clock, held, size)
        if alone or jumped:
            self._refuse(clock)
            return []
        held, clock.held = clock.held, []
        return self._believe(clock, held)

    def _alone(self, clock: SensorClock) -> bool | None:
        """Whether another sensor goes on as before while this one is ahead; None if none of them had time to say."""
        span = clock.held[-1].time - clock.held[0].time
        waiting = False
        for other, before in zip(self.sensors, clock.others, strict=True):
            if other is clock or other.held or other.newest == -math.inf:
                continue
            if other.taken - before >= GOES_ON:
                return True
            waiting |= span < SLACK * max(other.usual, self._dt)
        return None if waiting else False

    def _return(self, clock: SensorClock, sample: Sample) -> list[Sample]:
        """A sample that was taken well before one that came earlier: late, or of a clock that was set back."""
        step = sample.time - clock.returning[-1].time if clock.returning else self._dt
        released = [] if 0 < step <= SLACK * max(clock.usual, self._dt) else self._released(clock)
        clock.returning.append(sample)
        if len(clock.returning) == SET_BACK:
            size = clock.returning[0].time - (clock.newest + clock.usual)
            self._note(clock, size, sure=True)
            if self.corrected:
                back, clock.returning = clock.returning, []
                return [*released, *self._shift(clock, back, size)]
        if self.corrected:
            return released
        clock.lags.append(self._present - sample.time)
        clock.taken += 1
        return [sample]

    def _released(self, clock: SensorClock) -> list[Sample]:
        """What was thought to be of a clock that was set back, and was late only."""
        late, clock.returning = clock.returning, []
        return late if self.corrected else []

    def _note(self, clock: SensorClock, size: float, sure: bool) -> None:
        """A jump; as long as stamps stay off by as much it is the same one."""
        if not sure and not clock.usual:  # nobody knows yet how often it has something to say
            return
        if clock.jumps and not self.corrected and abs(clock.jump - size) <= max(self._reach, SLACK * self._dt):
            return
        clock.jumps += 1
        clock.jump, clock.at = size, clock.newest

    def _shift(self, clock: SensorClock, samples: list[Sample], size: float) -> list[Sample]:
        clock.offset += size
        return self._believe(clock, [sample._replace(time=sample.time - size) for sample in samples])
