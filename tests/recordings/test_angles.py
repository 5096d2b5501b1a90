"""Angles that come wrapped are those that come clean, in and out; what looks cut and was not declared is named."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ebip import (
    Demonstrations,
    InteractionModel,
    InteractionPrimitive,
    InteractionSession,
    Layout,
    Modality,
    ebip,
    learn,
)
from torch_ebip.recordings.angles import continuous, wrapped

RATE = 30.0


def layout(kind: str = "angle", unit: str = "rad") -> Layout:
    return Layout([
        Modality("head", ["yaw"], unit, kind=kind),
        Modality("hand", ["x"], "m"),
        Modality("gripper", ["roll"], unit, controlled=True, kind=kind),
    ])  # fmt: skip


def paths(count: int = 24, seed: int = 0) -> list[torch.Tensor]:
    """A yaw that crosses pi, and a roll that follows it, mirrored; some values are missing."""
    generator = torch.Generator().manual_seed(seed)
    made = []
    for i in range(count):
        p = torch.linspace(0, 1, 40 + i % 7, dtype=torch.float64)
        a = 0.3 * torch.randn((), generator=generator, dtype=torch.float64)
        noise = 0.005 * torch.randn(len(p), 3, generator=generator, dtype=torch.float64)
        path = torch.stack([2.8 + (0.6 + a) * p, a * p, -2.9 - (0.8 + a) * p**2], -1) + noise
        path[3:5, 0] = math.nan
        made.append(path)
    return made


def cut(values: torch.Tensor) -> torch.Tensor:
    """As sensors send it."""
    found = values.clone()
    found[:, [0, 2]] = torch.atan2(values[:, [0, 2]].sin(), values[:, [0, 2]].cos())
    return found


CLEAN = Demonstrations(layout(), paths(), RATE)
CUT = Demonstrations(layout(), [cut(path) for path in paths()], RATE)


@settings(deadline=None, max_examples=80)
@given(st.integers(0, 10**6), st.floats(-50, 50))
def test_continuous_is_numpys_unwrap(seed: int, centre: float) -> None:
    random = np.random.default_rng(seed)
    values = np.cumsum(random.uniform(-3, 3, 30)) + random.uniform(-20, 20)
    middle = torch.tensor([centre], dtype=torch.float64)
    found = continuous(wrapped(torch.tensor(values))[:, None], middle)[:, 0].numpy()
    np.testing.assert_allclose(np.diff(found), np.diff(values), atol=1e-9)
    assert abs(found[0] - centre) <= math.pi + 1e-9
    again = continuous(torch.tensor(found)[:, None], middle)[:, 0].numpy()
    np.testing.assert_array_equal(found, again)


def test_half_a_turn_is_plus_pi() -> None:
    angles = torch.tensor([math.pi, -math.pi, 0.0, 3 * math.pi], dtype=torch.float64)
    torch.testing.assert_close(wrapped(angles), torch.tensor([math.pi, math.pi, 0.0, math.pi], dtype=torch.float64))


def test_wrapped_demonstrations_are_the_clean_ones() -> None:
    assert CUT.layout == CLEAN.layout
    assert CUT.layout["head"].centre == pytest.approx(CLEAN.layout["head"].centre)
    for ours, theirs in zip(CUT, CLEAN, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-9, rtol=0, equal_nan=True)
        assert not bool((ours[:, 0].diff().abs() > 3).any())
    # What is there already is not moved, alone or among others.
    assert torch.equal(CUT.subset([4])[0].nan_to_num(9), CUT[4].nan_to_num(9))
    assert CUT.assign(["gripper"], ["head"]).layout["head"].centre == CUT.layout["head"].centre


def test_degrees() -> None:
    degrees = [cut(path) * torch.tensor([180 / math.pi, 1.0, 180 / math.pi], dtype=torch.float64) for path in paths()]
    made = Demonstrations(layout(unit="deg"), degrees, RATE)
    assert made.layout.units == ("rad", "m", "rad")
    torch.testing.assert_close(made[3], CLEAN[3], atol=1e-9, rtol=0, equal_nan=True)


def test_files_keep_them(tmp_path: Path) -> None:
    CUT.save(tmp_path / "made.npz")
    again = Demonstrations.load(tmp_path / "made.npz")
    assert again.layout == CUT.layout
    assert again.layout["head"].centre == CUT.layout["head"].centre
    assert torch.equal(again[2].nan_to_num(9), CUT[2].nan_to_num(9))
    assert again.columns == {}


def forecasts(demonstrations: Demonstrations, shown: torch.Tensor) -> tuple[torch.Tensor, InteractionPrimitive]:
    primitive = InteractionPrimitive.fit(demonstrations.subset(range(20)))
    filter = ebip(primitive, square_root=True)
    y = shown[:30].clone()
    y[:, 2] = math.nan
    with torch.no_grad():
        state = filter(y, generator=torch.Generator().manual_seed(0)).state
        said = filter.forecast(state, torch.tensor([1.0], dtype=torch.float64))
    return said.mean[0, 2], primitive


def test_forecasts_do_not_know_how_it_came() -> None:
    ours, _ = forecasts(CUT, CUT[22])
    theirs, _ = forecasts(CLEAN, CLEAN[22])
    torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=0)
    assert abs(float(ours - CLEAN[22][-1, 2])) < 0.15
    plain = Demonstrations(layout("plain"), [cut(path) for path in paths()], RATE)
    with pytest.warns(UserWarning, match="yaw jumps by a whole turn"):
        wrong, _ = forecasts(plain, plain[22])
    assert abs(float(wrapped(wrong - CLEAN[22][-1, 2]))) > 0.15  # or the test shows nothing


def test_a_session_takes_and_says_them_wrapped() -> None:
    primitive = InteractionPrimitive.fit(CLEAN.subset(range(20)))
    filter = ebip(primitive, square_root=True)
    said = []
    for values in (paths()[22], cut(paths()[22]), paths()[22] + torch.tensor([4 * math.pi, 0.0, 0.0])):
        with InteractionSession(filter, primitive) as session:
            for step, row in enumerate(values[:30].numpy()):
                session.push("head", row[:1], step / RATE)
                session.push("hand", row[1:2], step / RATE)
            told = session.forecast()
            assert session.report()["head"].out_of_range == 0
        said.append(told.mean)
    torch.testing.assert_close(said[1], said[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(said[2], said[0], atol=1e-6, rtol=0)
    assert -math.pi < float(said[0]) <= math.pi
    assert abs(float(wrapped(said[0] - paths()[22][-1, 2]))) < 0.15


def test_a_model_keeps_where_they_are(tmp_path: Path) -> None:
    model = learn(CUT.subset(range(20)), steps=0, scan=4)
    model.save(tmp_path / "model.safetensors")
    again = InteractionModel.load(tmp_path / "model.safetensors")
    assert again.layout == model.layout
    assert again.layout["head"].centre == model.layout["head"].centre
    clean, raw = paths()[22], cut(paths()[22]) - torch.tensor([2 * math.pi, 0.0, 0.0])
    ours, theirs = (again.forecast(values, [0.2, math.inf]).mean for values in (raw, clean))
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0)
    # Recordings whose own centre lies on the other side come to the model's.
    low = Demonstrations(layout(), [path - torch.tensor([2 * math.pi, 0.0, 0.0]) for path in paths(3, seed=5)], RATE)
    assert low.layout["head"].centre == pytest.approx(model.layout["head"].centre, abs=0.5)
    head = Modality("head", ["yaw"], "rad", kind="angle", centre=[-3.4])
    moved = Demonstrations(Layout([head, *layout().modalities[1:]]), paths(3, seed=5), RATE)
    assert float(moved[0][0, 0]) < 0
    assert float(model.prepare(moved)[0][0, 0]) > 0
    with pytest.raises(ValueError, match="head is of kind 'plain' in the recordings, 'angle' in the model"):
        model.prepare(Demonstrations(layout("plain"), paths(3), RATE))


def test_cut_turns_are_named_once_and_nothing_else_is() -> None:
    generator = torch.Generator().manual_seed(1)
    turns = [torch.linspace(0, 4 + 0.3 * i, 50, dtype=torch.float64) for i in range(4)]
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    vectors = [wrapped(angle)[:, None] * axis for angle in turns]
    quaternions = [torch.stack([angle.sin(), 0 * angle, 0 * angle, angle.cos()], -1) for angle in turns]
    flipped = [torch.cat([q[:20], -q[20:]]) for q in quaternions]
    noise = [0.01 * torch.randn(50, 3, generator=generator, dtype=torch.float64) for _ in turns]

    def said(dofs: int, values: list[torch.Tensor]) -> list[str]:
        shown = Demonstrations(Layout([Modality("tool", [f"d{i}" for i in range(dofs)], "1")]), values, RATE)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            InteractionPrimitive.fit(shown)
        return [str(warning.message) for warning in caught]

    assert "tool turns over" in said(3, [v + n for v, n in zip(vectors, noise, strict=True)])[0]
    assert "tool changes its sign" in said(4, flipped)[0]
    assert said(4, quaternions) == []
    assert said(3, [torch.stack([angle, angle, 3 * angle], -1) for angle in turns]) == []
    assert "d1 jumps" in said(2, [torch.stack([angle, wrapped(angle)], -1) for angle in turns])[0]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"kind": "euler"}, "kind must be one of plain, angle, got 'euler'"),
        ({"unit": "m", "kind": "angle"}, "angles are in rad, or deg, got the unit 'm'"),
        ({"kind": "angle", "centre": [0.0, 1.0]}, "a centre is one angle for each of 1"),
        ({"centre": [0.0]}, "a centre"),
    ],
)
def test_what_is_no_angle_is_named(options: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Modality("head", ["yaw"], **{"unit": "rad", **options})
