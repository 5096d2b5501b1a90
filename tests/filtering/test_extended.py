"""BIP against a textbook filter written densely, exact Bayesian regression, and the ensemble filter."""

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from tests.filtering.contract import FilterContract
from tests.interaction.test_ebip import silent
from torch_ebip import (
    BSplineBasis,
    ConstantVelocityPhase,
    ExtendedFilter,
    GaussianBasis,
    GaussianState,
    InteractionPrimitive,
    MomentPrior,
    StackedBasis,
    StudentT,
    bip,
    ebip,
)

HUMAN = torch.tensor([True, True, True, False, False])


class TestPlain(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> ExtendedFilter:
        return bip(small_primitive(dtype))

    def make_without_draws(self) -> ExtendedFilter:
        return bip(small_primitive(torch.float64))


class TestEverything(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> ExtendedFilter:
        options = {"context": BSplineBasis(4), "weight_noise": 0.1, "shrinkage": 0.2, "robust": StudentT(2.0)}
        return bip(small_primitive(dtype), **options)

    def make_without_draws(self) -> ExtendedFilter:
        return self.make(torch.float64)


def slow_interaction(length: int) -> torch.Tensor:
    """One interaction stretched to a number of samples, float64 [length, 5]."""
    trajectory = interactions(2, seed=9, dtype=torch.float64)[1]
    return torch.nn.functional.interpolate(trajectory.T.unsqueeze(0), size=length, mode="linear")[0].T


def test_a_textbook_filter_written_densely() -> None:
    """The paper's equations in dense numpy over 100 steps that run past the end; modalities come and go."""
    primitive = InteractionPrimitive.fit(
        interactions(dtype=torch.float64), StackedBasis([BSplineBasis(6)] * 3 + [GaussianBasis(5, offset=True)] * 2)
    )
    made = bip(primitive, residual_variance=100 * primitive.residual_variance, weight_noise=0.05)
    y = torch.cat([slow_interaction(80), torch.zeros(20, 5, dtype=torch.float64)])
    seen = torch.ones(100, 5, dtype=torch.bool) & HUMAN
    seen[30:50, 0] = False
    seen[60:65] = False
    seen[80:] = False
    with torch.no_grad():
        trace = made(y, seen, dt=1 / 60)
        dt = torch.tensor(1 / 60, dtype=torch.float64)
        Q_phase, Q_weights = (part.numpy() for part in made.model.process_noise.covariance(dt))
        R = np.diag(made.model.measurement_noise().square().numpy())

    W, velocity = primitive.weights.numpy(), primitive.phase_velocity.numpy()
    n = 2 + W.shape[1]
    mean = np.concatenate([[0.0, velocity.mean()], W.mean(0)])
    covariance = np.zeros((n, n))
    covariance[1, 1] = velocity.var(ddof=1)
    covariance[2:, 2:] = np.cov(W.T)
    Q = np.zeros((n, n))
    Q[:2, :2] = Q_phase
    Q[2:, 2:] = np.diag(Q_weights)
    slices = primitive.basis.weight_slices

    def h(x: np.ndarray) -> np.ndarray:
        phase = torch.tensor(x[0]).double()
        features = [basis(phase).numpy() for basis in primitive.basis.bases]
        return np.array([features[d] @ x[2:][slices[d]] for d in range(5)])

    def numerical(function, x: np.ndarray) -> np.ndarray:
        steps = np.eye(n) * 1e-6
        return np.stack([(function(x + step) - function(x - step)) / 2e-6 for step in steps], -1)

    def g(x: np.ndarray) -> np.ndarray:
        phase = x[0] + x[1] / 60
        excess = phase - np.clip(phase, 0, 1)
        return np.concatenate([[phase - excess + excess / (1 + abs(excess) / 0.05)], x[1:]])

    beyond = 0
    for t in range(100):
        if t:
            G = np.eye(n)
            G[0] = 0
            # The derivative of the hold is analytic here; that it is the derivative is checked beside it.
            phase = mean[0] + mean[1] / 60
            excess = abs(phase - np.clip(phase, 0, 1))
            beyond += excess > 0
            G[0, :2] = (1 + excess / 0.05) ** -2 * np.array([1, 1 / 60])
            np.testing.assert_allclose(G, numerical(g, mean), atol=1e-5)
            mean, covariance = g(mean), G @ covariance @ G.T + Q
        rows = seen[t].numpy()
        if rows.any():
            phase = torch.tensor(mean[0]).double()
            H = np.zeros((5, n))
            for d, basis in enumerate(primitive.basis.bases):
                H[d, 2:][slices[d]] = basis(phase).numpy()
                H[d, 0] = basis.derivative(phase).numpy() @ mean[2:][slices[d]]
            if t % 20 == 0:
                np.testing.assert_allclose(H, numerical(h, mean), atol=1e-5)
            H, Rt = H[rows], R[rows][:, rows]
            S = H @ covariance @ H.T + Rt
            K = covariance @ H.T @ np.linalg.inv(S)
            r = y[t].numpy()[rows] - h(mean)[rows]
            likelihood = -0.5 * (r @ np.linalg.inv(S) @ r + np.linalg.slogdet(S)[1] + rows.sum() * np.log(2 * np.pi))
            np.testing.assert_allclose(trace.log_likelihood[t].item(), likelihood, atol=1e-7)
            mean, covariance = mean + K @ r, (np.eye(n) - K @ H) @ covariance
        np.testing.assert_allclose(trace.phase[t].item(), mean[0], atol=1e-8)
        np.testing.assert_allclose(trace.projection[t].numpy(), h(mean), atol=1e-8)
    assert beyond > 5
    np.testing.assert_allclose(trace.state.mean.numpy(), mean, atol=1e-8)
    np.testing.assert_allclose(trace.state.covariance.numpy(), covariance, atol=1e-8)
    forecast = made.forecast(trace.state, torch.tensor([0.3, 1.0]))
    for p, phase in enumerate((0.3, 1.0)):
        for d, basis in enumerate(primitive.basis.bases):
            f = basis(torch.tensor(phase).double()).numpy()
            block = covariance[2:, 2:][slices[d], slices[d]]
            np.testing.assert_allclose(forecast.variance[p, d].item(), f @ block @ f, rtol=1e-6)
            np.testing.assert_allclose(forecast.mean[p, d].item(), f @ mean[2:][slices[d]], atol=1e-8)


def known_phase(count: int = 24) -> InteractionPrimitive:
    """Demonstrations that all last one second: the phase of a new one is known."""
    primitive = small_primitive(torch.float64, count)
    primitive.phase_velocity.fill_(1.0)
    return primitive


def test_with_a_known_phase_it_is_exact_bayesian_regression() -> None:
    """A linear-Gaussian problem: all measurements at once, in the span of the demonstrations."""
    primitive = known_phase()
    factor = 30 * primitive.residual_variance
    made = silent_covariance(bip(primitive, residual_variance=factor))
    y = interactions(2, seed=9, dtype=torch.float64)[1][:25]
    trace = made(y, HUMAN.expand(25, 5))
    W = primitive.weights.numpy()
    A = (W - W.mean(0)) / np.sqrt(len(W) - 1)  # prior: W.mean + A' z, z standard normal
    rows, values = [], []
    for t in range(25):
        features = BSplineBasis(6)(torch.tensor(t / 30).double()).numpy()
        for d in range(3):
            row = np.zeros(W.shape[1])
            row[primitive.basis.weight_slices[d]] = features
            deviation = float(factor[d]) ** 0.5
            rows.append(row / deviation)
            values.append(float(y[t, d]) / deviation)
    Phi = np.array(rows)
    residual = np.array(values) - Phi @ W.mean(0)
    precision = np.eye(len(W)) + A @ Phi.T @ Phi @ A.T
    z = np.linalg.solve(precision, A @ Phi.T @ residual)
    np.testing.assert_allclose(trace.state.mean[2:].detach().numpy(), W.mean(0) + A.T @ z, atol=1e-8)
    np.testing.assert_allclose(
        trace.state.covariance[2:, 2:].detach().numpy(), A.T @ np.linalg.inv(precision) @ A, atol=1e-8
    )
    joint = np.eye(len(residual)) + Phi @ A.T @ A @ Phi.T
    deviations = sum(25 * 0.5 * np.log(float(factor[d])) for d in range(3))
    evidence = -0.5 * (residual @ np.linalg.solve(joint, residual) + np.linalg.slogdet(joint)[1])
    evidence -= 0.5 * len(residual) * np.log(2 * np.pi) + deviations
    np.testing.assert_allclose(trace.log_likelihood.sum().item(), evidence, atol=1e-7)


def silent_covariance(filter: ExtendedFilter) -> ExtendedFilter:
    """Without process noise."""

    class Silent(torch.nn.Module):
        def add_covariance_(self, covariance, dt):
            return covariance

    filter.model.process_noise = Silent()
    return filter


def test_it_agrees_with_ebip_in_the_linear_limit() -> None:
    """Known phase: h is linear, and a square-root ensemble has exactly the moments of the Gaussian."""
    primitive = known_phase()
    variance = 30 * primitive.residual_variance
    extended = silent_covariance(bip(primitive, residual_variance=variance))
    ensemble = silent(ebip(primitive, residual_variance=variance, square_root=True))
    y = interactions(3, seed=9, dtype=torch.float64)[1][:25]
    a, b = extended(y, HUMAN.expand(25, 5)), ensemble(y, HUMAN.expand(25, 5))
    torch.testing.assert_close(a.state.mean, b.state.mean, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(a.state.covariance, b.state.covariance, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(a.log_likelihood, b.log_likelihood, atol=1e-8, rtol=1e-9)
    phases = torch.tensor([0.5, 1.0])
    mine, theirs = extended.forecast(a.state, phases), ensemble.forecast(b.state, phases)
    torch.testing.assert_close(mine.variance, theirs.variance, atol=1e-10, rtol=1e-8)


def test_float32_stays_symmetric_and_positive() -> None:
    """Closed-form R, a prior of rank 23 in 30 dimensions, 200 steps; (I - KH) Sigma drifts from symmetry here."""
    made = bip(small_primitive())
    y = slow_interaction(200).float()
    state = made.initial_state()
    scale = state.covariance.diagonal()[1:].sqrt()

    def in_units_of_the_prior(covariance: torch.Tensor) -> torch.Tensor:
        return covariance[1:, 1:] / scale / scale[:, None]

    def asymmetry(covariance: torch.Tensor) -> float:
        return in_units_of_the_prior(covariance - covariance.T).abs().max().item()

    with torch.no_grad():
        ours = made(y, HUMAN.expand(200, 5), dt=5e-3, project=False).state.covariance
        R = torch.diag(made.model.measurement_noise()[:3].square())
        G, Q = torch.eye(32), torch.zeros(32, 32)
        G[0, 1] = 5e-3
        Q[:2, :2] = made.model.process_noise.covariance(torch.tensor(5e-3))[0]
        mean, plain = state
        for t in range(200):
            if t:
                mean, plain = G @ mean, G @ plain @ G.T + Q
            H = torch.zeros(3, 32)
            for d in range(3):
                weights = slice(2 + 6 * d, 8 + 6 * d)
                H[d, weights] = BSplineBasis(6)(mean[0])
                H[d, 0] = BSplineBasis(6).derivative(mean[0]) @ mean[weights]
            K = plain @ H.T @ torch.linalg.inv(H @ plain @ H.T + R)
            expected = made.project(GaussianState(mean, plain))[:3]
            mean, plain = mean + K @ (y[t, :3] - expected), plain - K @ H @ plain
    assert asymmetry(ours) < 1e-7
    assert asymmetry(plain) > 1e-5
    symmetric = 0.5 * (ours + ours.T)
    assert torch.linalg.eigvalsh(in_units_of_the_prior(symmetric).double())[0] > -1e-6


def test_the_slope_of_the_phase_is_its_derivative() -> None:
    dynamics, dt = ConstantVelocityPhase(), torch.tensor(0.1).double()
    for phase in (-0.3, -0.02, 0.4, 0.97, 1.3):
        mean = torch.tensor([phase, 0.5, 1.0]).double()
        row = torch.autograd.functional.jacobian(lambda x: dynamics(x[None], dt)[0, 0], mean)
        slope = dynamics.slope(mean, dt)
        torch.testing.assert_close(row, slope * torch.tensor([1, 0.1, 0]).double())


def test_the_prior_is_the_papers() -> None:
    primitive = small_primitive(torch.float64)
    state = bip(primitive).initial_state((2,))
    assert state.mean.shape == (2, 32)
    velocity, W = primitive.phase_velocity.numpy(), primitive.weights.numpy()
    expected = np.zeros((32, 32))
    expected[1, 1] = velocity.var(ddof=1)
    expected[2:, 2:] = np.cov(W.T)
    np.testing.assert_allclose(state.covariance[1].numpy(), expected, atol=1e-12)
    assert np.linalg.matrix_rank(state.covariance[0].numpy()[2:, 2:]) == 23
    shrunk = bip(primitive, shrinkage=0.1).initial_state().covariance.numpy()
    assert np.linalg.matrix_rank(shrunk[2:, 2:]) == 30
    np.testing.assert_allclose(np.diag(shrunk), np.diag(expected))
    np.testing.assert_allclose(shrunk[2, 3], 0.9 * expected[2, 3])
    some = bip(primitive).initial_state(demonstrations=torch.tensor([[1, 4, 7], [2, 2, 9]]))
    np.testing.assert_allclose(some.mean[0, 2:].numpy(), W[[1, 4, 7]].mean(0))
    np.testing.assert_allclose(some.covariance[1, 2:, 2:].numpy(), np.cov(W[[2, 2, 9]].T), atol=1e-12)


def test_bad_priors_are_named() -> None:
    with pytest.raises(ValueError, match="shrinkage must lie between 0 and 1, got 2"):
        bip(small_primitive(), shrinkage=2)
    with pytest.raises(ValueError, match="at least 2 states"):
        MomentPrior(torch.zeros(1, 4))
    with pytest.raises(ValueError, match="must be numbered 0 to 23, got 0 to 24"):
        bip(small_primitive()).initial_state(demonstrations=torch.tensor([0, 24]))


def test_restricting_is_exact() -> None:
    whole = bip(small_primitive(torch.float64), context=BSplineBasis(4), weight_noise=0.1)
    y, observed = interactions(2, seed=3, dtype=torch.float64).pad()
    y, observed = y[:, :20], observed[:, :20] & torch.tensor([True, False, True, False, False])
    dofs = torch.tensor([True, False, True, False, True])
    part = whole.restrict(dofs)
    a, b = whole(y, observed), part(y[..., dofs], observed[..., dofs])
    torch.testing.assert_close(a.projection[..., dofs], b.projection)
    torch.testing.assert_close(a.log_likelihood, b.log_likelihood)
    assert {id(p) for p in part.parameters()} <= {id(p) for p in whole.parameters()}


def breaking() -> tuple[ExtendedFilter, GaussianState, torch.Tensor]:
    """A filter, and a state whose covariance is none."""
    made = bip(small_primitive(torch.float64))
    mean, covariance = made.initial_state()
    return made, GaussianState(mean, -1e6 * torch.eye(len(mean)).to(covariance)), torch.zeros(5, dtype=torch.float64)


def test_a_covariance_that_cannot_be_factored_names_its_dofs() -> None:
    made, state, y = breaking()
    with pytest.raises(ValueError, match=r"cannot be factored.*\(hand.x.*\)"):
        made.update(state, y)
    made.model.dof_names = None
    with pytest.raises(ValueError, match=r"first failing at DoF \[0"):
        made.update(state, y)


def test_a_covariance_that_cannot_be_factored_names_its_dofs_among_others() -> None:
    made, state, y = breaking()
    with pytest.raises(ValueError, match=r"cannot be factored.*\(gaze.yaw\)"):
        made.update(state, y, torch.tensor([False, False, True, False, False]))


def test_only_interactions_can_be_restricted() -> None:
    made = bip(small_primitive())
    made.model.dynamics = torch.nn.Identity()
    with pytest.raises(TypeError, match="everything moves: the model cannot be restricted"):
        made.restrict(HUMAN)


def test_a_model_without_derivatives_is_refused() -> None:
    model = bip(small_primitive()).model
    model.measurement = torch.nn.Identity()
    with pytest.raises(ValueError, match="a Identity has no `jacobian`"):
        ExtendedFilter(model, MomentPrior(torch.zeros(2, 4)))
