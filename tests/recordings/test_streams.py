"""Sensors with times of their own come onto one grid: as np.interp puts them, with NaN where nothing says."""

import math
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ebip import Demonstrations, Layout, Modality
from torch_ebip.recordings.resampling import onto_grid
from torch_ebip.recordings.units import in_si

LAYOUT = Layout([
    Modality("hand", ["x", "y"], "m"), Modality("gaze", ["g"], "rad"), Modality("arm", ["q"], "rad", controlled=True)
])  # fmt: skip


def smooth(times, d: int) -> np.ndarray:
    return np.stack([np.sin(2 * np.asarray(times) + k) for k in range(d)], -1)


def streams(seed: int = 0, duration: float = 2.0, offset: float = 0.0) -> dict:
    """Three rates, with jitter; the hand has a gap of 0.6 s."""
    random = np.random.default_rng(seed)
    found = {}
    for name, rate, d in (("hand", 60.0, 2), ("gaze", 25.0, 1), ("arm", 100.0, 1)):
        times = np.arange(0, duration, 1 / rate)
        times = times + random.uniform(-0.2, 0.2, len(times)) / rate
        if name == "hand":
            times = times[(times < 0.8) | (times > 1.4)]
        found[name] = (times + offset, smooth(times, d))
    return found


def test_every_sensor_is_where_it_was() -> None:
    made = Demonstrations.from_streams(LAYOUT, [streams(0), streams(1, 1.5, offset=1.79e9)])
    assert made.rate == 100
    for i, path in enumerate(made):
        start = max(times[0] for times, _ in streams(i, [2.0, 1.5][i]).values())
        times = start + np.arange(len(path)) / 100
        wanted = np.concatenate([smooth(times, 2), smooth(times, 1), smooth(times, 1)], -1)
        said = ~path.isnan()
        assert said[:, 2:].all()
        np.testing.assert_allclose(path.numpy()[said], wanted[said.numpy()], atol=2e-3)
        gap = (times > 0.82) & (times < 1.38)
        assert not said[gap, :2].any()
        assert said[times < 0.75, :2].all()
        assert made.trajectories[0].dtype == torch.float64


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10**6), st.integers(2, 30), st.floats(0.05, 3.0))
def test_linear_is_numpys_where_samples_are_near(seed: int, count: int, max_gap: float) -> None:
    random = np.random.default_rng(seed)
    times = np.cumsum(random.uniform(0.01, 1.0, count))
    values = random.normal(size=(count, 2))
    values[random.random((count, 2)) < 0.2] = np.nan
    grid = np.arange(-0.5, times[-1] + 0.5, 0.07)
    found = onto_grid(times, values, grid, max_gap)
    for k in range(2):
        said = ~np.isnan(values[:, k])
        t, v = times[said], values[said, k]
        for g, value in zip(grid, found[:, k], strict=True):
            after = int((t < g).sum())
            joined = 0 < after < len(t) and t[after] - t[after - 1] <= max_gap
            if joined:
                assert value == pytest.approx(np.interp(g, t, v), abs=1e-9)
            else:
                assert np.isnan(value) or np.abs(t - g).min() < 2e-6


def test_nearest_and_samples() -> None:
    times, values = np.array([0.0, 0.26, 0.5]), np.array([[1.0], [2.0], [3.0]])
    grid = np.arange(0, 0.61, 0.1)
    np.testing.assert_array_equal(onto_grid(times, values, grid, 0.11, "nearest")[:, 0], [1, 1, 2, 2, 3, 3, 3])
    nan = np.nan
    np.testing.assert_array_equal(onto_grid(times, values, grid, 9.0, "sample")[:, 0], [1, nan, nan, 2, nan, 3, nan])
    slow = Demonstrations.from_streams(LAYOUT, [streams()], how={"gaze": "sample"})
    assert 40 <= int((~slow[0][:, 2].isnan()).sum()) <= 50


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10**6))
def test_order_of_arrival_and_origin_of_time_change_nothing(seed: int) -> None:
    plain = streams(seed)
    random = np.random.default_rng(seed)
    mixed = {}
    for name, (times, values) in plain.items():
        order = np.arange(len(times))
        swapped = random.choice(len(times) // 3, max(1, len(times) // 12), replace=False) * 3
        order[swapped], order[swapped + 1] = order[swapped + 1], order[swapped]
        mixed[name] = (times[order] + 1000.0, values[order])
    ours = Demonstrations.from_streams(LAYOUT, [plain])
    with pytest.warns(UserWarning, match="hand: .* of .* stamps ran backwards"):
        other = Demonstrations.from_streams(LAYOUT, [mixed])
    torch.testing.assert_close(ours[0], other[0], atol=1e-6, rtol=0, equal_nan=True)
    assert len(other.remarks) == 3
    assert other.subset([0]).assign(["arm"], ["hand"]).remarks == other.remarks


def test_repeated_stamps_keep_the_first() -> None:
    times = np.array([0.0, 0.1, 0.1, 0.2, 0.3])
    others = (times[[0, 1, 3, 4]], np.zeros(4))
    hand = np.array([[0.0, 0], [1, 1], [9, 9], [2, 2], [3, 3]])
    given_ = {"hand": (times, hand), "gaze": others, "arm": others}
    with pytest.warns(UserWarning, match="hand: 1 of 5 stamps were those of another sample"):
        made = Demonstrations.from_streams(LAYOUT, [given_])
    torch.testing.assert_close(made[0][:, 0], torch.arange(4.0, dtype=torch.float64))


def test_spans() -> None:
    late = streams()
    late["gaze"] = tuple(part[20:] for part in late["gaze"])  # begins at 0.8 s
    common = Demonstrations.from_streams(LAYOUT, [late])
    by_hand = Demonstrations.from_streams(LAYOUT, [late], span="hand")
    given_ = Demonstrations.from_streams(LAYOUT, [late], span=[(0.25, 1.0)])
    assert float(common.durations) == pytest.approx(late["gaze"][0][-1] - late["gaze"][0][0], abs=0.01)
    assert float(by_hand.durations) == pytest.approx(2.0, abs=0.05)
    assert by_hand[0][:70, 2].isnan().all()
    assert float(given_.durations) == pytest.approx(0.75)
    without = {name: stream for name, stream in streams().items() if name != "gaze"}
    with pytest.warns(UserWarning, match="gaze: nothing of it in 1 of 2 interactions"):
        made = Demonstrations.from_streams(LAYOUT, [streams(), without])
    assert made[1][:, 2].isnan().all()


def test_precision_and_rate() -> None:
    single = {name: (t, v.astype(np.float32)) for name, (t, v) in streams().items()}
    made = Demonstrations.from_streams(LAYOUT, [single], rate=40.0)
    assert made[0].dtype == torch.float32
    assert made.rate == 40
    tensors = {name: (torch.tensor(t), torch.tensor(v)) for name, (t, v) in streams().items()}
    ours = Demonstrations.from_streams(LAYOUT, [tensors], rate=40.0)
    assert ours[0].dtype == torch.float64
    torch.testing.assert_close(ours[0], made[0].double(), atol=1e-6, rtol=0, equal_nan=True)


def broken(**changes) -> list[dict]:
    return [{**streams(), **changes}]


@pytest.mark.parametrize(
    ("interactions", "options", "said"),
    [
        ([], {}, "at least one"),
        (broken(nose=([0.0], [1.0])), {}, "no modality 'nose'"),
        (broken(hand=([0.0, 1.0], [[1.0], [2.0]])), {}, r"interaction 0, hand: .*expected \[T\] and \[T, 2\]"),
        (broken(gaze=([0.0, math.nan], [1.0, 2.0])), {}, "gaze: 1 of 2 stamps are NaN"),
        (broken(gaze=([0.0, 1.0], [1.0, math.inf])), {}, "gaze: infinite values"),
        (broken(gaze=([0.0, 1.0], ["a", "b"])), {}, "interaction 0, gaze: expected"),
        (broken(gaze=(np.arange(9.0)[::-1], np.zeros(9))), {}, "8 of 9 stamps run backwards"),
        (broken(gaze=(np.zeros(9), np.zeros(9))), {}, "8 of 9 stamps repeat"),
        (broken(gaze=([100.0, 101.0], [0.0, 1.0])), {}, "no time in common: .*gaze 100 to 101 s.*clocks"),
        ([{}], {}, "interaction 0: no samples"),
        ([streams()], {"rate": 0.0}, "rate"),
        ([streams()], {"max_gap": -1.0}, "max_gap"),
        ([streams()], {"how": "spline"}, "must be one of linear, nearest, sample"),
        ([streams()], {"how": {"nose": "linear"}}, "no modality 'nose'"),
        ([streams()], {"span": "nose"}, "no modality 'nose'"),
        ([streams()], {"span": [(1.0, 0.5)]}, "start < end"),
        ([streams()], {"span": [(0.0, 1.0)] * 2}, "2 spans, expected 1"),
        ([streams()], {"rate": 1e9}, "interaction 0: .* samples, expected"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_named(interactions: list[dict], options: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Demonstrations.from_streams(LAYOUT, interactions, **options)


@pytest.mark.parametrize(
    ("unit", "si", "factor"),
    [
        ("mm", "m", 1e-3), ("deg", "rad", math.pi / 180), ("g", "m/s^2", 9.80665), ("ms", "s", 1e-3), ("m", "m", 1.0),
        ("cm/s^2", "m/s^2", 1e-2), ("deg/s", "rad/s", math.pi / 180), ("mm^2", "m^2", 1e-6), ("N*mm", "N*m", 1e-3),
        ("m/ms", "m/s", 1e3), ("rpm", "rad/s", math.pi / 30), ("px", "px", 1.0), ("rad²", "rad²", 1.0),
    ],
)  # fmt: skip
def test_units(unit: str, si: str, factor: float) -> None:
    assert in_si(unit) == (si, pytest.approx(factor))


def test_layouts_keep_si() -> None:
    shown = Layout(
        [Modality("hand", ["x"], "mm"), Modality("yaw", ["w"], "deg/s"), Modality("arm", ["q"], "rad", True)]
    )
    made = Demonstrations(shown, [torch.tensor([[1000.0, 180.0, 1.0], [2000.0, 90.0, 2.0]])], 10.0)
    assert made.layout.units == ("m", "rad/s", "rad")
    torch.testing.assert_close(made[0], torch.tensor([[1.0, math.pi, 1.0], [2.0, math.pi / 2, 2.0]]))
    assert torch.equal(made.subset([0])[0], made[0])
    with pytest.raises(ValueError, match="'degC' has no factor"):
        Demonstrations(Layout([Modality("t", ["t"], "degC")]), [torch.ones(3, 1)], 1.0)


def test_a_clean_recording_is_not_warned_about() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Demonstrations.from_streams(LAYOUT, [streams()]).remarks == ()
