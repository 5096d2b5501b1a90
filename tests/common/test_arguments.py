"""What callers hand in is taken as it is meant, whatever library it comes from, or refused by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import torch_ebip
from tests.conftest import interactions, layout, small_primitive
from torch_ebip import (
    BSplineBasis,
    ConstantVelocityPhase,
    Demonstrations,
    DemonstrationTable,
    EvidenceWeighting,
    Filter,
    GaussianBasis,
    InteractionPrimitive,
    InteractionSession,
    Layout,
    LiveFilter,
    Modality,
    PolynomialBasis,
    Positive,
    RobotArm,
    SessionSettings,
    StackedBasis,
    StateSpace,
    StudentT,
    Tuner,
    TuningSettings,
    bip,
    ebip,
    ebip_minus,
    particle_filter,
)
from torch_ebip.common.arguments import as_count, as_indices, as_mask, as_number, as_seconds, as_values
from torch_ebip.learning.objective import ForecastObjective, Weights
from torch_ebip.recordings.repeats import longest_repeats

FILTERS: dict[str, Callable[[InteractionPrimitive], Filter]] = {
    "ebip": lambda p: ebip(p, square_root=True),
    "ebip, weight noise": lambda p: ebip(p, weight_noise=0.05),
    "bip": bip,
    "particle": lambda p: particle_filter(p, weight_noise=0.05),
}


class Frame:
    """What a data frame is to us: columns with names, some of which can be asked for."""

    def __init__(self, array: np.ndarray, columns: list[str]) -> None:
        self.array, self.columns = array, columns

    def __getitem__(self, names: list[str]) -> Frame:
        return Frame(self.array[:, [self.columns.index(name) for name in names]], names)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self.array


@given(st.lists(st.booleans(), min_size=6, max_size=6).filter(any))
def test_a_mask_picks_what_it_marks_in_whatever_it_comes(mask: list[bool]) -> None:
    made = Demonstrations(layout(), [torch.full((10, 5), float(i)) for i in range(6)], 30.0, {"number": np.arange(6)})
    wanted = [i for i, chosen in enumerate(mask) if chosen]
    kinds = (list, tuple, np.array, torch.tensor)
    for same in [kind(which) for kind in kinds for which in (mask, wanted)]:
        chosen = made.subset(same)
        assert [int(t[0, 0]) for t in chosen] == wanted
        assert chosen.columns["number"].tolist() == wanted
    assert as_indices("demonstration", [i - 6 for i in wanted], 6).tolist() == wanted


def test_demonstrations_and_their_primitive_understand_the_same_masks() -> None:
    made, primitive = interactions(12), small_primitive(count=12)
    mask = [i % 3 == 0 for i in range(12)]
    for same in (mask, np.array(mask), torch.tensor(mask), [0, 3, 6, 9], np.array([0, -9, 6, 9])):
        assert torch.equal(primitive.subset(same).weights, primitive.weights[[0, 3, 6, 9]])
        assert len(made.subset(same)) == 4
    for thing in (made, primitive):
        for wrong, message in (
            ([0.9, 1.9], "must be integers"),
            (torch.tensor([True] * 11), r"bool \[12\]"),
            ([True, 1], "mixes booleans and indices"),
            ([12], r"no demonstration \[12\]; there are 12"),
            ([-13], "no demonstration"),
            (torch.zeros(2, 2, dtype=torch.long), "must be integers"),
            (["0"], "must be a tensor, an array or lists"),
        ):
            with pytest.raises(ValueError, match=message):
                thing.subset(wrong)


@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize("dt", [-1 / 60, math.nan, math.inf, torch.tensor(-0.1), torch.tensor([0.1, math.nan]), True])
def test_time_does_not_run_backwards(kind: str, dt: Any) -> None:
    made = FILTERS[kind](small_primitive())
    message = "dt must be a finite number >= 0"
    with pytest.raises(ValueError, match=message):
        made.predict(made.initial_state((2,)), dt)
    for gradients in (True, False):
        with torch.set_grad_enabled(gradients), pytest.raises(ValueError, match=message):
            made(torch.ones(2, 4, 5), dt=dt)


@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize("shape", [(2, 4), (4,), (3, 2)])
def test_clocks_are_those_of_the_batch(kind: str, shape: tuple[int, ...]) -> None:
    """Not one for each sample."""
    made, dt = FILTERS[kind](small_primitive()), torch.full(shape, 0.03)
    message = r"dt must be a number, or one for each of a batch \[2\], got"
    with pytest.raises(ValueError, match=message):
        made.predict(made.initial_state((2,)), dt)
    with pytest.raises(ValueError, match=message):
        made(torch.ones(2, 4, 5), dt=dt)
    assert made(torch.ones(2, 4, 5), dt=dt.flatten()[:2]).phase.shape == (2, 4)


@pytest.mark.parametrize("dt", [-1 / 60, math.nan, math.inf])
def test_nor_live(dt: float) -> None:
    live = LiveFilter(ebip(small_primitive()))
    before = live.state
    with pytest.raises(ValueError, match="dt must be a"):
        live.predict(dt)
    assert torch.equal(live.state.deviations, before.deviations)


@pytest.mark.parametrize("kind", FILTERS)
def test_standing_still_is_allowed(kind: str) -> None:
    made = FILTERS[kind](small_primitive())
    state = made.initial_state()
    for dt in (0, 0.0, torch.tensor(0.0), np.float32(0)):
        after = made.predict(state, dt, torch.Generator().manual_seed(0))
        torch.testing.assert_close(after.mean, state.mean)


@pytest.mark.parametrize("kind", FILTERS)
def test_measurements_of_other_kinds(kind: str) -> None:
    made = FILTERS[kind](small_primitive())
    y = interactions(3, seed=7)[1][:12]
    reverse = list(reversed(layout().dofs))
    answers = []
    for same in (
        y,
        y.double(),
        y.numpy(),
        y.double().numpy(),
        y.tolist(),
        np.ma.masked_array(y.nan_to_num().numpy(), y.isnan().numpy()),
        Frame(y.numpy()[:, ::-1], reverse),
        np.asfortranarray(y.numpy()),
        y.numpy().astype(">f4"),
    ):
        trace = made(same, generator=torch.Generator().manual_seed(0))
        answers.append(made.forecast(trace.state, 1.0).mean)
    for answer in answers[1:]:
        assert answer.dtype == torch.float32
        torch.testing.assert_close(answer, answers[0])
    state = trace.state
    for phase in ([1.0], np.array([1.0]), torch.tensor(1.0), torch.tensor([1.0], dtype=torch.float64)):
        assert torch.equal(made.forecast(state, phase).mean, answers[-1])
    for wrong, message in (
        (y.half(), "32 or 64 bits"),
        (y > 0, "floating-point numbers"),
        (y.numpy() > 0, "real numbers"),
        (y.long(), "floating-point numbers"),
        (np.array(["a"]), "tensor, an array or lists of numbers"),
        (Frame(y.numpy(), list("abcde")), "frame without the columns hand.x"),
        (y.numpy().astype(complex), "real numbers"),
        (None, "tensor, an array or lists of numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            made(wrong)
    with pytest.raises(ValueError, match="phases must be finite"):
        made.forecast(state, math.nan)
    with pytest.raises(ValueError, match=r"dofs must be bool \[5\], got int64 \[2\]"):
        made.restrict(torch.tensor([0, 2]))


def test_live_measurements_of_other_kinds() -> None:
    y = interactions(3, seed=7)[1][0]
    states = []
    for same in (y, y.numpy(), y.tolist(), y.double().numpy()):
        live = LiveFilter(ebip(small_primitive(), square_root=True))
        live.update(same)
        states.append(live.state.deviations)
    assert all(torch.equal(state, states[0]) for state in states)


def test_demonstrations_of_other_kinds() -> None:
    made = interactions(4)
    plain = InteractionPrimitive.fit(made, StackedBasis([BSplineBasis(6)] * 5))
    reverse = list(reversed(layout().dofs))
    for convert in (
        lambda t: t.numpy(),
        lambda t: t.tolist(),
        lambda t: Frame(t.numpy()[:, ::-1], reverse),
        lambda t: np.ma.masked_invalid(t.numpy()),
    ):
        again = Demonstrations(made.layout, [convert(t) for t in made], 30)
        for a, b in zip(again, made, strict=True):
            torch.testing.assert_close(a, b, equal_nan=True)
        torch.testing.assert_close(InteractionPrimitive.fit(again, plain.basis).weights, plain.weights)
    assert Demonstrations(made.layout, [t.double().numpy() for t in made], 30.0)[0].dtype == torch.float64
    for wrong in (made[0].half(), made[0].long(), [["a"] * 5] * 3):
        with pytest.raises(ValueError, match="demonstration 0 must"):
            Demonstrations(made.layout, [wrong], 30.0)
    for rate in (True, "30", None, 0, -1, math.inf):
        with pytest.raises(ValueError, match="rate must be a"):
            Demonstrations(made.layout, list(made), rate)


PRIMITIVE = small_primitive()


def evidence(**options: float) -> EvidenceWeighting:
    """For one DoF that never moves."""
    table = DemonstrationTable(torch.zeros(2, 3, 1), torch.zeros(2, 3, 1))
    return EvidenceWeighting(table, torch.ones(1), torch.zeros(1, dtype=torch.long), **options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ebip(PRIMITIVE, 10.0), "n_members must be a whole number, got 10.0"),
        (lambda: ebip(PRIMITIVE, True), "n_members must be a whole number"),
        (lambda: ebip(PRIMITIVE, 1), "at least 2 members"),
        (lambda: ebip(PRIMITIVE, inflation=-1.0), "inflation must be a positive number, got -1.0"),
        (lambda: ebip(PRIMITIVE, inflation=math.nan), "inflation must be a positive number"),
        (lambda: ebip(PRIMITIVE, residual_variance=torch.ones(2)), r"residual_variance must be \[5\].*got \[2\]"),
        (lambda: ebip(PRIMITIVE, residual_variance=torch.full((5,), math.nan)), "variance must be positive"),
        (lambda: ebip(PRIMITIVE, weight_noise=-1.0), "weight_noise must be a positive number"),
        (lambda: ebip(PRIMITIVE, weigh=True, sharpness=math.nan), "sharpness must be a positive number"),
        (lambda: ebip_minus(PRIMITIVE, 20, max_components=1.5), "max_components must be a whole number"),
        (lambda: bip(PRIMITIVE, shrinkage=math.nan), "shrinkage must lie between 0 and 1"),
        (lambda: particle_filter(PRIMITIVE, softness=math.nan), "softness must be a finite"),
        (lambda: StudentT(math.nan), "scale must be a finite number"),
        (lambda: StudentT("4"), "scale must be a number"),
        (lambda: Positive(torch.tensor([1.0, math.inf])), "must start above 0"),
        (lambda: ConstantVelocityPhase(0.0), "overrun must be a positive number"),
        (lambda: evidence(wander=0), "wander must be a positive number"),
        (lambda: GaussianBasis(5.0), "n_features of GaussianBasis must be a whole number"),
        (lambda: GaussianBasis(5, width=math.nan), "width must be a positive number"),
        (lambda: PolynomialBasis(2.5), "degree of PolynomialBasis must be a whole number"),
        (lambda: BSplineBasis(6, degree=2.0), "degree of BSplineBasis must be a whole number"),
        (lambda: StackedBasis([6]), "needs bases, one for each DoF, got 6"),
        (lambda: StackedBasis([GaussianBasis(3)] * 2).select([0]), r"dofs must be bool \[2\], got int64 \[1\]"),
        (lambda: InteractionPrimitive.fit(interactions(4), GaussianBasis(5)), "must be a StackedBasis"),
        (lambda: interactions(4).folds(2.0), "folds must be a whole number"),
        (lambda: Modality("a", ["x"], "m", controlled="no"), "controlled must be True or False"),
        (lambda: Modality("a", [1], "m"), "names and units must be text, got 1"),
        (lambda: Modality("a", ["x\x1b[2J"], "m"), "must be printable"),
        (lambda: Modality("a\x00", ["x"], "m"), "must be printable"),
        (lambda: Layout(["a"]), "consists of modalities"),
        (lambda: ebip(PRIMITIVE)(torch.ones(3, 5), segment=0), "segment must be at least 1"),
        (lambda: ebip(PRIMITIVE)(torch.ones(3, 5), segment=1.5), "segment must be a whole number"),
        (lambda: ebip(PRIMITIVE)(torch.ones(3, 5), keep=torch.tensor([1.0])), "keep must be"),
        (lambda: ebip(PRIMITIVE).initial_state(demonstrations=[0, 1]), "demonstrations must be a tensor"),
        (lambda: LiveFilter(ebip(PRIMITIVE), torch.tensor([0, 1])), r"dofs must be bool \[5\]"),
        (lambda: LiveFilter(ebip(PRIMITIVE)).forecast(1.0, [0, 1]), r"dofs must be bool \[5\]"),
        (lambda: TuningSettings(steps=10.0), "steps must be a whole number"),
        (lambda: TuningSettings(learning_rate=math.nan), "learning_rate must be a positive number"),
        (lambda: TuningSettings(pull=-1.0), "pull must be a finite and not negative number"),
        (lambda: TuningSettings(only="*"), "only must be a sequence of patterns"),
        (lambda: TuningSettings(folds=1), "folds must be at least 2"),
        (lambda: ForecastObjective(PRIMITIVE, torch.tensor([3, 4])), r"targets must be bool \[5\]"),
        (lambda: ForecastObjective(PRIMITIVE, layout().controlled, weights=Weights(-1.0)), "weight of crps"),
        (lambda: ForecastObjective(PRIMITIVE, layout().controlled, torch.tensor([1.5])), r"phases must be \[P\]"),
        (lambda: SessionSettings(seed=1.5), "seed must be a whole number"),
        (lambda: SessionSettings(window=math.nan), "window must be a"),
        (lambda: SessionSettings(frozen_after={"hand": 0.0}), "frozen_after of 'hand' must be a positive number"),
        (
            lambda: InteractionSession(ebip(PRIMITIVE), PRIMITIVE, None, SessionSettings(frozen_after={"leg": 1.0})),
            "frozen_after names leg; the sensors are hand, gaze",
        ),
    ],
)  # fmt: skip
def test_what_is_not_meant_is_refused_by_name(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


@given(st.one_of(st.floats(), st.booleans(), st.text(max_size=3), st.none(), st.lists(st.integers(), max_size=2)))
def test_nothing_but_integers_is_a_count(value: Any) -> None:
    with pytest.raises(ValueError, match="n must be a whole number"):
        as_count("n", value)


@given(st.integers(1, 2**40))
def test_integers_of_any_library_are(value: int) -> None:
    assert as_count("n", value) == as_count("n", np.int64(value)) == as_count("n", torch.tensor(value)) == value
    double = torch.tensor(value, dtype=torch.float64)
    assert as_number("x", value) == as_number("x", np.float64(value)) == as_number("x", double) == value
    assert as_seconds(np.float32(value), torch.ones(1)).dtype == torch.float32


def test_masks_and_values_keep_what_they_are() -> None:
    assert as_mask("m", (True, False), 2).tolist() == [True, False]
    whole = as_values("v", [[1, 2]], None)
    assert whole.dtype == torch.get_default_dtype()
    source = np.ones((2, 2), np.float32)
    values = as_values("v", source, None)
    source[:] = 0
    assert values.sum() == 4  # memory of its own


def test_more_that_is_refused_by_name() -> None:
    """Lists of booleans live and in arms, columns of another number, joints by name from frames."""
    live = LiveFilter(ebip(PRIMITIVE))
    live.update([0.0] * 5, [True, False, True, False, False])
    made = ebip(PRIMITIVE)
    model = made.model
    with pytest.raises(ValueError, match=r"a MeasurementNoise, is of \[5\] DoFs, the model has 2"):
        StateSpace(model.dynamics, model.measurement, None, model.measurement_noise, ("a", "b"), 0.1)
    with pytest.raises(ValueError, match="leaves no function beside the offset"):
        GaussianBasis(1, offset=True)
    arm = RobotArm.ur5()
    joints = np.zeros((2, 6), np.float32)
    assert torch.equal(arm(joints), arm(torch.zeros(2, 6)))
    assert torch.equal(arm(Frame(joints, list(arm.joint_names))), arm(torch.zeros(2, 6)))
    observed = [[True] * 3 + [False] * 2] * 4
    trace = ebip(PRIMITIVE, square_root=True)(torch.ones(4, 5), observed, generator=torch.Generator().manual_seed(0))
    assert trace.phase.shape == (4,)
    with pytest.raises(ValueError, match="horizons must be"):
        TuningSettings(horizons=(0.9, 0.2))
    sparse = interactions(4)[0].clone()
    sparse[:, 2] = math.nan
    sparse[3, 2] = 1.0
    assert longest_repeats(Demonstrations(layout(), [sparse], 30.0)).tolist()[1] == 0.0
    with pytest.raises(ValueError, match="validation must be a share"):
        TuningSettings(validation=1.0)
    targets, subsets = layout().controlled, {"a": layout().mask(["hand"])}
    objective = ForecastObjective(PRIMITIVE, targets)
    assert "targets=arm.1, arm.2" in repr(objective)
    with pytest.raises(ValueError, match="5 demonstrations, but the primitive has 24"):
        Tuner(ebip(PRIMITIVE), interactions(5), PRIMITIVE, objective, targets, subsets)
    hand, *rest = layout().modalities
    swapped = Layout([Modality("hand", hand.dofs[::-1], "m"), *rest])
    moved = InteractionPrimitive.fit(Demonstrations(swapped, list(interactions()), 30.0), PRIMITIVE.basis)
    with pytest.raises(ValueError, match="the filter has other columns than the primitive"):
        Tuner(ebip(moved), interactions(), PRIMITIVE, objective, targets, subsets)


def test_a_package_that_nobody_installed_has_no_version(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.version", missing)
    assert torch_ebip.__version__ == "unknown"
