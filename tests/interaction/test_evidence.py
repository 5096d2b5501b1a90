"""Evidence weights against the formula of their docstring, sample by sample in numpy."""

import numpy as np
import pytest
import torch

from torch_ebip import DemonstrationTable, EvidenceWeighting
from torch_ebip.filtering.updates.weighting import Seen


def draws(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_weights_are_those_of_the_formula() -> None:
    variance = torch.tensor([0.5, 2.0, 4.0], dtype=torch.float64)
    table = DemonstrationTable(draws(7, 5, 3, seed=2), draws(7, 5, 3, seed=3))
    module = EvidenceWeighting(
        table,
        variance,
        torch.tensor([0, 0, 1]),
        3.0,
        forgetting=4.0,
        slope=1.5,
        wander=0.1,
        offsets=(-0.1, 0.0, 0.2),
    )
    with torch.no_grad():
        module.factor.raw[1] = 1.0
    factor = module.factor.value.detach().numpy()[[0, 0, 1]]
    projections, y = draws(5, 7, 3, 3, seed=0), draws(5, 3, seed=1)
    observed = np.array([[1, 1, 1], [1, 0, 1], [0, 0, 0], [0, 1, 0], [1, 1, 1]], dtype=bool)
    dt, phases = 0.1, torch.linspace(0.1, 0.9, 5, dtype=torch.float64)
    evidence = module.start(torch.arange(7))
    misfit, seen, weights = np.zeros(7), 0.0, np.full(7, 1 / 7)
    for t in range(5):
        if t:
            evidence = module.forget(evidence, torch.tensor(dt, dtype=torch.float64))
            misfit, seen = misfit * np.exp(-4.0 * dt), seen * np.exp(-4.0 * dt)
        shown = torch.tensor(observed[t])
        value = torch.where(shown, y[t], torch.nan)
        mean = torch.stack([phases[t], torch.tensor(0.5).double()])
        sample = Seen(value, shown, None, None, mean.expand(7, 2), mean, torch.arange(7))
        evidence = module.compare(evidence, projections[t], sample)
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
            weighting(defensive=share)


def weighting(**options: float) -> EvidenceWeighting:
    return EvidenceWeighting(
        DemonstrationTable(torch.zeros(3, 5, 2), torch.zeros(3, 5, 2)),
        torch.ones(2),
        torch.zeros(2, dtype=torch.long),
        **options,
    )


def test_a_table_of_other_dofs_is_refused() -> None:
    table = DemonstrationTable(torch.zeros(3, 5, 2), torch.zeros(3, 5, 2))
    with pytest.raises(ValueError, match="of 2, 3 and 3 DoFs, which must be the same"):
        EvidenceWeighting(table, torch.ones(3), torch.zeros(3, dtype=torch.long))


def test_a_sample_is_compared_with_the_demonstration_near_the_members_phase() -> None:
    """Of two demonstrations, 0 and 1 throughout, a member that is the second explains a 1."""
    values = torch.stack([torch.zeros(5, 2), torch.ones(5, 2)])
    module = EvidenceWeighting(DemonstrationTable(values, 0 * values), torch.ones(2), torch.tensor([0, 0]))
    origin = torch.tensor([1, 0, 1])
    moving = torch.tensor([0.3, 0.5]).expand(3, 2)
    seen = Seen(torch.ones(1), None, None, torch.tensor([1]), moving, moving[0], origin)
    weights = module.learn(module.start(origin), seen).weights
    assert weights[0] == weights[2] > 10 * weights[1]
