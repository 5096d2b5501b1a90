"""eBIP against the paper's box written in numpy, and the contract in three configurations."""

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from tests.filtering.contract import FilterContract
from torch_ebip import (
    AboveOne,
    BSplineBasis,
    Demonstrations,
    EnsembleFilter,
    Huber,
    InteractionPrimitive,
    Positive,
    StudentT,
    ebip,
)


class TestPlain(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> EnsembleFilter:
        return ebip(small_primitive(dtype))

    def make_without_draws(self) -> EnsembleFilter:
        return silent(ebip(small_primitive(torch.float64), square_root=True))


class TestEverything(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> EnsembleFilter:
        primitive = small_primitive(dtype)
        one = primitive.weights.new_tensor(1.01)
        options = {"context": BSplineBasis(4), "localise": True, "inflation": AboveOne(one), "weight_noise": 0.01}
        return ebip(primitive, 20, **options, weigh=True, robust=StudentT())

    def make_without_draws(self) -> EnsembleFilter:
        primitive = small_primitive(torch.float64)
        one = primitive.weights.new_tensor(1.01)
        options = {"context": BSplineBasis(4), "localise": True, "inflation": AboveOne(one)}
        return silent(ebip(primitive, 20, **options, weigh=True, square_root=True, robust=Huber()))


def silent(filter: EnsembleFilter) -> EnsembleFilter:
    """Without process noise: nothing is drawn that matters."""

    class Silent(torch.nn.Module):
        def forward(self, members, dt, generator=None):
            return members

    filter.model.process_noise = Silent()
    return filter


def test_the_papers_algorithm() -> None:
    """Steps 1 to 5 of the box, member by member in numpy, with draws from the same generator."""
    primitive = small_primitive(torch.float64)
    made = ebip(primitive)
    made_y = interactions(2, seed=9, dtype=torch.float64)[1][:15]
    observed = np.array([True, True, True, False, False])
    ours, theirs = (torch.Generator().manual_seed(0) for _ in range(2))
    trace = made(made_y, torch.tensor(observed).expand(15, 5), generator=theirs)
    forecast = made.forecast(trace.state, torch.tensor([1.0]))

    def drawn(columns: int) -> np.ndarray:
        return torch.randn(len(primitive), columns, generator=ours, dtype=torch.float64).numpy()

    W, velocity = primitive.weights.numpy(), primitive.phase_velocity.numpy()
    E = len(W)
    X = np.concatenate([np.zeros((E, 1)), velocity[:, None], W], 1)
    R = np.diag(primitive.residual_variance.numpy())[observed][:, observed]
    dt = 1 / 30
    with torch.no_grad():
        L = made.model.process_noise.phase.cholesky(torch.tensor(dt).double()).numpy()

    def h(x: np.ndarray, phase: float) -> np.ndarray:
        features = BSplineBasis(6)(torch.tensor(phase, dtype=torch.float64)).numpy()
        return x[2:].reshape(5, 6) @ features

    for t in range(15):
        if t:
            noise = drawn(2) @ L.T
            for j in range(E):
                X[j, 0] += X[j, 1] * dt
                X[j, :2] += noise[j]
        eps = drawn(3) * np.sqrt(np.diag(R))
        HX = np.stack([h(x, x[0])[observed] for x in X])
        A, HA = X - X.mean(0), HX - HX.mean(0)
        S = HA.T @ HA / (E - 1) + R
        K = A.T @ HA / (E - 1) @ np.linalg.inv(S)
        y = made_y.numpy()[t, observed]
        X = np.stack([X[j] + K @ (y + eps[j] - HX[j]) for j in range(E)])
        np.testing.assert_allclose(trace.phase[t].item(), X[:, 0].mean(), atol=1e-8)
        np.testing.assert_allclose(trace.projection[t].detach(), np.mean([h(x, x[0]) for x in X], 0), atol=1e-7)
    assert torch.equal(ours.get_state(), theirs.get_state())
    np.testing.assert_allclose(trace.state.members.detach().numpy(), X, atol=1e-7)
    ends = np.stack([h(x, 1.0) for x in X])
    np.testing.assert_allclose(forecast.mean[0].detach().numpy(), h(X.mean(0), 1.0), atol=1e-7)
    np.testing.assert_allclose(forecast.variance[0].detach().numpy(), ends.var(0, ddof=1), rtol=1e-5)


def test_members_are_demonstrations() -> None:
    primitive = small_primitive()
    made = ebip(primitive)
    everyone = made.initial_state((2,)).members
    assert torch.equal(everyone[0, :, 2:], primitive.weights)
    assert torch.equal(everyone[1, :, 1], primitive.phase_velocity)
    assert not everyone[..., 0].any()
    chosen = made.initial_state(demonstrations=torch.tensor([[3, 1, 1], [0, 2, 5]])).members
    assert torch.equal(chosen[0, :, 2:], primitive.weights[[3, 1, 1]])
    drawn = ebip(primitive, 100).initial_state((4,), generator=torch.Generator().manual_seed(0)).members
    assert drawn.shape[:2] == (4, 100)
    assert not torch.equal(drawn[0], drawn[1])
    matches = (drawn[..., None, 2:] == primitive.weights).all(-1).any(-1)
    assert matches.all()


def test_bad_members_are_named() -> None:
    made = ebip(small_primitive())
    with pytest.raises(ValueError, match="must be numbered 0 to 23, got 0 to 24"):
        made.initial_state(demonstrations=torch.tensor([0, 24]))
    with pytest.raises(ValueError, match="must be int64"):
        made.initial_state(demonstrations=torch.tensor([0.0, 1.0]))
    with pytest.raises(ValueError, match="at least 2 members"):
        ebip(small_primitive(), 1)


def test_leaving_out_dofs_that_nobody_asks_for_is_exact() -> None:
    primitive = small_primitive(torch.float64)
    one = primitive.weights.new_tensor(1.01)
    whole = ebip(
        primitive, context=BSplineBasis(4), localise=True, inflation=AboveOne(one), square_root=True, weigh=True
    )
    y, observed = interactions(2, seed=3, dtype=torch.float64).pad()
    y, observed = y[:, :20], observed[:, :20] & torch.tensor([True, False, True, False, False])
    dofs = torch.tensor([True, False, True, False, True])
    part = whole.restrict(dofs)
    a = whole(y, observed, generator=torch.Generator().manual_seed(0))
    b = part(y[..., dofs], observed[..., dofs], generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(a.projection[..., dofs], b.projection)
    torch.testing.assert_close(a.log_likelihood, b.log_likelihood)
    assert {id(p) for p in part.parameters()} <= {id(p) for p in whole.parameters()}


def test_thinning_stands_for_the_samples_left_out() -> None:
    """For slow signals every fourth sample with a quarter of R gives nearly what all of them give."""
    primitive = small_primitive(torch.float64)
    made = ebip(primitive, residual_variance=1000 * primitive.residual_variance, square_root=True)
    y, observed = interactions(3, seed=3, dtype=torch.float64).pad()
    y, observed = y[:, :29], observed[:, :29] & torch.tensor([True, True, True, False, False])
    every = torch.ones(5, dtype=torch.bool)
    full = made.forecast(made(y, observed, generator=torch.Generator().manual_seed(0)).state, torch.ones(1))
    thin = made.restrict(every, 4)
    assert thin.dt == pytest.approx(4 * made.dt)
    trace = thin(y[:, ::4], observed[:, ::4], generator=torch.Generator().manual_seed(0))
    sparse = thin.forecast(trace.state, torch.ones(1))
    prior = made.forecast(made.initial_state((3,)), torch.ones(1))
    assert (full.mean - sparse.mean).abs().max() < 0.2 * (full.mean - prior.mean).abs().max()
    torch.testing.assert_close(full.variance, sparse.variance, rtol=0.2, atol=0)


def test_restricting_twice_is_restricting_once() -> None:
    primitive = small_primitive(torch.float64)
    whole = ebip(primitive, square_root=True, weigh=True, context=BSplineBasis(4), weight_noise=0.1)
    y, observed = interactions(2, seed=3, dtype=torch.float64).pad()
    y, observed = y[:, :20:4], observed[:, :20:4]
    first, last = torch.tensor([False, True, True, False, True]), torch.tensor([False, False, True, False, True])
    once, twice = whole.restrict(last, 4), whole.restrict(first, 2).restrict(last[first], 2)
    assert twice.stride == once.stride == 4
    assert twice.dt == pytest.approx(once.dt)
    a, b = (f(y[..., last], observed[..., last], generator=torch.Generator().manual_seed(0)) for f in (once, twice))
    torch.testing.assert_close(a.projection, b.projection)
    torch.testing.assert_close(a.state.weights, b.state.weights)


def test_a_dof_that_never_moved_is_no_evidence() -> None:
    made = interactions(8)
    still = [torch.cat([t[:, :2], torch.full_like(t[:, :1], 1.3), t[:, 3:]], -1) for t in made]
    primitive = InteractionPrimitive.fit(Demonstrations(made.layout, still, 30.0), small_primitive().basis)
    assert primitive.value_variance[2] == 0
    filter = ebip(primitive, square_root=True, weigh=True)
    state, _ = filter.update(filter.initial_state(), torch.tensor([0.1, 0.9, 1.4, 0.0, 0.0]))
    assert state.weights.isfinite().all()
    assert state.mean.isfinite().all()


def test_evidence_favours_the_demonstration_that_is_repeated() -> None:
    primitive = small_primitive(torch.float64)
    made = ebip(primitive, square_root=True, weigh=True, residual_variance=100 * primitive.residual_variance)
    made.analysis.weighting.sharpness.start.fill_(1000.0)
    y = interactions(dtype=torch.float64)[4]
    trace = made(y, ~y.isnan() & torch.tensor([True, True, True, False, False]))
    assert trace.state.weights.argmax().item() == 4
    assert trace.state.weights.sum().item() == pytest.approx(1)
    assert trace.state.weights.min() >= made.analysis.weighting.defensive / 24 - 1e-12


def test_filters_of_one_primitive_do_not_share_parameters() -> None:
    primitive = small_primitive()
    a, b = ebip(primitive), ebip(primitive)
    assert not {id(p) for p in a.parameters()} & {id(p) for p in b.parameters()}
    with torch.no_grad():
        a.model.measurement_noise.variance.raw.add_(1)
    torch.testing.assert_close(b.model.measurement_noise().square(), primitive.residual_variance)


@pytest.mark.parametrize("square_root", [False, True])
@pytest.mark.parametrize("factor", [1, 100])
def test_members_that_ran_past_the_end_are_called_back(square_root: bool, factor: float) -> None:
    """Interactions at half speed with blind sensors from 5 to 60 %: by then the phase has run to the end.

    With the phase left to itself, or the basis clamped, the updates after the gap drive it to 2 and beyond.
    """
    primitive = small_primitive(torch.float64)
    made = ebip(primitive, square_root=square_root, residual_variance=factor * primitive.residual_variance)
    errors, before = [], []
    for index, trajectory in enumerate(interactions(20, seed=11, dtype=torch.float64)):
        quick = trajectory.nan_to_num().T.unsqueeze(0)
        slow = torch.nn.functional.interpolate(quick, size=2 * quick.shape[-1], mode="linear", align_corners=True)[
            0
        ].T
        length = len(slow)
        observed = torch.tensor([True, True, True, False, False]).expand(length, 5).clone()
        observed[int(0.05 * length) : int(0.6 * length)] = False
        stop = int(0.9 * length)
        with torch.no_grad():
            generator = torch.Generator().manual_seed(index)
            phase = made(slow[:stop], observed[:stop], generator=generator, project=False).phase
        before.append(phase[int(0.6 * length) - 1])
        errors.append((phase[-1] - 0.9).abs())
    assert torch.stack(before).mean() > 0.9
    assert torch.stack(errors).max() < 0.2


def test_a_failing_factorisation_names_the_dofs() -> None:
    made = ebip(small_primitive())
    state = made.initial_state()
    state.deviations[0, 2] = torch.nan
    with pytest.raises(ValueError, match=r"hand\.x"):
        made.update(state, torch.zeros(5))


def test_positive_scales_are_what_parameters_are() -> None:
    names = [name for name, module in ebip(small_primitive()).named_modules() if isinstance(module, Positive)]
    assert "model.measurement_noise.variance" in names
    assert "model.process_noise.phase.acceleration" in names
