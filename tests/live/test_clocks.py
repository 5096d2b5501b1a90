"""Clocks that lie: one stamp moves nobody, jumps are named, and taken out when that was asked for."""

from __future__ import annotations

import math

import pytest
import torch

from tests.live.test_session import DT, Sample, everything, live, same, samples
from torch_ebip import InteractionSession

EPOCH = 1_790_000_000.0
SENSORS = ("hand", "gaze")


def pushed(session: InteractionSession, stream: list[Sample], polled: bool = False) -> InteractionSession:
    """All of a stream; asked without a time after each sample, if so."""
    for sensor, value, moment in stream:
        session.push(sensor, value, EPOCH + moment)
        if polled:
            session.forecast(0.1)
    return session


def jumping(size: float, sensors: tuple[str, ...] = SENSORS, from_tick: int = 13) -> list[Sample]:
    """What some sensors measured, their clocks off from a tick on."""
    return [(s, v, t + size * (s in sensors and t > (from_tick - 0.5) * DT)) for s, v, t in samples()]


@pytest.mark.parametrize("polled", [False, True])
@pytest.mark.parametrize("ahead", [0.5, 2.0, 9.0, 1e6])
@pytest.mark.parametrize("tick", [1, 5, 14])
def test_one_stamp_ahead_moves_nobodys_present(ahead: float, tick: int, polled: bool) -> None:
    """One sample of each sensor, at the same moment: the session is as if these two were missing."""
    wrong = [(s, v, t + ahead * (round(t / DT) == tick)) for s, v, t in samples()]
    without = [sample for sample in samples() if round(sample[2] / DT) != tick]
    session, clean = pushed(live(), wrong, polled), pushed(live(), without, polled)
    assert session.forecast(0.1).time == clean.forecast(0.1).time
    assert same(everything(session, EPOCH + 0.8), everything(clean, EPOCH + 0.8))
    report = session.report()
    assert (report["hand"].early, report["hand"].late, report["gaze"].late) == (1, 0, 0)
    assert not report.notes


@pytest.mark.parametrize("size", [2.0, -0.5])
def test_a_jump_of_all_clocks_is_named(size: float) -> None:
    report = pushed(live(), jumping(size), polled=True).report()
    assert report["hand"].jumps == 1
    assert report["hand"].jumped == pytest.approx(size, abs=DT)
    assert any(f"hand: its clock jumped once, by {size:+.2f} s" in note for note in report.notes)
    session = pushed(live(), jumping(size), polled=True)
    assert session.forecast().notes == report.notes
    session.restart()
    assert session.report()["hand"].jumps == session.report()["hand"].backwards == 0
    assert not session.report().notes


@pytest.mark.parametrize("size", [2.0, -0.5])
@pytest.mark.parametrize("told", [False, True])
def test_a_jump_is_taken_out_when_asked_for(size: float, told: bool) -> None:
    """With the robot's own clock or without: what is left is the tick in which it happened."""
    session, clean = live(correct_clocks=True), live()
    for (sensor, value, moment), (_, _, stamp) in zip(samples(), jumping(size), strict=True):
        session.push(sensor, value, EPOCH + stamp)
        clean.push(sensor, value, EPOCH + moment)
        if told:
            session.advance(EPOCH + moment)
    one, other = session.forecast([0.1, 5.0], EPOCH + 0.8), clean.forecast([0.1, 5.0], EPOCH + 0.8)
    assert one.phase == pytest.approx(other.phase, abs=0.03)
    assert bool(((one.mean - other.mean).abs() < 4 * other.deviation + 0.02).all())
    assert session.report()["hand"].jumps == 1


@pytest.mark.parametrize("told", [False, True])
def test_a_sensor_whose_clock_jumps_alone_is_refused_and_named(told: bool) -> None:
    session, without = live(), live()
    for sensor, value, moment in jumping(2.0, ("gaze",)):
        session.push(sensor, value, EPOCH + moment)
        if sensor == "hand" or moment < 1.0:
            without.push(sensor, value, EPOCH + moment)
        if told and sensor == "hand":
            session.advance(EPOCH + moment)
            without.advance(EPOCH + moment)
    assert same(everything(session, EPOCH + 0.8), everything(without, EPOCH + 0.8))
    report = session.report()
    assert report["gaze"].early == 12
    assert [note for note in report.notes if note.startswith("gaze: its clock jumped")]
    assert "gaze" in session.forecast(0.1).stale


@pytest.mark.parametrize("apart", [0.0, -1.0, 0.2])
def test_a_gap_in_which_now_went_on_is_a_gap(apart: float) -> None:
    """The robot's clock tells it from a jump, also where it is another one: nothing is noted, and nothing refused."""
    session = live()
    for sensor, value, moment in samples():
        later = moment + 0.5 * (moment > 12.5 * DT)
        session.advance(EPOCH + later + apart)
        session.push(sensor, value, EPOCH + later)
    report = session.report()
    assert report["hand"].accepted == 25
    assert (report["hand"].jumps, report["hand"].early) == (0, 0)


def test_slow_and_single_sensors_are_believed() -> None:
    """At 2 Hz every step is longer than the window."""
    session = live(sensors=["hand"], longest_gap=100.0)
    for i in range(12):
        session.push("hand", (0.1, 0.1 + 0.01 * i), EPOCH + 0.5 * i)
    report = session.report()
    assert report["hand"].accepted == 12
    assert not report.notes


def test_a_known_delay_is_taken_off() -> None:
    session, clean = live(delays={"hand": 0.1}), live()
    for sensor, value, moment in samples():
        session.push(sensor, value, 10.0 + moment + (0.1 if sensor == "hand" else 0.0))
        clean.push(sensor, value, 10.0 + moment)
    one, other = everything(session, 10.8), everything(clean, 10.8)
    assert torch.allclose(one[0], other[0], atol=1e-4)
    with pytest.raises(ValueError, match="delays name nose; the sensors are hand, gaze"):
        live(delays={"nose": 0.1})
    with pytest.raises(ValueError, match="delays of 'hand' must be a finite number"):
        live(delays={"hand": math.nan})
    with pytest.raises(ValueError, match="correct_clocks must be True or False, got 'maybe'"):
        live(correct_clocks="maybe")


def test_a_start_long_before_the_first_sample_is_noted() -> None:
    """All sensors stamped on arrival, half a second late, and a start that is right."""
    session = live(start=EPOCH)
    for sensor, value, moment in samples():
        session.push(sensor, value, EPOCH + moment + 0.5)
    assert [note for note in session.forecast().notes if "0.50 s after the start" in note]


def test_now_that_runs_backwards_is_noted() -> None:
    session = pushed(live(), samples())
    session.advance(EPOCH + 0.8)
    assert session.forecast(0.1, EPOCH + 0.3).time == EPOCH + 0.8
    assert session.report().notes == ("now was 0.500 s before what it had been; the present does not run backwards",)


def test_a_window_shorter_than_a_sensor_is_late_is_noted() -> None:
    session = live(window=0.1, start=0.0)
    for k in range(80):
        session.push("gaze", (0.1,), k * DT)
        session.push("hand", (0.1, 0.1 + 1e-3 * k), (k - 9) * DT)
        session.advance(k * DT)
    assert [note for note in session.report().notes if "hand: " in note and "choose a longer window" in note]
