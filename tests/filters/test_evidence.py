"""Evidence weights against the formula of their docstring, sample by sample in numpy."""

import numpy as np
import pytest
import torch

from torch_ebip.filters import EvidenceWeighting


def draws(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_weights_are_those_of_the_formula() -> None:
    variance = torch.tensor([0.5, 2.0, 4.0], dtype=torch.float64)
    module = EvidenceWeighting(
        variance, torch.tensor([0, 0, 1]), 3.0, forgetting=4.0, slope=1.5, wander=0.1, offsets=(-0.1, 0.0, 0.2)
    )
    with torch.no_grad():
        module.factor.raw[1] = 1.0
    factor = module.factor.value.detach().numpy()[[0, 0, 1]]
    projections, y = draws(5, 7, 3, 3, seed=0), draws(5, 3, seed=1)
    observed = np.array([[1, 1, 1], [1, 0, 1], [0, 0, 0], [0, 1, 0], [1, 1, 1]], dtype=bool)
    dt, phases = 0.1, torch.linspace(0.1, 0.9, 5, dtype=torch.float64)
    evidence = module.start(torch.zeros(7, 9, dtype=torch.float64))
    misfit, seen, weights = np.zeros(7), 0.0, np.full(7, 1 / 7)
    for t in range(5):
        if t:
            evidence = module.forget(evidence, torch.tensor(dt, dtype=torch.float64))
            misfit, seen = misfit * np.exp(-4.0 * dt), seen * np.exp(-4.0 * dt)
        shown = torch.tensor(observed[t])
        value = torch.where(shown, y[t], torch.nan)
        evidence = module.learn(evidence, projections[t], value, shown, phases[t], None)
        if observed[t].any():
            squares = (projections[t] - y[t]).numpy() ** 2 * factor / variance.numpy()
            temper = 0.5 * 3.0 * np.exp(1.5 * (phases[t].item() - 0.5))
            prior = np.exp([-0.5, 0.0, -2.0])
            likelihood = np.exp(-temper * squares[..., observed[t]].mean(-1)) @ (prior / prior.sum())
            misfit, seen = misfit - np.log(likelihood) / temper, seen + 1
            logits = -misfit / seen * temper
            soft = np.exp(logits - logits.max())
            weights = 0.98 * soft / soft.sum() + 0.02 / 7
        np.testing.assert_allclose(evidence.weights.detach().numpy(), weights, atol=1e-12, err_msg=f"sample {t}")


def test_a_share_outside_the_interval_is_refused() -> None:
    for share in (0.0, 1.0):
        with pytest.raises(ValueError, match="defensive must lie between 0 and 1"):
            EvidenceWeighting(torch.ones(2), torch.zeros(2, dtype=torch.long), defensive=share)
