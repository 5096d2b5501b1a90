"""A queue in front of the filter: nobody who pushes waits, and a session is used by whom it belongs to."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.live.test_session import DT, SENSORS, everything, filters, live, primitive, same, samples
from torch_ebip import replay
from torch_ebip.live.arrivals import MOST_WAITING


def test_push_does_not_wait_for_who_filters() -> None:
    """Somebody holds the session for as long as it takes: a push returns all the same, and is not lost."""
    session = live()
    held, done = threading.Event(), threading.Event()

    def hold() -> None:
        with session._lock:
            held.set()
            done.wait(60)

    thread = threading.Thread(target=hold)
    thread.start()
    assert held.wait(60)
    feeder = threading.Thread(target=lambda: [session.push(*sample) for sample in samples()])
    feeder.start()
    feeder.join(30)
    waited = feeder.is_alive()
    done.set()
    thread.join()
    feeder.join()
    assert not waited
    assert session.report()["hand"].accepted == 25


def test_a_session_that_nobody_asks_keeps_no_more_than_so_many_samples() -> None:
    session, asked = live(), live()
    for k in range(2 * MOST_WAITING):
        for one in (session, asked):
            one.push("hand", (0.1, 0.1 + 1e-5 * k), 0.8 * k / (2 * MOST_WAITING))
    assert len(session._arrivals) <= MOST_WAITING + 1
    assert same(everything(session, 0.8), everything(asked, 0.8))


def test_a_closed_session_is_refused_and_still_reports() -> None:
    with live() as session:
        for sample in samples():
            session.push(*sample)
    assert session.report()["hand"].accepted == 25
    calls: list[Any] = [lambda: session.push("hand", (0.1, 0.1), 0.9), session.forecast, session.advance]
    for call in [*calls, session.restart]:
        with pytest.raises(RuntimeError, match="closed; make a new one"):
            call()
    session.close()


def test_a_session_is_not_copied() -> None:
    for way in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match="one interaction at work and is not copied"):
            way(live())


def _in_child(session: Any, answers: Any) -> None:
    said = []
    for call in (session.forecast, lambda: session.push("hand", (0.1, 0.1), 0.0), session.restart, session.advance):
        try:
            call()
        except RuntimeError as error:
            said.append(str(error))
    session.close()
    answers.put(said)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_fork_is_told_to_make_its_own(tmp_path: Path) -> None:
    session = live(record=tmp_path / "log.jsonl")
    session.push(*samples()[0])
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    with session._lock:  # whoever holds it is not there in the child: nobody may wait for it
        child = context.Process(target=_in_child, args=(session, answers))
        child.start()
    said = answers.get(timeout=60)
    child.join(60)
    assert child.exitcode == 0
    assert len(said) == 4
    assert all("belongs to process" in error for error in said)
    session.forecast(0.1)
    session.close()
    assert replay(tmp_path / "log.jsonl", filters()["ebip with options"], primitive()).identical


@pytest.mark.parametrize("name", filters())
def test_after_a_restart_a_session_is_a_new_one(name: str) -> None:
    session, fresh = live(name), live(name)
    for sensor, value, moment in samples(index=0):
        session.push(sensor, value, moment)
    session.forecast()
    session.push("hand", (0.3, 0.3), 0.81)  # waits in the queue: of the interaction before
    session.restart()
    late = samples(index=0)[-1]
    session.push(late[0], late[1], late[2] - 0.05)  # arrives after it is over, and does not begin the next
    for one in (session, fresh):
        for sensor, value, moment in samples():
            one.push(sensor, value, 5.0 + moment)
    assert same(everything(session, 5.8), everything(fresh, 5.8))
    assert session.report()["hand"].accepted == fresh.report()["hand"].accepted == 25
    session.restart(20.0)
    assert session.forecast(0.1, 20.0).phase == pytest.approx(0.0, abs=0.05)
    with pytest.raises(ValueError, match="start must be"):
        session.restart("soon")


def test_an_interaction_says_when_it_is_over() -> None:
    """Not before its last tenth; and what comes after is not the next one until somebody says so."""
    session = live("ebip")
    stream = samples(length=10_000)
    finished = []
    for sensor, value, moment in stream:
        session.push(sensor, value, moment)
        finished.append(session.forecast().finished)
    end = stream[-1][2]
    assert not any(over for over, (_, _, moment) in zip(finished, stream, strict=True) if moment < 0.9 * end)
    told = [session.forecast(now=end + k * DT) for k in range(1, 8)][-1]
    assert told.finished
    assert told.time_to_end == 0.0
    assert [note for note in told.notes if "the interaction ended at" in note]
    session.restart()
    assert not session.forecast().finished
    assert not session.forecast().notes


def test_what_is_always_late_costs_a_few_ticks_and_changes_nothing() -> None:
    """A sensor nine ticks late: with each tick three others are repeated, not nine; in the end all is the same."""
    session, in_time = live(window=0.5), live(window=0.5)
    spent = []
    for k in range(100):
        hand, gaze = (0.1, 0.1 + 1e-3 * k), (0.1 + 2e-3 * k,)
        in_time.push("hand", hand, k * DT)
        in_time.push("gaze", gaze, k * DT)
        session.push("hand", hand, k * DT)
        if k >= 9:
            session.push("gaze", (0.1 + 2e-3 * (k - 9),), (k - 9) * DT)
        before = session.ticks_filtered
        session.forecast(0.1, k * DT)
        spent.append(session.ticks_filtered - before)
    assert max(spent[50:]) <= 4
    assert max(spent[10:30]) >= 9  # before that was known
    assert session.report()["gaze"].lateness == pytest.approx(9 * DT, abs=1e-6)
    assert [note for note in session.report().notes if "gaze: its samples come 0.30 s late" in note]
    for k in range(91, 100):
        session.push("gaze", (0.1 + 2e-3 * k,), k * DT)
    assert same(everything(session, 99 * DT), everything(in_time, 99 * DT))


acts = st.lists(
    st.tuples(
        st.sampled_from(["push", "push", "push", "forecast", "advance", "report", "restart", "told"]),
        st.sampled_from(list(SENSORS)),
        st.sampled_from([0.0, 0.0, 0.0, -0.2, 2.0, -5.0]),
        st.floats(-2.0, 2.0),
    ),
    max_size=60,
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(acts=acts, corrected=st.booleans())
def test_whatever_happens_replays_to_the_bit(tmp_path_factory: Any, acts: Any, corrected: bool) -> None:
    path = tmp_path_factory.mktemp("log") / "log.jsonl"
    session = live("ebip", record=path, correct_clocks=corrected)
    time = 100.0
    for act, sensor, off, value in acts:
        if act == "push":
            time += DT / 2
            session.push(sensor, [value] * (SENSORS[sensor].stop - SENSORS[sensor].start), time + off)
        elif act == "report":
            session.report()
        elif act == "restart":
            session.restart()
        else:
            now = None if act == "forecast" else time
            with suppress(ValueError):  # further ahead than the longest gap
                session.forecast([0.1, 0.5], now) if act != "advance" else session.advance(now)
    last, report = session.forecast([0.0, 0.3]), session.report()
    session.close()
    again = replay(path, filters()["ebip"], primitive())
    assert again.identical
    assert torch.equal(again.forecasts[-1].mean, last.mean)
    assert torch.equal(again.forecasts[-1].deviation, last.deviation)
    assert again.session.report() == report
    assert again.session.report().notes == report.notes
