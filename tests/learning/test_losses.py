"""Scores and losses against their definitions, and their gradients."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from torch_ebip import Forecast, RobotArm
from torch_ebip.filtering.functional.scores import crps, energy_score, gaussian_crps
from torch_ebip.learning import metrics
from torch_ebip.learning.losses import (
    CRPSLoss,
    EnergyScoreLoss,
    ForwardKinematicsLoss,
    InnovationLikelihoodLoss,
    TrajectoryLoss,
    geodesic_angle,
)


def draws(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_crps_is_its_definition_also_with_weights() -> None:
    members, target = draws(4, 11, 3), draws(4, 3, seed=1)
    weights = torch.softmax(draws(4, 11, seed=2), -1)
    for w, result in (
        (torch.full((4, 11), 1 / 11, dtype=torch.float64), crps(members, target)),
        (weights, crps(members, target, weights)),
    ):
        for b in range(4):
            for d in range(3):
                x, y, v = members[b, :, d].numpy(), target[b, d].item(), w[b].numpy()
                pairs = np.abs(x[:, None] - x[None]) * np.outer(v, v)
                expected = (v * np.abs(x - y)).sum() - pairs.sum() / 2 / (1 - 1 / 11)
                assert result[b, d].item() == pytest.approx(expected, abs=1e-12)


def test_crps_of_a_large_ensemble_is_that_of_the_normal_distribution() -> None:
    members = draws(200_000, 1)
    for y in (-1.0, 0.3, 2.0):
        expected = y * (2 * norm.cdf(y) - 1) + 2 * norm.pdf(y) - 1 / math.sqrt(math.pi)
        assert crps(members, torch.tensor([y]).double()).item() == pytest.approx(expected, abs=0.01)


def test_scores_of_a_normal_forecast() -> None:
    """Against the integral of squared differences of the distribution functions."""
    grid = np.linspace(-12, 12, 200_001)
    for mean, deviation, y in ((0.5, 2.0, -1.0), (0.0, 0.3, 0.1)):
        integrand = (norm.cdf(grid, mean, deviation) - (grid >= y)) ** 2
        expected = np.trapezoid(integrand, grid)
        values = torch.tensor([mean]).double(), torch.tensor([deviation**2]).double(), torch.tensor([y]).double()
        assert gaussian_crps(*values).item() == pytest.approx(expected, abs=1e-4)
    zero = torch.zeros(1).double()
    assert gaussian_crps(zero, zero, zero + 2).item() == 2
    variance = torch.ones(1).double().requires_grad_()
    assert torch.autograd.gradcheck(gaussian_crps, (zero.clone().requires_grad_(), variance, zero + 1))


def test_a_distribution_of_particles_is_scored_as_it_is() -> None:
    members, target = draws(9, 2), draws(2, seed=1)
    one = torch.zeros(9, dtype=torch.float64)
    one[3] = 1
    torch.testing.assert_close(crps(members, target, one, fair=False), (members[3] - target).abs())
    x = members[:, 0].numpy()
    expected = np.abs(x - target[0].item()).mean() - np.abs(x[:, None] - x[None]).mean() / 2
    assert crps(members, target, fair=False)[0].item() == pytest.approx(expected)


def test_a_forecast_scores_itself() -> None:
    members, target = draws(4, 2, 50, 3), draws(4, 2, 3, seed=1)
    weights = torch.softmax(draws(4, 2, 50, seed=2), -1)
    mean, variance = (weights.unsqueeze(-1) * members).sum(-2), members.var(-2)
    phase = torch.ones(4, 2)
    forecast = Forecast(mean, variance, phase, members, weights)
    torch.testing.assert_close(forecast.crps(target), crps(members, target, weights))
    last = forecast.at(1).select(torch.tensor([2, 0]))
    torch.testing.assert_close(last.crps(target[:, 1, [2, 0]]), forecast.crps(target)[:, 1, [2, 0]])
    below = forecast.probability_below(target)
    expected = (weights.unsqueeze(-1) * (members < target.unsqueeze(-2))).sum(-2)
    torch.testing.assert_close(below, expected)
    equal = Forecast(mean, variance, phase, members)
    assert equal.probability_below(members[..., 7, :])[0, 0, 0] * 50 % 1 == pytest.approx(0.5)
    normal = Forecast(mean, variance, phase)
    torch.testing.assert_close(normal.crps(target), gaussian_crps(mean, variance, target))
    z = ((target - mean) / variance.sqrt()).numpy()
    np.testing.assert_allclose(normal.probability_below(target).numpy(), norm.cdf(z), atol=1e-12)


def test_fair_scores_do_not_depend_on_the_size_of_the_ensemble() -> None:
    target = draws(4000, 2, seed=9)
    small, large = crps(draws(4000, 3, 2), target).mean(), crps(draws(4000, 60, 2), target).mean()
    assert small.item() == pytest.approx(large.item(), abs=0.02)


def test_a_filter_wins_nothing_by_naming_the_two_members_that_lie_outermost() -> None:
    """With the correction for given weights they would be the best forecast of all: whatever comes lies between."""
    members, target = draws(500, 40, 1), draws(500, 1, seed=9)
    outermost = torch.zeros(500, 40, dtype=torch.float64)
    for most in (members.argmin(-2), members.argmax(-2)):
        outermost.scatter_(-1, most, 0.5)
    assert crps(members, target, outermost).mean() > 1.5 * crps(members, target).mean()


def test_energy_score_in_one_dimension_is_the_crps() -> None:
    members, target = draws(5, 8, 1), draws(5, 1, seed=1)
    torch.testing.assert_close(energy_score(members, target), crps(members, target).squeeze(-1))
    two, aim = draws(8, 2), draws(2, seed=3)
    pairs = sum(np.linalg.norm(a - b) for a in two.numpy() for b in two.numpy()) / (2 * 8 * 7)
    error = np.mean([np.linalg.norm(a - aim.numpy()) for a in two.numpy()])
    assert energy_score(two, aim).item() == pytest.approx(error - pairs, abs=1e-12)


def test_scores_need_two_members() -> None:
    for score in (crps, energy_score):
        with pytest.raises(ValueError, match="at least 2 members"):
            score(torch.zeros(1, 2), torch.zeros(2))


def test_trajectory_loss_leaves_out_what_was_not_measured() -> None:
    loss = TrajectoryLoss(torch.tensor([1.0, 2.0, 0.0]), torch.tensor([True, True, False]))
    predicted = torch.tensor([[1.0, 2.0, 9.0], [3.0, 4.0, 9.0]], requires_grad=True)
    value = loss(predicted, torch.tensor([[0.0, math.nan, 0.0], [1.0, 0.0, math.nan]]))
    assert value.item() == pytest.approx((1 + 4 + 4) / 3)
    value.backward()
    assert predicted.grad is not None
    assert predicted.grad.isfinite().all()
    assert predicted.grad[0, 1] == 0
    nothing = loss(predicted, torch.full((2, 3), math.nan))
    assert nothing.item() == 0
    with pytest.raises(ValueError, match="positive for the chosen"):
        TrajectoryLoss(torch.tensor([0.0]))


@pytest.mark.parametrize("kind", [CRPSLoss, EnergyScoreLoss])
def test_ensemble_losses_have_gradients_with_gaps(kind) -> None:
    members = draws(3, 5, 2).requires_grad_()
    target = draws(3, 2, seed=1)
    target[1, 0] = math.nan
    loss = kind(torch.ones(2).double())
    assert torch.autograd.gradcheck(lambda x: loss(x, target), (members,))
    loss(members, target).backward()
    assert members.grad is not None
    assert not members.grad[1, :, 0].any()


def test_innovation_likelihood_is_per_measured_value() -> None:
    observed = torch.tensor([[[True, False], [True, True]]])
    assert InnovationLikelihoodLoss()(torch.tensor([[-2.0, -4.0]]), observed).item() == pytest.approx(2.0)


def test_geodesic_angle_is_that_of_scipy() -> None:
    a, b = (Rotation.random(200, random_state=seed) for seed in (0, 1))
    angles = geodesic_angle(torch.tensor(a.as_matrix()), torch.tensor(b.as_matrix()))
    np.testing.assert_allclose(angles.numpy(), (a.inv() * b).magnitude(), atol=1e-7)
    same = torch.tensor(a.as_matrix()).requires_grad_()
    geodesic_angle(same, same.detach()).sum().backward()
    assert same.grad is not None
    assert same.grad.isfinite().all()


def test_forward_kinematics_loss() -> None:
    arm = RobotArm.ur5().double()
    joints, wanted = draws(4, 6), draws(4, 6, seed=1)
    a, b = arm(joints), arm(wanted)
    distance = (a[:, :3, 3] - b[:, :3, 3]).norm(dim=-1).mean()
    angle = geodesic_angle(a[:, :3, :3], b[:, :3, :3]).mean()
    torch.testing.assert_close(ForwardKinematicsLoss(arm)(joints, wanted), distance)
    torch.testing.assert_close(ForwardKinematicsLoss(arm, 0.3)(joints, wanted), distance + 0.3 * angle)
    loss = ForwardKinematicsLoss(arm, 0.3)
    assert torch.autograd.gradcheck(lambda q: loss(q, wanted), (joints.clone().requires_grad_(),))
    wanted[2] = math.nan
    at_target = torch.where(wanted.isnan(), 0, wanted).requires_grad_()
    loss(at_target, wanted).backward()
    assert at_target.grad is not None
    assert at_target.grad.isfinite().all()
    with pytest.raises(ValueError, match="rotation_weight"):
        ForwardKinematicsLoss(arm, -1.0)


def test_metrics() -> None:
    mean, target = torch.tensor([[0.0, 1.0, 2.0]]), torch.tensor([[0.5, math.nan, 5.0]])
    forecast = Forecast(mean, torch.tensor([[1.0, 1.0, 1.0]]), torch.ones(1))
    assert metrics.mse(forecast, target).item() == pytest.approx((0.25 + 9) / 2)
    assert metrics.mae(forecast, target).item() == pytest.approx((0.5 + 3) / 2)
    assert metrics.coverage_95(forecast, target).item() == 0.5
    arm = RobotArm.ur5()
    turned = torch.tensor([math.pi, 0, 0, 0, 0, 0])
    reach = 2 * math.hypot(0.81725, 0.19145)
    assert metrics.tool_error(arm, turned, torch.zeros(6)).item() == pytest.approx(reach, abs=1e-5)
