"""A phase of order 2: the contract of every filter, an exact oracle, and what it promises."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from tests.filtering.contract import FilterContract
from tests.interaction.phases.textbook import updated
from tests.interaction.test_ebip import silent
from torch_ebip import (
    AcceleratingPhase,
    ConstantVelocityPhase,
    InteractionFilter,
    InteractionSession,
    LiveFilter,
    bip,
    ebip,
    particle_filter,
)
from torch_ebip.interaction.phases.accelerating import PhaseJerk

HUMAN = torch.tensor([True, True, True, False, False])


class TestEnsemble(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> InteractionFilter:
        options = {"square_root": True, "weigh": True, "inflation": 1.01}
        return ebip(small_primitive(dtype), phase=AcceleratingPhase(), **options)  # type: ignore[arg-type]

    def make_without_draws(self) -> InteractionFilter:
        made = ebip(small_primitive(torch.float64), square_root=True, weigh=True, phase=AcceleratingPhase())
        return silent(made)  # type: ignore[return-value]


class TestExtended(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> InteractionFilter:
        return bip(small_primitive(dtype), phase=AcceleratingPhase())

    def make_without_draws(self) -> InteractionFilter:
        return self.make(torch.float64)


def textbook_noise(sigma: float, t: float) -> np.ndarray:
    """The integral of sigma^2 e(s) e(s)' ds over a step, e(s) = (s^2/2, s, 1), by Gauss-Legendre."""
    nodes, shares = np.polynomial.legendre.leggauss(5)
    total = np.zeros((3, 3))
    for node, share in zip(0.5 * t * (nodes + 1), 0.5 * t * shares, strict=True):
        e = np.array([node**2 / 2, node, 1.0])
        total += share * np.outer(e, e)
    return sigma**2 * total


def test_the_noise_is_the_integral_of_white_jerk_however_time_is_cut() -> None:
    noise = PhaseJerk(torch.tensor(0.7).double())
    dt = torch.tensor([0.02, 0.5]).double()
    factor = noise.cholesky(dt).detach().numpy()
    sigma = float(noise.strength.value)
    for i, t in enumerate(dt.tolist()):
        np.testing.assert_allclose(factor[i] @ factor[i].T, textbook_noise(sigma, t), rtol=1e-12)
    # Two steps of a half are one step: G Q G' + Q.
    half = torch.tensor(0.25).double()
    G = AcceleratingPhase().transition(half).numpy()
    Q = textbook_noise(sigma, 0.25)
    np.testing.assert_allclose(G @ Q @ G.T + Q, textbook_noise(sigma, 0.5), rtol=1e-12)


def test_the_extended_filter_is_that_of_the_textbook() -> None:
    """Predict and update with dense matrices in numpy: G and Q of order 2, H by finite differences."""
    primitive = small_primitive(torch.float64)
    made = bip(primitive, phase=AcceleratingPhase(), residual_variance=100 * primitive.residual_variance)
    y = interactions(2, seed=9, dtype=torch.float64)[1][:12].numpy()
    state = made.initial_state()
    mean, covariance = state.mean.numpy().copy(), state.covariance.numpy().copy()
    n, dt = len(mean), made.dt
    G, Q = np.eye(n), np.zeros((n, n))
    G[0, 1], G[0, 2], G[1, 2] = dt, dt**2 / 2, dt
    Q[:3, :3] = textbook_noise(float(made.model.process_noise.phase.strength.value.detach()), dt)
    R = np.diag(made.model.measurement_noise().detach().numpy()[:3] ** 2)

    def h(x: np.ndarray) -> np.ndarray:
        x = torch.tensor(x)
        return primitive.basis.project(x[0], x[3:]).numpy()[:3]

    for t in range(12):
        if t:
            mean, covariance = G @ mean, G @ covariance @ G.T + Q
        mean, covariance = updated(mean, covariance, y[t, :3], R, h)
    trace = made(torch.tensor(y), HUMAN.expand(12, 5))
    np.testing.assert_allclose(trace.state.mean.detach().numpy(), mean, atol=1e-5)
    np.testing.assert_allclose(trace.state.covariance.detach().numpy(), covariance, atol=1e-5)


def test_slope_and_transition_are_the_derivative() -> None:
    dynamics, dt = AcceleratingPhase(), torch.tensor(0.1).double()
    for phase in (-0.3, 0.4, 0.97, 1.3):
        mean = torch.tensor([phase, 0.5, -0.3, 1.0]).double()
        rows = torch.autograd.functional.jacobian(lambda x: dynamics(x[None], dt)[0, :3], mean)
        expected = dynamics.transition(dt)
        expected[0] *= dynamics.slope(mean, dt)
        torch.testing.assert_close(rows[:, :3], expected)
        assert not rows[:, 3].any()


def test_both_engines_give_the_same() -> None:
    made = ebip(small_primitive(torch.float64), 6, phase=AcceleratingPhase(), weigh=True, square_root=True)
    y = torch.where(HUMAN, interactions(2, seed=9, dtype=torch.float64)[1][:25], torch.nan)
    dense = made(y, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        span = made(y, generator=torch.Generator().manual_seed(0), engine="span", project=False)
    torch.testing.assert_close(span.state.members, dense.state.members)
    live = LiveFilter(made, HUMAN, generator=torch.Generator().manual_seed(0))
    for t in range(25):
        if t:
            live.predict()
        live.update(y[t])
    torch.testing.assert_close(live.state.members, dense.state.members)


def test_it_learns_that_a_movement_slows_down() -> None:
    """The phase is 1.4 t - 0.7 t^2: one of order 1 with as much noise follows it, but its velocity is behind."""
    primitive = small_primitive(torch.float64)
    t = torch.arange(22, dtype=torch.float64) / 30
    phase, velocity = 1.4 * t - 0.7 * t.square(), 1.4 - 1.4 * float(t[-1])
    for demonstration in (3, 5, 8, 11):
        path = primitive.basis.project(phase, primitive.weights[demonstration].expand(22, -1))
        off = []
        for model in (AcceleratingPhase(), ConstantVelocityPhase()):
            made = ebip(primitive, phase=model, residual_variance=10 * primitive.residual_variance, square_root=True)
            noise = made.model.process_noise.phase
            with torch.no_grad():
                (noise.strength if isinstance(noise, PhaseJerk) else noise.acceleration).start.mul_(30)
                last = made(torch.where(HUMAN, path, torch.nan), generator=torch.Generator().manual_seed(0)).states[
                    -1
                ]
            assert float(last[0]) == pytest.approx(float(phase[-1]), abs=0.02)
            off.append(abs(float(last[1]) - velocity))
            if len(last) == 3:
                assert float(last[2]) == pytest.approx(-1.4, rel=0.2)
        assert off[0] < 0.5 * off[1]


def test_every_preset_and_a_session_take_it() -> None:
    primitive = small_primitive()
    for made in (
        particle_filter(primitive, phase=AcceleratingPhase(), residual_variance=1e3 * primitive.residual_variance),
        bip(primitive, phase=AcceleratingPhase()),
        ebip(primitive, phase=AcceleratingPhase()),
    ):
        start = made.initial_state(generator=torch.Generator().manual_seed(0))
        assert start.mean.shape == (3 + 30,)
        session = InteractionSession(made, primitive)
        session.push("hand", [0.1, 0.2], 0.0)
        expected = session.forecast(0.2, 0.1)
        assert expected.mean.isfinite().all()
        assert expected.time_to_end > 0
