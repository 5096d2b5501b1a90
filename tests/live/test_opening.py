"""How a session begins: at the first sample, whatever arrives first, on any clock that counts seconds."""

import itertools
import math
import time

import numpy as np
import pytest
import torch

from tests.live.test_session import DT, everything, live, same, samples
from torch_ebip import InteractionSession

EPOCH = 1_790_000_000.25
"""Seconds since 1970."""


def pushed(session: InteractionSession, stream: list[tuple[str, tuple[float, ...], float]], shift: float) -> None:
    for sensor, value, moment in stream:
        session.push(sensor, value, moment + shift)


def test_an_epoch_clock_gives_what_a_clock_from_zero_gives() -> None:
    near, far = live(), live()
    pushed(near, samples(), 0.0)
    pushed(far, samples(), EPOCH)
    one, other = near.forecast([0.1, 0.3], 0.8), far.forecast([0.1, 0.3], EPOCH + 0.8)
    assert torch.allclose(one.mean, other.mean, atol=1e-5)
    assert other.phase == pytest.approx(one.phase, abs=1e-5)
    assert far.report()["hand"].early == 0
    assert far.report()["hand"].accepted == near.report()["hand"].accepted


def test_before_the_first_sample_the_prior_is_told() -> None:
    session = live()
    asked = session.forecast(now=5.0)
    assert (asked.phase, asked.time, asked.stale) == (0.0, 5.0, session.sensors)
    assert bool(asked.mean.isfinite().all())
    pushed(session, samples(), 300.0)  # nobody said that it would begin at once
    fresh = live()
    pushed(fresh, samples(), 300.0)
    assert same(everything(session, 300.8), everything(fresh, 300.8))


@pytest.mark.parametrize("asking", [False, True])
def test_within_the_window_the_order_of_arrival_does_not_matter(asking: bool) -> None:
    """Also where a forecast was asked for between, on the start that was true until then."""
    stream = samples()
    opening = stream[:3]
    assert opening[-1][2] - opening[0][2] < 0.25
    reference = live()
    pushed(reference, stream, 7.0)
    expected = everything(reference, 7.8)
    for order in itertools.permutations(opening):
        session = live()
        for sensor, value, moment in [*order, *stream[3:]]:
            session.push(sensor, value, moment + 7.0)
            if asking:
                session.forecast(now=None)
        assert same(everything(session, 7.8), expected)


def test_what_says_nothing_does_not_begin_an_interaction() -> None:
    session, clean = live(), live()
    session.push("hand", (math.nan, math.nan), 1.0)
    session.push("hand", (1e9, 1e9), 2.0)
    session.push("hand", None, 2.5)
    session.push("hand", (0.1, 0.1), math.nan)
    pushed(session, samples(), 100.0)
    pushed(clean, samples(), 100.0)
    assert same(everything(session, 100.8), everything(clean, 100.8))
    report = session.report()["hand"]
    assert (report.nan, report.out_of_range, report.malformed, report.early) == (1, 1, 2, 2)  # they came before it


def test_values_may_be_written_into_after_they_were_pushed() -> None:
    """Drivers use one buffer again and again; the first ones are looked at twice."""
    session, clean = live(), live()
    buffer = np.zeros(2)
    stream = samples()
    first = next(entry for entry in stream if entry[0] == "hand")
    for sensor, value, moment in [(first[0], first[1], first[2] + 0.1), first]:
        buffer[:] = value
        session.push(sensor, buffer, moment)
        clean.push(sensor, value, moment)
        buffer[:] = 1e6
    assert same(everything(session, 0.3), everything(clean, 0.3))


def test_a_time_is_a_start_too_and_other_words_are_not() -> None:
    session = live(start=10.0)
    session.push("hand", (0.1, 0.1), 9.0)
    assert session.report()["hand"].early == 1
    with pytest.raises(ValueError, match="start must be a time in seconds or 'first sample', got 'now'"):
        live(start="now")


@pytest.mark.parametrize(("unit", "many"), [("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)])
@pytest.mark.parametrize("epoch", [0.0, EPOCH])
def test_a_clock_in_other_units_is_refused_with_a_guess(unit: str, many: float, epoch: float) -> None:
    """By `forecast`; `push` never raises."""
    session = live()
    for i in range(8):
        session.push("hand", (0.1, 0.1 + 0.01 * i), (epoch + i * DT) * many)
    with pytest.raises(ValueError, match=f"times seem to be in {unit}; push and ask in seconds"):
        session.forecast(0.1)
    with pytest.raises(ValueError, match="times seem to be in"):
        session.advance((epoch + 8 * DT) * many)


@pytest.mark.parametrize("rate", [2.0, 5.0, 30.0, 60.0])
@pytest.mark.parametrize("many", [1e3, 1e6, 1e9])
def test_sensors_slower_or_faster_than_the_demonstrations_betray_the_unit_too(rate: float, many: float) -> None:
    session = live()
    for i in range(8):
        session.push("hand", (0.1, 0.1 + 0.01 * i), (100.0 + i / rate) * many)
    with pytest.raises(ValueError, match="times seem to be in"):
        session.forecast(0.1)


def test_slow_sensors_and_real_clocks_are_not_taken_for_another_unit() -> None:
    session = live(longest_gap=100.0)
    for i in range(12):
        session.push("hand", (0.1, 0.1 + 0.01 * i), 0.5 * i)
    assert math.isfinite(session.forecast(0.1).phase)
    session = live()
    pushed(session, samples(), time.time())
    assert math.isfinite(session.forecast(0.1).phase)


def test_a_clock_gone_mad_does_not_silence_the_others() -> None:
    """What one sensor says of the time is counted against it; the rest goes on as if it were not there."""
    session, without = live(), live()
    for sensor, value, moment in samples():
        if sensor == "hand":
            without.push(sensor, value, moment + 50.0)
            session.push(sensor, value, moment + 50.0)
            session.push("gaze", (0.1,), 1.7e18 + 1e6 * moment)
            session.push("hand", None, 1e300)
    one, other = session.forecast(0.1), without.forecast(0.1)
    assert torch.equal(one.mean, other.mean)
    assert "gaze" in one.stale
    assert session.report()["gaze"].early > 10


@pytest.mark.parametrize("first", [0.0, EPOCH + 3600.0])
def test_a_first_time_that_is_wrong_is_forgotten(first: float) -> None:
    """A header without a stamp, or one from the future: where the others agree, the interaction began."""
    session, clean = live(), live()
    session.push("hand", (0.1, 0.1), first)
    session.forecast()
    pushed(session, samples(), EPOCH)
    pushed(clean, samples(), EPOCH)
    assert same(everything(session, EPOCH + 0.8), everything(clean, EPOCH + 0.8))


def test_one_wrong_time_later_on_changes_nothing() -> None:
    session, clean = live(), live()
    stream = samples()
    pushed(session, stream[:12], EPOCH)
    for _ in range(20):
        session.push("hand", (0.1, 0.1), 0.0)
    pushed(session, stream[12:], EPOCH)
    pushed(clean, stream, EPOCH)
    assert same(everything(session, EPOCH + 0.8), everything(clean, EPOCH + 0.8))


def test_the_way_is_sampled_at_the_rate_of_a_controller() -> None:
    session = live()
    pushed(session, samples(), 0.0)
    way = session.forecast(now=0.5, rate=125.0)
    end = session.forecast(now=0.5)
    assert way.horizon[0] == pytest.approx(1 / 125)
    assert np.allclose(np.diff(way.horizon)[:-1], 1 / 125)
    assert way.horizon[-1] == pytest.approx(way.time_to_end, abs=1e-6)
    assert torch.allclose(way.mean[-1], end.mean, atol=1e-5)
    one = session.forecast(way.horizon[3], now=0.5)
    assert torch.allclose(way.mean[3], one.mean)
    short = session.forecast(0.1, now=0.5, rate=100.0)
    assert len(short.horizon) == len(short.mean) == 10
    with pytest.raises(ValueError, match="not with several"):
        session.forecast([0.1, 0.2], rate=100.0)
    with pytest.raises(ValueError, match="rate must be a positive number"):
        session.forecast(rate=0.0)
    with pytest.raises(ValueError, match="expected at most 10000"):
        session.forecast(rate=1e9)
