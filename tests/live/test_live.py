"""The live path gives the numbers of the differentiable one, whatever it keeps and whatever it puts off."""

import copy
import gc
import pickle
import weakref
from collections import OrderedDict
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.conftest import interactions, small_primitive
from torch_ebip import (
    BSplineBasis,
    ConstantVelocityPhase,
    EnsembleFilter,
    EnsembleState,
    GaussianBasis,
    Huber,
    InteractionPrimitive,
    LiveFilter,
    StackedBasis,
    StudentT,
    Trace,
    ebip,
)
from torch_ebip.filtering.carriers.columns import ColumnMembers
from torch_ebip.filtering.carriers.plan import PLANS, kept

HUMAN = torch.tensor([True, True, True, False, False])
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "square root": {"square_root": True},
    "inflation": {"inflation": 1.01},
    "evidence": {"weigh": True},
    "context": {"context": BSplineBasis(4)},
    "all": {"square_root": True, "inflation": 1.02, "weigh": True, "context": BSplineBasis(4)},
    "robust": {"robust": StudentT()},
    "all and robust": {
        "square_root": True,
        "inflation": 1.02,
        "weigh": True,
        "context": BSplineBasis(4),
        "robust": Huber(1.0),
    },
}


def sequences(length: int = 30) -> tuple[Tensor, Tensor]:
    """Three interactions [3, T, 5] with the same gaps: single DoFs, whole samples, another order."""
    values, _ = interactions(3, seed=7, dtype=torch.float64).pad()
    observed = HUMAN.expand(3, length, 5).clone()
    observed[:, 4:8, 0] = False
    observed[:, 5, 1:] = False
    observed[:, 9:13] = False
    observed[:, 14, 1] = False
    return torch.nan_to_num(values[:, :length]), observed


def run(live: LiveFilter, y: Tensor, observed: Tensor) -> Tensor:
    """Log-likelihoods [..., T] of a sequence."""
    likelihoods = []
    for t in range(y.shape[-2]):
        if t:
            live.predict()
        likelihoods.append(live.update(y[..., t, :], observed[..., t, :]))
    return torch.stack(likelihoods, -1)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("batch", [(), (3,)], ids=["single", "batch"])
@pytest.mark.parametrize(("members", "sensors"), [(None, None), (10, HUMAN), (4, HUMAN)])
def test_the_numbers_of_the_filter(
    options: dict[str, Any], batch: tuple[int, ...], members: int | None, sensors: Tensor | None
) -> None:
    """With 4 or 10 members the 12 weights of the arm are behind the transform, with 24 they are not."""
    filter = ebip(small_primitive(torch.float64), members, **options)
    for name, parameter in filter.named_parameters():  # as tuning would leave it
        generator = torch.Generator().manual_seed(len(name))
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
    y, observed = sequences()
    y, observed = (y, observed) if batch else (y[0], observed[0])
    trace = filter(y, observed, generator=torch.Generator().manual_seed(1))
    live = LiveFilter(filter, sensors, batch, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(run(live, y, observed), trace.log_likelihood)
    torch.testing.assert_close(live.state.members, trace.state.members)
    torch.testing.assert_close(live.phase, trace.phase[..., -1])
    if trace.state.memory.weighting is not None:
        for mine, theirs in zip(live.state.memory.weighting, trace.state.memory.weighting, strict=True):
            torch.testing.assert_close(mine, theirs)
    expected = filter.forecast(trace.state)
    for dofs in (None, ~HUMAN, torch.tensor([False, True, False, True, False])):
        forecast = live.forecast(dofs=dofs)
        chosen = slice(None) if dofs is None else dofs
        torch.testing.assert_close(forecast.mean, expected.mean[..., chosen])
        torch.testing.assert_close(forecast.variance, expected.variance[..., chosen])
        torch.testing.assert_close(forecast.phase, expected.phase)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("project", [False, True])
@pytest.mark.parametrize("members", [None, 4])
def test_a_sequence_without_gradients(options: dict[str, Any], project: bool, members: int | None) -> None:
    """Entries of the batch with gaps of their own; restricted and thinned, as tuning uses it."""
    filter = ebip(small_primitive(torch.float64), members, **options)
    y, _ = sequences()
    observed = torch.rand(y.shape, generator=torch.Generator().manual_seed(5)) < 0.7
    observed[..., 3:] = False
    observed[1, 6:9] = False
    observed[:, 20] = False
    y[~observed] = torch.nan
    keep = torch.tensor([[3, 9], [0, 29], [9, 9]])
    for made, columns in (
        (filter, slice(None)),
        (filter.restrict(torch.tensor([1, 1, 0, 1, 0]).bool(), 2), [0, 1, 3]),
    ):
        arguments = (y[..., columns], observed[..., columns])
        options_ = {"keep": keep, "project": project}
        with_gradients = made(*arguments, generator=torch.Generator().manual_seed(1), **options_)
        with torch.no_grad():
            without = made(*arguments, generator=torch.Generator().manual_seed(1), **options_)
        assert with_gradients.log_likelihood.requires_grad
        assert not without.log_likelihood.requires_grad
        for mine, theirs in zip(_leaves(without), _leaves(with_gradients), strict=True):
            torch.testing.assert_close(mine, theirs)


def _leaves(trace: Any) -> list[Tensor]:
    """The tensors in a trace."""
    if trace is None or isinstance(trace, (Tensor, str)):
        return [trace] if isinstance(trace, Tensor) else []
    parts = vars(trace).values() if isinstance(trace, Trace) else trace
    return [leaf for part in parts for leaf in _leaves(part)]


def test_bases_that_differ_between_modalities() -> None:
    bases = [BSplineBasis(6), BSplineBasis(6), GaussianBasis(7), GaussianBasis(5), BSplineBasis(6)]
    primitive = InteractionPrimitive.fit(interactions(24, dtype=torch.float64), StackedBasis(bases))
    filter = ebip(primitive, 5)
    y, observed = sequences()
    trace = filter(y[0], observed[0], generator=torch.Generator().manual_seed(1))
    live = LiveFilter(filter, HUMAN, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(run(live, y[0], observed[0]), trace.log_likelihood)
    torch.testing.assert_close(live.state.members, trace.state.members)


def test_steps_of_changing_length_and_chosen_members() -> None:
    filter, chosen = ebip(small_primitive(torch.float64)), torch.tensor([3, 1, 4, 15, 9, 2])
    y, observed = sequences()
    generator = torch.Generator().manual_seed(1)
    live = LiveFilter(filter, HUMAN, demonstrations=chosen, generator=torch.Generator().manual_seed(1))
    state = filter.initial_state((), chosen, generator)
    for t, dt in enumerate((0.01, 0.03, 0.03, 0.02)):
        state = filter.predict(state, dt, generator)
        live.predict(dt)
        state, _ = filter.update(state, y[0, t], observed[0, t], generator)
        live.update(y[0, t], observed[0, t])
    torch.testing.assert_close(live.state.members, state.members)


def test_float32_on_a_long_run_stays_close() -> None:
    """A thousand updates through the transform end where a thousand updates of everything do."""
    y, observed = sequences(20)
    ends = []
    for sensors in (None, HUMAN):
        live = LiveFilter(ebip(small_primitive(), 8), sensors, generator=torch.Generator().manual_seed(0))
        for _ in range(50):
            run(live, y[0].float(), observed[0])
        ends.append(live.state.members)
    torch.testing.assert_close(ends[0], ends[1], rtol=2e-2, atol=2e-3)


def test_nothing_measured_changes_nothing() -> None:
    live = LiveFilter(ebip(small_primitive(), weigh=True), HUMAN, generator=torch.Generator().manual_seed(0))
    before = live.state
    assert float(live.update(torch.full((5,), torch.nan))) == 0
    assert torch.equal(live.state.members, before.members)


def test_the_state_is_a_copy_and_leaves_the_demonstrations_alone() -> None:
    filter = ebip(small_primitive())
    demonstrations = filter.prior.states.clone()
    live = LiveFilter(filter, HUMAN)
    before = live.state.members
    kept = before.clone()
    live.update(torch.ones(5), HUMAN)
    assert torch.equal(before, kept)
    assert torch.equal(filter.prior.states, demonstrations)
    assert not torch.equal(live.state.members, kept)


@pytest.mark.parametrize(
    ("y", "observed", "message"),
    [
        (torch.ones(4), None, r"y must be \[5\]"),
        (torch.ones(5), None, r"DoFs \[3, 4\] are measured, but are none"),
        (torch.tensor([1, torch.inf, 1, 1, 1]), HUMAN, r"infinite where it is observed, in DoFs \[1\]"),
        (torch.ones(5), HUMAN.long(), "observed must be bool"),
        (torch.ones(5, dtype=torch.float64), None, "y must be torch.float32 on cpu"),
    ],
)
def test_what_is_refused_in_a_sample(y: Tensor, observed: Tensor | None, message: str) -> None:
    live = LiveFilter(ebip(small_primitive()), HUMAN)
    before = live.state.members
    with pytest.raises(ValueError, match=message):
        live.update(y, observed)
    assert torch.equal(live.state.members, before)


def test_what_is_refused_as_a_filter() -> None:
    primitive = small_primitive()
    with pytest.raises(ValueError, match="process noise"):
        LiveFilter(ebip(primitive, weight_noise=0.1))
    with pytest.raises(ValueError, match="localised"):
        LiveFilter(ebip(primitive, localise=True))
    with pytest.raises(ValueError, match=r"dofs must be bool \[5\]"):
        LiveFilter(ebip(primitive), torch.zeros(5, dtype=torch.bool))
    with pytest.raises(ValueError, match="at most one batch dimension"):
        LiveFilter(ebip(primitive), batch_shape=(2, 3))


def test_it_goes_when_nobody_holds_it() -> None:
    """Without waiting for the cyclic garbage collector, which knows nothing of a GPU's memory."""
    live = LiveFilter(ebip(small_primitive()), HUMAN)
    live.update(torch.ones(5), HUMAN)
    live.forecast(dofs=~HUMAN)
    gone = weakref.ref(live)
    gc.disable()
    try:
        del live
        assert gone() is None
    finally:
        gc.enable()


def test_only_so_many_plans_are_kept() -> None:
    filter = ebip(small_primitive(torch.float64), square_root=True)
    live, state = LiveFilter(filter), filter.initial_state()
    with torch.no_grad():
        for number in [*range(2, 32), *range(2, 32)]:  # each set of DoFs is measured twice
            observed = torch.tensor([bool(number >> bit & 1) for bit in range(5)])
            y = filter.project(state) + 0.01
            live.update(y, observed)
            state, _ = filter.update(state, y, observed)
    torch.testing.assert_close(live.state.members, state.members)
    store: OrderedDict[tuple[bool, ...], int] = OrderedDict()
    for number in range(PLANS + 5):
        kept(store, tuple(bool(number >> bit & 1) for bit in range(8)), lambda key: sum(key))
    assert len(store) == PLANS


def test_what_the_live_path_does_not_know_goes_the_other_way() -> None:
    """Dynamics of one's own, and measurements of another dtype, with and without gradients."""

    class Faster(ConstantVelocityPhase):
        def forward(self, members: Tensor, dt: Tensor) -> Tensor:
            return super().forward(members, 2 * dt)

    y, observed = sequences()
    filter = ebip(small_primitive(torch.float64))
    filter.model.dynamics = Faster()
    assert not filter.has_live_path
    with_gradients = filter(y, observed, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        without = filter(y, observed, generator=torch.Generator().manual_seed(0))
        filter(y.float(), observed)
    torch.testing.assert_close(without.phase, with_gradients.phase)


def test_generators_are_one_for_each_entry() -> None:
    filter = ebip(small_primitive())
    with pytest.raises(ValueError, match="24 generators"):
        LiveFilter(filter, generator=[torch.Generator() for _ in range(24)])


def test_a_covariance_that_cannot_be_factored_names_the_sensor() -> None:
    filter: EnsembleFilter = ebip(small_primitive())
    state = filter.initial_state()
    state.deviations[:, 2:] = torch.nan
    live = LiveFilter(filter, HUMAN, state=state)
    with pytest.raises(ValueError, match=r"cannot be factored.*hand\.x"):
        live.update(torch.ones(5), HUMAN)


def test_members_as_columns_are_what_they_were_started_with() -> None:
    start = torch.randn(2, 3, 12, generator=torch.Generator().manual_seed(0))
    for seen in (torch.arange(10), torch.tensor([1, 4, 5])):
        span = ColumnMembers(start, seen, 2)
        torch.testing.assert_close(span.members(torch.arange(10)), start)
        assert span.matrix.shape == (2, 2 + min(10, len(seen) + 3), 3)


@pytest.mark.parametrize("live", [True, False])
def test_a_filter_left_running_inflates_no_more_than_ten_times(live: bool) -> None:
    """1.01 a sample is 1.01^3000 = 10^13; without an end to it the weights that nobody measures run away."""
    made = ebip(small_primitive(), square_root=True, inflation=1.01)
    y = torch.where(HUMAN, interactions(2, seed=7)[1], torch.nan)
    at_work = LiveFilter(made, HUMAN, generator=torch.Generator().manual_seed(0))
    state = made.initial_state(generator=torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for t in range(600):
            if live:
                at_work.predict()
                at_work.update(y[t % 40])
            else:
                state = made.update(made.predict(state, made.dt, generator), y[t % 40])[0]
    state = at_work.state if live else state
    assert float(state.memory.inflation) == pytest.approx(10.0)
    hidden = slice(2 + 3 * 6, None)  # the arm's weights
    spread = state.members[:, hidden].std(0) / made.initial_state().members[:, hidden].std(0)
    assert spread.max() < 11


def test_what_has_grown_is_saved_and_loaded() -> None:
    live = LiveFilter(ebip(small_primitive(), inflation=1.05), generator=torch.Generator().manual_seed(0))
    y = interactions(2, seed=7)[1]
    live.update(y[0])
    snapshot, grown = live.save(), live.state.memory.inflation.clone()
    live.update(y[1])
    assert live.state.memory.inflation > grown > 1
    live.load(snapshot)
    assert torch.equal(live.state.memory.inflation, grown)


def test_a_state_that_somebody_made_has_not_grown() -> None:
    """Kept before anything was measured, and after."""
    made = ebip(small_primitive(), inflation=1.05)
    y = torch.nan_to_num(torch.stack([interactions(2, seed=7)[1][:8]] * 2))
    observed = torch.ones(2, 8, 5, dtype=torch.bool)
    observed[:, 0] = False
    state = EnsembleState(made.initial_state((2,)).members)
    kept = made(y, observed, state=state, keep=torch.tensor([[5], [0]])).kept
    torch.testing.assert_close(kept.memory.inflation.detach(), torch.tensor([[1.05**5], [1.0]]))


@pytest.mark.parametrize("options", [OPTIONS["plain"], OPTIONS["all and robust"]], ids=["plain", "all"])
def test_a_parameter_that_changes_is_noticed(options: dict[str, Any]) -> None:
    """By an optimiser's step, by loading: the live filter goes on with what the filter has now."""
    filter = ebip(small_primitive(torch.float64), **options)
    y, observed = sequences()
    generator = torch.Generator().manual_seed(1)
    state = filter.initial_state(generator=generator)
    live = LiveFilter(filter, HUMAN, generator=torch.Generator().manual_seed(1))
    other = ebip(small_primitive(torch.float64), **options).state_dict()
    for t in range(12):
        with torch.no_grad():
            if t in (3, 6):
                for name, parameter in filter.named_parameters():
                    parameter.add_(0.3 if t == 3 else -0.4 if "noise" in name else 0.1)
            if t == 9:
                filter.load_state_dict(other)
            if t:
                state = filter.predict(state, filter.dt, generator)
                live.predict()
            state, likelihood = filter.update(state, y[0, t], observed[0, t], generator)
            torch.testing.assert_close(live.update(y[0, t], observed[0, t]), likelihood)
    torch.testing.assert_close(live.state.members, state.members)


def test_parameters_of_inference_mode_are_never_kept() -> None:
    """They have no versions, so what depends on them is computed every time."""
    with torch.inference_mode():
        filter = ebip(small_primitive(torch.float64), weigh=True)
        live = LiveFilter(filter, HUMAN, generator=torch.Generator().manual_seed(0))
        y, observed = sequences()
        for t in range(3):
            live.predict()
            live.update(y[0, t], observed[0, t])
    assert live.finite


def others(filter: EnsembleFilter, way: str) -> EnsembleFilter:
    """The same filter, used before, with other parameters that came in some way."""
    with torch.no_grad():
        filter(sequences()[0], project=False)
        if way == "copied":
            filter = copy.deepcopy(filter)
        if way == "pickled":
            filter = pickle.loads(pickle.dumps(filter))
        if way == "assigned":
            state = {name: v + 0.5 if name.endswith("raw") else v for name, v in filter.state_dict().items()}
            filter.load_state_dict(state, assign=True)
        else:
            for parameter in filter.parameters():
                parameter.add_(0.5)
    if way == "exchanged":
        filter.analysis.trust[0] = Huber(1.0).double()
    return filter


@pytest.mark.parametrize("way", ["copied", "pickled", "assigned", "exchanged"])
def test_parameters_are_those_of_now_however_they_came(way: str) -> None:
    """What was kept for a filter of before, or for other tensors, is never taken for theirs."""
    y, observed = sequences()
    filter = ebip(small_primitive(torch.float64), **OPTIONS["all and robust"])
    with torch.no_grad():
        for parameter in filter.parameters():
            parameter.add_(0.1)
    filter = others(filter, way)
    expected = filter(y, observed, generator=torch.Generator().manual_seed(0))
    live = LiveFilter(filter, None, (3,), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(run(live, y, observed), expected.log_likelihood)
    with torch.no_grad():
        for engine in ("dense", "span"):
            found = filter(y, observed, generator=torch.Generator().manual_seed(0), engine=engine)
            torch.testing.assert_close(found.log_likelihood, expected.log_likelihood)


def test_a_live_filter_notices_assigned_parameters() -> None:
    filter = ebip(small_primitive(torch.float64), weigh=True)
    y, observed = sequences()
    live = LiveFilter(filter, HUMAN, generator=torch.Generator().manual_seed(0))
    live.update(y[0, 0], observed[0, 0])
    others(filter, "assigned")
    state, generator = live.state, torch.Generator().manual_seed(7)
    live.generator.set_state(generator.get_state())
    live.predict()
    with torch.no_grad():
        state = filter.predict(state, filter.dt, generator)
        _, expected = filter.update(state, y[0, 1], observed[0, 1], generator)
    torch.testing.assert_close(live.update(y[0, 1], observed[0, 1]), expected)


def test_a_copy_of_a_live_filter_is_its_own() -> None:
    live = LiveFilter(ebip(small_primitive(torch.float64)), HUMAN, generator=torch.Generator().manual_seed(0))
    y, observed = sequences()
    live.update(y[0, 0], observed[0, 0])
    other, before = copy.deepcopy(live), live.state.members
    run(other, y[0], observed[0])
    assert torch.equal(live.state.members, before)
    twin = copy.deepcopy(live)
    torch.testing.assert_close(run(twin, y[0], observed[0]), run(live, y[0], observed[0]))
