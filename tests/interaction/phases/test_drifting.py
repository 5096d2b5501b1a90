"""A phase without a velocity: the contract of every filter, an exact oracle, and what it promises."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.conftest import interactions, small_primitive
from tests.filtering.contract import FilterContract
from tests.interaction.phases.textbook import updated
from tests.interaction.test_ebip import silent
from torch_ebip import (
    DriftingPhase,
    InteractionFilter,
    InteractionSession,
    LiveFilter,
    bip,
    ebip,
    ebip_minus,
    particle_filter,
)

HUMAN = torch.tensor([True, True, True, False, False])


def drift(dtype: torch.dtype = torch.float32) -> DriftingPhase:
    return DriftingPhase(float(small_primitive(dtype).phase_velocity.mean()))


class TestEnsemble(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> InteractionFilter:
        return ebip(small_primitive(dtype), square_root=True, weigh=True, inflation=1.01, phase=drift(dtype))

    def make_without_draws(self) -> InteractionFilter:
        made = ebip(small_primitive(torch.float64), square_root=True, weigh=True, phase=drift(torch.float64))
        return silent(made)  # type: ignore[return-value]


class TestExtended(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> InteractionFilter:
        return bip(small_primitive(dtype), phase=drift(dtype))

    def make_without_draws(self) -> InteractionFilter:
        return self.make(torch.float64)


def test_the_extended_filter_is_that_of_the_textbook() -> None:
    """Predict and update with dense matrices in numpy: G and Q of order 0, H by finite differences."""
    primitive = small_primitive(torch.float64)
    made = bip(primitive, phase=drift(torch.float64), residual_variance=100 * primitive.residual_variance)
    y = interactions(2, seed=9, dtype=torch.float64)[1][:12].numpy()
    state = made.initial_state()
    mean, covariance = state.mean.numpy(), state.covariance.numpy()
    dt = made.dt
    rate = float(primitive.phase_velocity.mean())
    q = float(made.model.process_noise.phase.strength.value.detach()) ** 2 * dt
    R = np.diag(made.model.measurement_noise().detach().numpy()[:3] ** 2)

    def h(x: np.ndarray) -> np.ndarray:
        x = torch.tensor(x)
        return primitive.basis.project(x[0], x[1:]).numpy()[:3]

    for t in range(12):
        if t:
            mean = mean.copy()
            mean[0] += rate * dt
            covariance = covariance.copy()
            covariance[0, 0] += q
        mean, covariance = updated(mean, covariance, y[t, :3], R, h)
    trace = made(torch.tensor(y), HUMAN.expand(12, 5))
    np.testing.assert_allclose(trace.state.mean.detach().numpy(), mean, atol=1e-5)
    assert trace.states.shape == (12, 1)
    assert torch.equal(trace.phase, trace.states[..., 0])


@pytest.mark.parametrize(
    "options", [{}, {"weigh": True, "square_root": True, "inflation": 1.02}], ids=["plain", "all"]
)
def test_both_engines_give_the_same(options: dict[str, object]) -> None:
    made = ebip(small_primitive(torch.float64), 6, phase=drift(torch.float64), **options)  # type: ignore[arg-type]
    y = torch.where(HUMAN, interactions(2, seed=9, dtype=torch.float64)[1][:25], torch.nan)
    dense = made(y, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        span = made(y, generator=torch.Generator().manual_seed(0), engine="span", project=False)
    torch.testing.assert_close(span.state.members, dense.state.members)
    torch.testing.assert_close(span.phase, dense.phase)
    live = LiveFilter(made, HUMAN, generator=torch.Generator().manual_seed(0))
    for t in range(25):
        if t:
            live.predict()
        live.update(y[t])
    torch.testing.assert_close(live.state.members, dense.state.members)
    torch.testing.assert_close(live.phase_velocity, made.phase_velocity(dense.state))


def test_it_follows_an_interaction_and_forecasts_its_end() -> None:
    """The phase ends near 1, and the forecast of the arm is better than the mean of the demonstrations."""
    primitive = small_primitive(torch.float64)
    made = ebip(primitive, residual_variance=30 * primitive.residual_variance, square_root=True, phase=drift())
    errors = []
    for values in list(interactions(12, seed=21, dtype=torch.float64))[:10]:
        shown = values[: int(0.8 * len(values))]
        with torch.no_grad():
            trace = made(torch.where(HUMAN, shown, torch.nan), generator=torch.Generator().manual_seed(0))
        assert 0.5 < float(trace.phase[-1]) < 1
        ends = primitive.basis.project(torch.ones(len(primitive)).double(), primitive.weights).mean(0)
        forecast = made.forecast(trace.state, 1.0).mean[0]
        errors.append([float((each - values[-1])[3:].square().sum()) for each in (forecast, ends)])
    found, mean = np.mean(errors, 0)
    assert found < 0.7 * mean


def test_every_preset_and_a_session_take_it() -> None:
    primitive = small_primitive()
    for made in (
        ebip_minus(primitive, 30, max_components=1, phase=drift()),
        particle_filter(primitive, phase=drift(), residual_variance=1e3 * primitive.residual_variance),
        bip(primitive, phase=drift()),
        ebip(primitive, phase=drift()),
    ):
        assert made.initial_state(generator=torch.Generator().manual_seed(0)).mean.shape == (1 + 30,)
        coefficients: Tensor = made.attribution(made.initial_state(generator=torch.Generator().manual_seed(0)))
        assert float(coefficients.sum()) == pytest.approx(1, abs=1e-3)
        session = InteractionSession(made, primitive)
        session.push("hand", [0.1, 0.2], 0.0)
        expected = session.forecast(0.2, 0.1)
        assert expected.mean.isfinite().all()
        assert expected.time_to_end > 0


def test_a_step_for_four_has_the_noise_of_four() -> None:
    made = ebip(small_primitive(torch.float64), phase=drift(torch.float64))
    four = made.restrict(torch.ones(5, dtype=torch.bool), 4)
    dt = torch.tensor(0.1, dtype=torch.float64)
    one = made.model.process_noise.factor(dt).detach().square()
    torch.testing.assert_close(four.model.process_noise.factor(4 * dt).detach().square(), 4 * one)
    with pytest.raises(ValueError, match="drift must be a positive number"):
        DriftingPhase(0.0)
