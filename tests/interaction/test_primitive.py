import math

import numpy as np
import pytest
import torch

from tests.conftest import interactions, layout, small_primitive
from torch_ebip import BSplineBasis, Demonstrations, InteractionPrimitive, PolynomialBasis, StackedBasis


def test_closed_form_noise_is_the_papers() -> None:
    made = interactions(8, dtype=torch.float64)
    basis = StackedBasis([BSplineBasis(6)] * 3 + [PolynomialBasis(5)] * 2)
    primitive = InteractionPrimitive.fit(made, basis)
    per_demonstration = []
    for index, trajectory in enumerate(made):
        phase = torch.linspace(0, 1, len(trajectory), dtype=torch.float64)
        residual = trajectory - basis.project(phase, primitive.weights[index].expand(len(trajectory), -1))
        per_demonstration.append(np.nanmean(residual.numpy() ** 2, axis=0))
    np.testing.assert_allclose(primitive.residual_variance.numpy(), np.mean(per_demonstration, 0), rtol=1e-6)
    np.testing.assert_allclose(primitive.phase_velocity.numpy(), 1 / made.durations.numpy())
    corrected = primitive.residual_variance * primitive.residual_correlation_time
    torch.testing.assert_close(primitive.correlated_residual_variance, corrected)
    assert (primitive.residual_correlation_time >= 1).all()


def test_weights_of_different_families_land_in_their_places() -> None:
    made = Demonstrations(layout(), [t.nan_to_num(0.5) for t in interactions(5, dtype=torch.float64)], 30.0)
    basis = StackedBasis([BSplineBasis(6), PolynomialBasis(4), BSplineBasis(6), PolynomialBasis(4), BSplineBasis(7)])
    weights = InteractionPrimitive.fit(made, basis).weights
    for index, trajectory in enumerate(made):
        phase = torch.linspace(0, 1, len(trajectory), dtype=torch.float64)
        for dof, (part, where) in enumerate(zip(basis.bases, basis.weight_slices, strict=True)):
            expected = np.linalg.lstsq(part(phase).numpy(), trajectory[:, dof].numpy(), rcond=None)[0]
            np.testing.assert_allclose(weights[index, where].numpy(), expected, atol=1e-6)


def test_follows_dtype_and_keeps_its_settings() -> None:
    single, double = small_primitive(torch.float32), small_primitive(torch.float64)
    assert single.weights.dtype == torch.float32
    assert double.weights.dtype == torch.float64
    torch.testing.assert_close(single.weights.double(), double.weights, atol=1e-4, rtol=1e-4)
    assert single.double().residual_variance.dtype == torch.float64
    assert single.rate == 30.0


def test_end_variance_and_subset() -> None:
    primitive = small_primitive(torch.float64)
    ends = torch.stack([primitive.basis.project(torch.ones(()).double(), w) for w in primitive.weights])
    torch.testing.assert_close(primitive.end_variance, ends.var(0))
    part = primitive.subset(torch.tensor([3, 1]))
    assert len(part) == 2
    torch.testing.assert_close(part.weights[0], primitive.weights[3])


def test_a_constant_dof_has_a_positive_variance() -> None:
    made = [torch.cat([t[:, :4].nan_to_num(), torch.full_like(t[:, :1], 2.0)], -1) for t in interactions(4)]
    primitive = InteractionPrimitive.fit(Demonstrations(layout(), made, 30.0), StackedBasis([BSplineBasis(5)] * 5))
    assert (primitive.residual_variance > 0).all()


def test_errors() -> None:
    made = interactions(4)
    with pytest.raises(ValueError, match="at least 2 demonstrations"):
        InteractionPrimitive.fit(made.subset([0]))
    with pytest.raises(ValueError, match="basis is for 4 DoFs, the demonstrations have 5"):
        InteractionPrimitive.fit(made, StackedBasis([BSplineBasis(5)] * 4))
    short = Demonstrations(layout(), [made[0], made[1][:6]], 30.0)
    with pytest.raises(ValueError, match="demonstration 1 has 6 samples, fewer than the 9 functions"):
        InteractionPrimitive.fit(short, StackedBasis([BSplineBasis(9)] * 5))
    blind = [trajectory.clone() for trajectory in made]
    for trajectory in blind:
        trajectory[:, 4] = math.nan
    with pytest.raises(ValueError, match=r"arm\.2"):
        InteractionPrimitive.fit(Demonstrations(layout(), blind, 30.0), StackedBasis([BSplineBasis(5)] * 5))
