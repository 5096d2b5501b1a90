"""One live interaction: its state depends on what was measured and when, and on nothing a sensor may do wrong."""

from __future__ import annotations

import copy
import gc
import math
import threading
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.conftest import interactions, small_primitive
from torch_ebip import (
    BSplineBasis,
    Demonstrations,
    Filter,
    InteractionPrimitive,
    InteractionSession,
    Layout,
    Localisation,
    Modality,
    SessionForecast,
    SessionSettings,
    bip,
    ebip,
    particle_filter,
)
from torch_ebip.common.draws import seeded
from torch_ebip.recordings.repeats import longest_repeats

DT = 1 / 30
SENSORS = {"hand": slice(0, 2), "gaze": slice(2, 3)}
Sample = tuple[str, tuple[float, ...], float]


@cache
def primitive() -> InteractionPrimitive:
    return small_primitive()


@cache
def filters() -> dict[str, Filter]:
    options: dict[str, Any] = {"square_root": True, "weigh": True, "inflation": 1.01, "context": BSplineBasis(4)}
    return {
        "ebip": ebip(primitive()),
        "ebip with options": ebip(primitive(), 10, **options),
        "weighted": ebip(primitive(), weigh=True),
        "localised": ebip(primitive(), localise=True),
        "bip": bip(primitive()),
        "particle filter": particle_filter(primitive()),
    }


def samples(length: int = 25, index: int = 1, beside: float = 0.0) -> list[Sample]:
    """What the sensors measured in one interaction, in order; the gaze is blind for a while.

    Args:
        length: of the interaction, in samples.
        index: which interaction.
        beside: ticks by which the hand is measured after the tick, and the gaze before.
    """
    values = interactions(3, seed=5)[index][:length]
    stream = []
    for k, row in enumerate(values.tolist()):
        for name, columns in SENSORS.items():
            if name == "hand" or not 8 <= k < 12:
                shift = beside if name == "hand" else -beside
                stream.append((name, tuple(row[columns]), (k + shift) * DT))
    return sorted(stream, key=lambda sample: sample[2])


def live(
    name: str = "ebip with options", sensors: Sequence[str] | None = None, record: Path | None = None, **settings: Any
) -> InteractionSession:
    chosen = SessionSettings(**{"window": 0.3, "margin": 3.0, **settings})
    return InteractionSession(filters()[name], primitive(), sensors, chosen, record)


def everything(session: InteractionSession, now: float) -> list[Tensor]:
    """Mean and deviation of forecasts that together depend on the whole state."""
    told = session.forecast([0.0, 0.1, 0.5, 2.0], now)
    return [told.mean, told.deviation, torch.tensor([told.phase, told.time_to_end])]


def same(one: list[Tensor], other: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("name", filters())
def test_a_stream_in_order_is_the_filter(name: str) -> None:
    """Against the filter's own steps, written out."""
    session, filter, generator = live(name, seed=3), filters()[name], seeded(3)
    stream = samples()
    values = torch.full((25, 5), torch.nan)
    for sensor, value, time in stream:
        values[round(time / DT), SENSORS[sensor]] = torch.tensor(value)
        session.push(sensor, value, time)
    with torch.no_grad():
        state = filter.initial_state(generator=generator)
        for k, y in enumerate(values):
            if k:
                state = filter.predict(state, filter.dt, generator)
            state, _ = filter.update(state, y, generator=generator)
        velocity = float(state.mean[1])
        phase = float(filter.phase(state))
        wanted = filter.forecast(state, torch.tensor([phase + 0.2 * velocity])).at(0)
    told = session.forecast(0.2, 24 * DT)
    assert told.phase == pytest.approx(min(max(phase, 0), 1), abs=1e-4)
    assert told.time_to_end == pytest.approx((1 - told.phase) / velocity, rel=1e-3, abs=1e-3)
    # Rounding only: some filters leave out here what no sensor sees, or work in place.
    torch.testing.assert_close(told.mean, wanted.mean[3:], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(told.deviation, wanted.variance[3:].sqrt(), rtol=2e-2, atol=1e-3)
    assert told.dofs == ("arm.1", "arm.2")


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(
    delays=st.lists(st.one_of(st.floats(0.0, 0.3), st.just(0.3)), min_size=46, max_size=46),
    polls=st.lists(st.booleans(), min_size=46, max_size=46),
    settle=st.sampled_from([0.0, 0.05]),
    beside=st.sampled_from([0.0, 0.2, 0.4, 0.49]),
    name=st.sampled_from(["ebip", "ebip with options", "particle filter"]),
)
def test_any_order_within_the_window_gives_the_same_state(
    delays: list[float], polls: list[bool], settle: float, beside: float, name: str
) -> None:
    stream = samples(beside=beside)
    ordered = live(name, settle=settle)
    for sensor, value, time in stream:
        ordered.push(sensor, value, time)
        ordered.advance(time)
    shuffled = live(name, settle=settle)
    arrivals = sorted(zip((time + d for (_, _, time), d in zip(stream, delays, strict=True)), stream, strict=True))
    for (arrival, (sensor, value, time)), poll in zip(arrivals, polls, strict=True):
        shuffled.push(sensor, value, time)
        if poll:
            shuffled.forecast(0.1, arrival)
    assert all(report.late == 0 for report in shuffled.report().values())
    end = 25 * DT + 0.3
    assert same(everything(ordered, end), everything(shuffled, end))
    assert ordered.report() == shuffled.report()
    assert ordered.forecast().time == shuffled.forecast().time


absurd = [1e308, -1e308, 1e-320, 1e6, 1e12, 3e19, 1e25]
number = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.sampled_from(absurd), st.integers())
value = st.one_of(
    st.lists(number, max_size=4),
    st.none(),
    st.text(max_size=3),
    number,
    st.lists(st.text(max_size=2), min_size=1, max_size=2),
    st.dictionaries(st.text(max_size=1), number, max_size=2),
)
moment = st.one_of(st.floats(-0.1, 1.2), number, st.none(), st.text(max_size=2))


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(
    garbage=st.lists(st.tuples(st.sampled_from(["hand", "gaze"]), value, moment), max_size=40),
    name=st.sampled_from(["ebip", "ebip with options", "weighted", "localised", "bip", "particle filter"]),
    margin=st.sampled_from([1.0, 1e30]),
)
def test_garbage_never_raises_and_never_makes_the_state_infinite(
    garbage: list[tuple[str, Any, Any]], name: str, margin: float
) -> None:
    """With an endless margin whatever is finite reaches the filter itself."""
    session = live(name, margin=margin)
    stream = samples()
    for k in range(max(len(stream), len(garbage))):
        if k < len(garbage):
            session.push(*garbage[k])
        if k < len(stream):
            session.push(*stream[k])
            told = session.forecast(0.1, stream[k][2])
            assert bool(told.mean.isfinite().all() & told.deviation.isfinite().all())
            assert 0 <= told.phase <= 1
    assert all(bool(part.isfinite().all()) for part in everything(session, stream[-1][2]))


class Moody(torch.nn.Module):
    """A measurement noise that at times refuses to answer, or answers with nonsense.

    Args:
        usual: what it answers otherwise.
        nonsense: NaN instead of an error.
    """

    depends_on_phase = True

    def __init__(self, usual: torch.nn.Module, nonsense: bool = False) -> None:
        super().__init__()
        self.usual, self.nonsense, self.bad = usual, nonsense, False

    def forward(self, phase: Tensor | None = None) -> Tensor:
        deviation = self.usual(phase)
        if self.bad and not self.nonsense:
            raise ValueError("cannot be factored")
        return deviation * (math.nan if self.bad else 1.0)


def live_through(name: str, nonsense: bool = False) -> tuple[InteractionSession, InteractionSession]:
    """All samples, with a noise that is bad at one tick; and a session that never gets the samples of that tick."""
    filter = copy.deepcopy(filters()[name])
    moody = filter.model.measurement_noise = Moody(filter.model.measurement_noise, nonsense)
    sessions = [InteractionSession(filter, primitive(), None, SessionSettings(window=0.3, margin=3.0)) for _ in "ab"]
    session, other = sessions
    for sensor, value, time in samples():
        moody.bad = 0.39 < time < 0.41
        session.push(sensor, value, time)
        session.advance(time)
        if not moody.bad:
            other.push(sensor, value, time)
        other.advance(time)
    return session, other


@pytest.mark.parametrize("name", filters())
def test_an_update_that_fails_is_left_out(name: str) -> None:
    session, other = live_through(name)
    assert session.failed_updates == 1
    assert other.failed_updates == 0
    assert same(everything(session, 1.0), everything(other, 1.0))


@pytest.mark.parametrize("name", filters())
def test_an_update_that_leaves_the_state_infinite_is_left_out(name: str) -> None:
    """An update that comes back as if nothing were wrong, where a filter does not notice itself."""
    session, other = live_through(name, nonsense=True)
    assert session.failed_updates == 1
    assert same(everything(session, 1.0), everything(other, 1.0))


def test_what_was_refused_is_counted() -> None:
    session = live(margin=0.5)
    stream = samples()
    for sensor, value, time in stream:
        session.push(sensor, value, time)
    session.advance(24 * DT)
    good = session.report()["hand"].accepted
    session.push("hand", (math.nan, 0.1), 24 * DT)
    session.push("hand", (math.inf, math.nan), 24 * DT)
    session.push("hand", (1e3, 0.1), 24 * DT)
    session.push("hand", (0.1,), 24 * DT)
    session.push("hand", "broken", 24 * DT)
    session.push("hand", (0.1, 0.1), math.nan)
    session.push("hand", (0.1, 0.1), 0.0)
    session.push("hand", (0.1, 0.1), -1.0)
    session.push("hand", (0.1, 0.1), 1e9)
    report = session.report()["hand"]
    assert (report.nan, report.infinite, report.out_of_range, report.malformed) == (2, 1, 1, 3)
    assert (report.late, report.early, report.accepted - good) == (1, 2, 2)
    with pytest.raises(ValueError, match="no sensor 'nose'; this session has hand, gaze"):
        session.push("nose", (1.0,), 0.0)


def test_part_of_a_sample_is_used_where_the_rest_cannot_be() -> None:
    partial, alone = live(), live()
    for sensor, value, time in samples():
        if sensor == "hand":
            partial.push(sensor, (value[0], math.inf), time)
            alone.push(sensor, (value[0], math.nan), time)
    assert same(everything(partial, 0.8), everything(alone, 0.8))


def test_a_frozen_sensor_is_refused_and_reported_stale() -> None:
    frozen, silent = live(frozen_after=0.1), live()
    for sensor, value, time in samples():
        broken = sensor == "hand" and time > 0.3
        frozen.push(sensor, (0.123, 0.5) if broken else value, time)
        # Until it is found out it is believed: four ticks within a tenth of a second.
        if not broken:
            silent.push(sensor, value, time)
        elif time < 0.3 + 4.5 * DT:
            silent.push(sensor, (0.123, 0.5), time)
    one, other = frozen.forecast(now=24 * DT), silent.forecast(now=24 * DT)
    assert torch.equal(one.mean, other.mean)
    assert one.stale == ("hand",)
    assert frozen.report()["hand"].frozen == 25 - 10 - 4
    assert silent.report()["hand"].frozen == 0


def test_a_frozen_sensor_that_flickers_is_still_frozen() -> None:
    session = live(frozen_after=0.1)
    for k in range(25):
        session.push("hand", (0.1, math.nan if k % 3 == 0 else 0.5), k * DT)
    session.advance(24 * DT)
    assert session.report()["hand"].frozen == 25 - 4


def test_sensors_that_say_nothing_are_stale() -> None:
    session = live(stale_after=0.1)
    assert session.forecast(now=0.0).stale == ("hand", "gaze")
    for sensor, value, time in samples():
        if sensor == "hand" or time < 0.2:
            session.push(sensor, value, time)
    assert session.forecast(now=0.2).stale == ()
    assert session.forecast(now=0.5).stale == ("gaze",)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_of_a_faster_sensor_the_nearest_sample_counts(order: tuple[int, ...]) -> None:
    stream = samples()
    exact, fast = live(start=0.0), live(start=0.0)
    for sensor, value, time in stream:
        exact.push(sensor, value, time)
        pushes = [(time, value), (time + 0.3 * DT, value[::-1]), (time - 0.2 * DT, tuple(0.5 * v for v in value))]
        for i in order:
            if pushes[i][0] >= -0.5 * DT:
                fast.push(sensor, pushes[i][1], pushes[i][0])
    assert same(everything(exact, 0.8), everything(fast, 0.8))


def test_forecasts_do_not_change_what_comes_after() -> None:
    quiet, asked = live(), live()
    for sensor, value, time in samples():
        quiet.push(sensor, value, time)
        asked.push(sensor, value, time)
        for horizon in (None, 0.1, [0.1, 0.2]):
            asked.forecast(horizon, time)
    assert same(everything(quiet, 0.8), everything(asked, 0.8))


def test_numbers_of_any_library_are_numbers() -> None:
    session = live()
    for sensor, value, time in samples():
        session.push(sensor, torch.tensor(value), np.float32(time))
    one = session.forecast(np.float32(0.125), np.float64(0.75))
    many = session.forecast(np.array([0.125]), 0.75)
    assert one.mean.shape == (2,)
    assert many.mean.shape == (1, 2)
    assert torch.equal(one.mean, many.mean[0])
    assert torch.equal(one.mean, session.forecast(torch.tensor(0.125), torch.tensor(0.75)).mean)


def test_time_goes_on_between_and_after_samples() -> None:
    session = live()
    for sensor, value, time in samples():
        session.push(sensor, value, time)
    told = [session.forecast(now=0.5 + 0.25 * k * DT) for k in range(8)]
    phases = np.array([one.phase for one in told])
    assert (np.diff(phases) > 0).all()
    left = np.array([one.time_to_end for one in told])
    # A tick's new samples may move the phase a little; between ticks it is exactly the speed.
    np.testing.assert_allclose(np.diff(left)[:3], -0.25 * DT, atol=1e-6)
    assert session.forecast(now=0.4).time == told[-1].time  # never backwards
    assert session.forecast(100.0).mean.equal(session.forecast().mean)  # behind the end is the end


def test_several_threads_may_push() -> None:
    stream = samples()
    # A thread may be held up for as long as the machine likes: no sample may be too late for the window.
    ordered, threaded = live(window=1.0), live(window=1.0)
    for sensor, value, time in stream:
        ordered.push(sensor, value, time)

    def feed(name: str) -> None:
        for sensor, value, time in stream:
            if sensor == name:
                threaded.push(sensor, value, time)

    threads = [threading.Thread(target=feed, args=(name,)) for name in SENSORS]
    for thread in threads:
        thread.start()
    for _ in range(20):
        threaded.forecast(0.1)
    for thread in threads:
        thread.join()
    assert sum(report.late for report in threaded.report().values()) == 0
    assert same(everything(ordered, 0.8), everything(threaded, 0.8))


def test_memory_does_not_grow() -> None:
    session = live(longest_gap=1.0)

    def on(first: int, last: int) -> None:
        generator = np.random.default_rng(first)
        for k in range(first, last):
            session.push("hand", generator.normal(0.0, 0.1, 2), k * DT)
            session.push("gaze", generator.normal(0.0, 0.1, 1), (k - 3) * DT)  # late: replays each time
            session.forecast(0.1, k * DT)

    def alive() -> tuple[int, int]:
        """Objects, and numbers in tensors and arrays. (Allocations would count Python's own lists of free tuples.)"""
        gc.collect()
        objects = gc.get_objects()
        tensors = sum(part.numel() for part in objects if type(part) is Tensor)
        return len(objects), tensors

    on(0, 100)
    before = alive()
    on(100, 600)
    after = alive()
    assert after[0] - before[0] < 50
    assert after[1] == before[1]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: live(sensors=["arm"]), "'arm' is controlled by the robot"),
        (lambda: live(sensors=["nose"]), "no modality 'nose'"),
        (lambda: live(sensors=[]), "at least one sensor"),
        (lambda: live(sensors="hand"), "different names"),
        (lambda: live(sensors=["hand", "hand"]), "different names"),
        (lambda: live(window=math.inf), "window must be finite"),
        (lambda: live().advance(10**400), "now must be a finite"),
        (lambda: live(window=0.0), "window must be a positive"),
        (lambda: live(settle=0.4), "settle must be"),
        (lambda: live(margin=-1.0), "margin must not be negative"),
        (lambda: live(start=math.inf), "start must be finite"),
        (lambda: live().forecast(math.nan), "horizons must be finite"),
        (lambda: live().forecast(now=math.nan), "now must be a finite"),
        (lambda: live(start=0.0).advance(1e6), "more than the longest gap"),
    ],
)
def test_mistakes_of_the_caller_are_explained(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_double_precision_and_another_clock() -> None:
    double = small_primitive(torch.float64)
    session = InteractionSession(ebip(double), double, settings=SessionSettings(start=1e5, margin=3.0))
    other = InteractionSession(ebip(double), double, settings=SessionSettings(margin=3.0))
    for sensor, value, time in samples():
        session.push(sensor, value, 1e5 + time)
        other.push(sensor, value, time)
    told: SessionForecast = session.forecast(0.1, 1e5 + 0.8)
    assert told.mean.dtype == torch.float64
    torch.testing.assert_close(told.mean, other.forecast(0.1, 0.8).mean, rtol=1e-6, atol=1e-6)


def test_a_localised_filter_has_no_live_path() -> None:
    localised = filters()["localised"]
    assert isinstance(localised.analysis.localisation, Localisation)  # type: ignore[attr-defined]
    assert not localised.has_live_path  # type: ignore[attr-defined]


class Odd:
    """Raises what it likes when it is asked for numbers."""

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise KeyError("not numbers")


def test_an_object_that_raises_is_malformed() -> None:
    session = InteractionSession(filters()["ebip"], primitive())
    session.push("hand", Odd(), 0.0)
    assert session.report()["hand"].malformed == 1


def test_a_filter_and_a_primitive_that_do_not_fit() -> None:
    with pytest.raises(ValueError, match="the filter has 3 DoFs, the primitive's layout 5"):
        InteractionSession(filters()["bip"].restrict(~primitive().layout.controlled), primitive())


def switches(count: int = 12, still: bool = False) -> Demonstrations:
    """A hand, and a contact that says 0 and then 1, at 30 Hz; with ``still`` one that never changes somewhere."""
    generator = torch.Generator().manual_seed(0)
    layout = Layout(
        [
            Modality("hand", ["x", "y"], "m"),
            Modality("contact", ["c"], "1"),
            Modality("arm", ["j"], "rad", controlled=True),
        ]
    )
    paths = []
    for i in range(count):
        a, p = torch.randn((), generator=generator), torch.linspace(0, 1, 60 + i)
        hand = torch.stack([a * p, p], -1) + 0.01 * torch.randn(len(p), 2, generator=generator)
        contact = (p > 0.5).float() * (0.0 if still and i == 3 else 1.0)
        paths.append(torch.cat([hand, contact[:, None], (a * p**2)[:, None]], -1))
    paths[1][10:20, 2] = torch.nan  # not measured for a while: what it said before still counts
    return Demonstrations(layout, paths, 30.0)


def test_what_repeats_itself_in_the_demonstrations_may_do_so() -> None:
    made = switches()
    repeats = longest_repeats(made).tolist()
    assert repeats[0] == repeats[2] == 0
    halves = [max(int((t[:, 2] == 0).sum()), int((t[:, 2] == 1).sum())) for t in made if not t.isnan().any()]
    assert repeats[1] == pytest.approx((max(halves) - 1) / 30)
    assert longest_repeats(switches(still=True)).tolist()[1] == math.inf
    primitive = InteractionPrimitive.fit(made.subset(range(1, 12)))
    path = made[0]
    reports = {}
    for name, frozen_after in {"usual": None, "all": 0.25, "by name": {"contact": 0.25, "hand": math.inf}}.items():
        session = InteractionSession(ebip(primitive), primitive, None, SessionSettings(frozen_after=frozen_after))
        for k, row in enumerate(path):
            session.push("contact", [float(row[2])], k / 30)
            session.push("hand", row[:2].tolist() if k < 20 else path[20, :2].tolist(), k / 30)
            session.forecast(now=k / 30)
        reports[name] = {sensor: report.frozen for sensor, report in session.report().items()}
    assert reports["usual"]["contact"] == 0
    assert reports["usual"]["hand"] > 20
    assert reports["all"]["contact"] > 20
    assert reports["by name"] == {"contact": reports["all"]["contact"], "hand": 0}
    stuck = InteractionSession(ebip(primitive), primitive)
    for k in range(90):
        stuck.push("contact", [0.0], k / 30)
        stuck.advance(k / 30)
    assert stuck.report()["contact"].frozen > 0  # half as long again as it ever did is too long


def test_columns_and_rates_of_filter_and_primitive_are_compared() -> None:
    made = interactions(6)
    hand, *rest = made.layout.modalities
    swapped = Layout([Modality("hand", ["hand.y", "hand.x"], "m"), *rest])
    basis = primitive().basis
    other = InteractionPrimitive.fit(Demonstrations(swapped, list(made), 30.0), basis)
    with pytest.raises(ValueError, match=r"have other columns: 'hand.x' and 'hand.y'"):
        InteractionSession(filters()["ebip"], other)
    faster = InteractionPrimitive.fit(Demonstrations(made.layout, list(made), 60.0), basis)
    with pytest.raises(ValueError, match="the filter takes 30 samples a second, the primitive 60"):
        InteractionSession(filters()["ebip"], faster)
    assert hand.dofs == ("hand.x", "hand.y")


def test_ticks_are_counted() -> None:
    session = live()
    stream = samples()
    late = next(sample for sample in stream if sample[0] == "gaze" and sample[2] > 18.5 * DT)
    for sample in stream:
        if sample is not late:
            session.push(*sample)
            session.advance(sample[2])
    in_order = session.ticks_filtered
    session.push(*late)
    session.advance()
    assert session.ticks_filtered == in_order + 6
