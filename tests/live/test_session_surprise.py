"""A session says whom it does not believe, and never what is far from what was demonstrated."""

from __future__ import annotations

import math
import random

import pytest
import torch

from tests.conftest import interactions, small_primitive
from tests.interaction.surprised import cautious
from torch_ebip import InteractionSession, SessionSettings, bip, ebip, particle_filter, replay
from torch_ebip.interaction.bounds import demonstrated_range

SENSORS = {"hand": slice(0, 2), "gaze": slice(2, 3)}


def samples(gaze: float, length: int = 20) -> list[tuple[str, list[float], float]]:
    """What sensors measured; the gaze lies by so much from the eighth sample to the fourteenth."""
    found = []
    for k, row in enumerate(interactions(3, seed=5)[1][:length].tolist()):
        for name, columns in SENSORS.items():
            lie = gaze if name == "gaze" and 8 <= k < 14 else 0.0
            found.append((name, [value + lie for value in row[columns]], k / 30))
    return found


def honest(primitive, **options):
    return cautious(primitive, above=1.5, residual_variance=100 * primitive.residual_variance, **options)


def test_a_sensor_that_lies_is_named_and_comes_back() -> None:
    primitive = small_primitive()
    states = []
    settings = SessionSettings(margin=50.0)
    with InteractionSession(honest(primitive, square_root=True), primitive, settings=settings) as session:
        for sensor, values, time in samples(4.0, 30):
            session.push(sensor, values, time)
            if sensor == "gaze":
                said = session.forecast(now=time)
                states.append(dict(said.states))
                assert {name: report.state for name, report in session.report().items()} == states[-1]
    assert all(state == {"hand": "ok", "gaze": "ok"} for state in states[:8])
    assert all(state == {"hand": "ok", "gaze": "rejected"} for state in states[9:14])
    assert states[-1] == {"hand": "ok", "gaze": "ok"}
    assert 0 <= said.familiarity <= 1


def test_who_was_rejected_stays_so_until_it_agrees() -> None:
    """Not for being refused as out of range, nor for saying the same again and again, nor for silence."""
    primitive = small_primitive()
    settings = SessionSettings(margin=50.0, frozen_after=0.1)
    with InteractionSession(honest(primitive, square_root=True), primitive, settings=settings) as session:
        for k, row in enumerate(interactions(3, seed=5)[1][:30].tolist()):
            session.push("hand", row[:2], k / 30)
            # True, then off, then where nothing ever was, then off and frozen, then silent, then true.
            wrong = 0.0 if k < 6 or k >= 18 else 1e6 if 8 <= k < 10 else 4.0
            if not 16 <= k < 18:
                session.push("gaze", [7.0 if 10 <= k < 16 else row[2] + wrong], k / 30)
            said = session.forecast(now=k / 30).states["gaze"]
            assert said == ("ok" if k < 6 else "rejected") or k == 6 or k >= 18, k
        assert said == "ok"


def test_who_is_refused_from_the_start_is_not_ok() -> None:
    primitive = small_primitive()
    with InteractionSession(ebip(primitive), primitive) as session:
        for k, row in enumerate(interactions(3, seed=5)[1][:5].tolist()):
            session.push("hand", row[:2], k / 30)
            session.push("gaze", [1e6], k / 30)
        assert session.forecast().states == {"hand": "ok", "gaze": "rejected"}
        session.push("gaze", [row[2]], 0.2)
        assert session.forecast().states == {"hand": "ok", "gaze": "ok"}
        assert session.report()["gaze"].state == "ok"


def test_familiarity_winds_back_with_late_samples_and_replays_to_the_bit(tmp_path) -> None:
    """Whatever the order of arrival, within the window, and from the recording: the same numbers."""
    primitive = small_primitive()
    filter = honest(primitive, square_root=True, weigh=True)
    settings = SessionSettings(margin=50.0, start=0.0, window=0.5)
    said = []
    for seed in range(3):
        order = samples(4.0)
        if seed:  # late by a third of a second at most
            delays = random.Random(seed)
            order.sort(key=lambda sample: sample[2] + delays.uniform(0, 0.3))
        path = tmp_path / f"{seed}.log"
        with InteractionSession(filter, primitive, settings=settings, record=path) as session:
            for k, (sensor, values, time) in enumerate(order):
                session.push(sensor, values, time)
                if k % 5 == 4:
                    session.forecast()
            said.append(session.forecast([0.2, 0.5], now=19 / 30))
        assert replay(path, filter, primitive).identical
    for other in said[1:]:
        assert other.familiarity == said[0].familiarity
        assert other.states == said[0].states
        assert torch.equal(other.mean, said[0].mean)
        assert torch.equal(other.deviation, said[0].deviation)


@pytest.mark.parametrize("make", [ebip, bip, particle_filter])
def test_no_filter_says_in_a_session_what_is_far_from_what_was_shown(make) -> None:
    """A hand that is metres off, in any filter: near the range, and nothing is known of how familiar it is."""
    primitive = small_primitive()
    low, high = demonstrated_range(primitive)
    arm = primitive.layout.controlled
    low, high = low[arm], high[arm]
    with InteractionSession(make(primitive), primitive, settings=SessionSettings(margin=100.0)) as session:
        for k in range(15):
            session.push("hand", [20.0 + k, -30.0 - k], k / 30)
            said = session.forecast([0.1, 1.0, 9.0], now=k / 30)
            width = high - low
            assert bool((said.mean >= low - 0.2501 * width).all())
            assert bool((said.mean <= high + 0.2501 * width).all())
            assert math.isnan(said.familiarity)
            assert dict(said.states) == {"hand": "ok", "gaze": "ok"}
