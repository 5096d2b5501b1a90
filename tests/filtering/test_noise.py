import math

import pytest
import torch

from torch_ebip import (
    AboveOne,
    BSplineBasis,
    InteractionNoise,
    MeasurementNoise,
    NoProcessNoise,
    PhaseGatedNoise,
    PhaseNoise,
    Positive,
    View,
    WeightNoise,
)


@pytest.mark.parametrize(
    ("kind", "start", "low", "high"),
    [(Positive, 0.3, 0.0, math.inf), (AboveOne, 1.3, 1.0, math.inf)],
)
def test_constraints_start_where_told_and_hold(kind, start: float, low: float, high: float) -> None:
    parameter = kind(torch.tensor([start, start], dtype=torch.float64))
    torch.testing.assert_close(parameter.value, parameter.start)
    for raw in (-5.0, -1.0, 1.0, 5.0):
        with torch.no_grad():
            parameter.raw.fill_(raw)
        assert ((parameter.value > low) & (parameter.value < high)).all()
        assert (parameter.value[0] > start) == (raw > 0)


def test_positive_has_a_floor() -> None:
    parameter = Positive(torch.tensor(2.0), floor=1e-3)
    with torch.no_grad():
        parameter.raw.fill_(-1e4)
    assert parameter.value.item() == pytest.approx(2e-3)


@pytest.mark.parametrize(("kind", "bad"), [(Positive, 0.0), (AboveOne, 1.0)])
def test_a_start_outside_is_refused(kind, bad: float) -> None:
    with pytest.raises(ValueError, match="must start"):
        kind(torch.tensor(bad))


def test_phase_noise_is_the_piecewise_white_acceleration_model() -> None:
    noise = PhaseNoise(torch.tensor(0.7, dtype=torch.float64))
    dt = torch.tensor([0.02, 0.5], dtype=torch.float64)
    for i, step in enumerate(dt.tolist()):
        model = 0.49 * torch.tensor([[step**4 / 4, step**3 / 2], [step**3 / 2, step**2]], dtype=torch.float64)
        torch.testing.assert_close(noise.covariance(dt)[i], model, rtol=2e-4, atol=0)
    assert (torch.linalg.eigvalsh(noise.covariance(dt)) > 0).all()


def test_draws_have_the_covariance() -> None:
    phase = PhaseNoise(torch.tensor(0.7, dtype=torch.float64))
    with torch.no_grad():
        phase.independent.raw.fill_(4.0)
    deviation = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    walk = WeightNoise(torch.tensor([0.5, 0.1], dtype=torch.float64), deviation, torch.tensor([0, 0, 1]))
    noise = InteractionNoise(phase, walk)
    dt = torch.tensor(0.25, dtype=torch.float64)
    members = noise(torch.zeros(200_000, 5, dtype=torch.float64), dt, torch.Generator().manual_seed(0))
    expected = torch.zeros(5, 5, dtype=torch.float64)
    expected[:2, :2] = phase.covariance(dt)
    expected[2:, 2:] = torch.diag((torch.tensor([0.5, 1.0, 0.4], dtype=torch.float64) * 0.5).square())
    error = (members.T.cov() - expected) / expected.diagonal().sqrt().outer(expected.diagonal().sqrt())
    assert error.abs().max() < 0.01


def test_a_step_that_stands_for_four_has_the_noise_of_four() -> None:
    phase = PhaseNoise(torch.tensor(0.7, dtype=torch.float64))
    dt, start = torch.tensor(0.1, dtype=torch.float64), torch.zeros(50_000, 3, dtype=torch.float64)
    one = InteractionNoise(phase)
    four = one.select(View(torch.tensor([0]), torch.arange(3), 4))
    generator = torch.Generator().manual_seed(0)
    slow = start
    for _ in range(4):
        slow = one(slow, dt, generator)
    quick = four(start, 4 * dt, generator)
    assert quick[:, 1].var().item() == pytest.approx(slow[:, 1].var().item(), rel=0.05)


def test_without_weight_noise_weights_stay() -> None:
    noise = InteractionNoise(PhaseNoise(torch.tensor(1.0)))
    members = torch.randn(3, 7, 6)
    moved = noise(members, torch.tensor(0.1))
    assert torch.equal(moved[..., 2:], members[..., 2:])
    assert not torch.equal(moved[..., :2], members[..., :2])
    assert NoProcessNoise()(members, torch.tensor(0.1)) is members


def test_measurement_noise_starts_at_the_closed_form() -> None:
    variance = torch.tensor([0.1, 2.0, 30.0], dtype=torch.float64)
    plain = MeasurementNoise(variance)
    torch.testing.assert_close(plain().square(), variance)
    gated = PhaseGatedNoise(variance, BSplineBasis(4), torch.tensor([0, 0, 1]))
    torch.testing.assert_close(gated(torch.rand(5, 2, dtype=torch.float64)).square(), variance.expand(5, 3))


def test_gates_switch_modalities_by_phase() -> None:
    gated = PhaseGatedNoise(torch.ones(3, dtype=torch.float64), BSplineBasis(4), torch.tensor([0, 0, 1]))
    with torch.no_grad():
        gated.gates[0, 1] = 6.0
    early, late = gated(torch.tensor([[0.0], [1.0]], dtype=torch.float64)).square()
    torch.testing.assert_close(early, torch.tensor([1.0, 1.0, math.exp(6.0)], dtype=torch.float64))
    torch.testing.assert_close(late, torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(gated(torch.tensor([-3.0], dtype=torch.float64)).square(), early)


def test_errors() -> None:
    with pytest.raises(ValueError, match="variance must be positive"):
        MeasurementNoise(torch.tensor([1.0, 0.0]))
    with pytest.raises(ValueError, match=r"needs modality_of_dof, int64 \[2\]"):
        PhaseGatedNoise(torch.ones(2), BSplineBasis(4), torch.tensor([0]))
    gated = PhaseGatedNoise(torch.ones(2), BSplineBasis(4), torch.tensor([0, 1]))
    with pytest.raises(ValueError, match="depends on phase"):
        gated(None)
