"""Evidence weights against the formula of their docstring, sample by sample in numpy."""

import numpy as np
import pytest
import torch

from torch_ebip import DemonstrationTable, EvidenceWeighting
from torch_ebip.filtering.updates.weighting import Seen
from torch_ebip.interaction.evidence import LEAST_SPREAD


def draws(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("relative", [0.0, 1.0, -0.4])
@pytest.mark.parametrize(
    ("sharpness", "rates", "slope"),
    [([3.0], [4.0], [1.5]), ([3.0, 2.0], [4.0, 0.5], [1.5, -1.0]), ([0.5, 1.0, 2.0], [6.0, 1.0, 0.01], [2.0] * 3)],
)
def test_weights_are_those_of_the_formula(
    sharpness: list[float], rates: list[float], slope: list[float], relative: float
) -> None:
    variance = torch.tensor([0.5, 2.0, 4.0], dtype=torch.float64)
    values = draws(7, 5, 3, seed=2)
    table = DemonstrationTable(values, draws(7, 5, 3, seed=3))
    spreads = values.numpy().var(0, ddof=1) / variance.numpy()
    module = EvidenceWeighting(
        table,
        variance,
        torch.tensor([0, 0, 1]),
        sharpness,
        forgetting=rates,
        slope=slope,
        primacy=0.7,
        relative=relative,
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
    M = len(rates)
    misfit, seen, weights = np.zeros((M, 7)), np.zeros(M), np.full(7, 1 / 7)
    for t in range(5):
        if t:
            evidence = module.forget(evidence, torch.tensor(dt, dtype=torch.float64))
            keep = np.exp(-np.array(rates) * dt)
            misfit, seen = misfit * keep[:, None], seen * keep
        shown = torch.tensor(observed[t])
        value = torch.where(shown, y[t], torch.nan)
        mean = torch.stack([phases[t], torch.tensor(0.5).double()])
        sample = Seen(value, shown, None, None, mean.expand(7, 2), mean, torch.arange(7))
        evidence = module.compare(evidence, projections[t], sample)
        if observed[t].any():
            unit = [
                np.interp(phases[t], np.linspace(0, 1, 5), (spreads[:, d] + LEAST_SPREAD) ** -relative)
                for d in range(3)
            ]
            squares = (projections[t] - y[t]).numpy() ** 2 * factor / variance.numpy() * np.array(unit)
            tempers = 0.5 * np.array(sharpness) * np.exp(np.array(slope) * (phases[t].item() - 0.5))
            temper = tempers.sum()
            prior = np.exp([-0.5, 0.0, -2.0])
            likelihood = np.exp(-temper * squares[..., observed[t]].mean(-1)) @ (prior / prior.sum())
            held = np.exp(-0.7 * (phases[t].item() - 0.5))
            misfit, seen = misfit - held * np.log(likelihood) / temper, seen + held
            logits = -(tempers[:, None] * misfit / np.maximum(seen, held)[:, None]).sum(0)
            soft = np.exp(logits - logits.max())
            weights = 0.98 * soft / soft.sum() + 0.02 / 7
        np.testing.assert_allclose(evidence.weights.detach().numpy(), weights, atol=1e-12, err_msg=f"sample {t}")


def test_a_share_outside_the_interval_is_refused() -> None:
    for share in (0.0, 1.0):
        with pytest.raises(ValueError, match="defensive must lie between 0 and 1"):
            weighting(defensive=share)


def weighting(**options: float | list[float]) -> EvidenceWeighting:
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


def test_a_gradient_reaches_every_memory() -> None:
    """From a start that hears the fast one alone nearly: the slow one can still be turned up."""
    table = DemonstrationTable(draws(6, 5, 2, seed=2), 0 * draws(6, 5, 2, seed=2))
    module = EvidenceWeighting(
        table, torch.ones(2).double(), torch.tensor([0, 0]), [10.0, 0.01], forgetting=[6.0, 0.01]
    )
    origin, memory = torch.arange(6), module.start(torch.arange(6))
    for t, y in enumerate(draws(8, 2, seed=4)):
        memory = module.forget(memory, torch.tensor(0.1).double()) if t else memory
        moving = torch.tensor([0.1 * t, 0.5]).double().expand(6, 2)
        memory = module.learn(memory, Seen(y, None, None, None, moving, moving[0], origin))
    (memory.weights * torch.arange(6)).sum().backward()
    for parameter in (
        module.sharpness.raw,
        module.forgetting.raw,
        module.slope.raw,
        module.primacy.raw,
        module.relative.raw,
    ):
        assert parameter.grad is not None
        assert (parameter.grad != 0).all()
        assert parameter.grad.isfinite().all()


def test_what_was_seen_first_is_remembered_or_not() -> None:
    """One demonstration fits the beginning, the other the rest: the fast memory takes that, the slow one neither."""
    table = DemonstrationTable(torch.stack([torch.zeros(5, 1), torch.ones(5, 1)]), torch.zeros(2, 5, 1))
    said = {}
    for name, rate in (("fast", 6.0), ("slow", 0.001)):
        module = EvidenceWeighting(table, torch.ones(1), torch.tensor([0]), forgetting=rate)
        origin = torch.arange(2)
        memory = module.start(origin)
        for t in range(20):
            memory = module.forget(memory, torch.tensor(0.1)) if t else memory
            moving = torch.tensor([0.5, 0.5]).expand(2, 2)
            y = torch.tensor([0.0 if t < 10 else 1.0])
            memory = module.learn(memory, Seen(y, None, None, None, moving, moving[0], origin))
        said[name] = memory.weights[1].item()
    assert said["fast"] > 0.9
    assert said["slow"] == pytest.approx(0.5, abs=0.02)


def test_a_distance_tells_more_where_demonstrations_are_close_together() -> None:
    """Two demonstrations that part by 0.1 early and by 10 late: half-way between the second and both, twice."""
    values = torch.tensor([0.1, 0.1, 0.1, 10.0, 10.0])
    table = DemonstrationTable(torch.stack([torch.zeros(5, 1), values.unsqueeze(-1)]), torch.zeros(2, 5, 1))
    told = {}
    for relative in (0.0, 1.0):
        for phase, y in ((0.1, 0.075), (0.9, 7.5)):
            module = EvidenceWeighting(
                table, torch.tensor([20.0]), torch.tensor([0]), 4.0, slope=0.0, relative=relative, offsets=[0.0]
            )
            moving = torch.tensor([phase, 0.5]).expand(2, 2)
            seen = Seen(torch.tensor([y]), None, None, None, moving, moving[0], torch.arange(2))
            told[relative, phase] = module.learn(module.start(torch.arange(2)), seen).weights[1].item()
    assert told[0.0, 0.1] == pytest.approx(0.5, abs=0.001)
    assert told[1.0, 0.1] - 0.5 > 9 * (told[0.0, 0.1] - 0.5) > 0
    assert told[0.0, 0.9] > 0.9


def test_a_sharpness_for_each_memory_is_asked_for() -> None:
    with pytest.raises(ValueError, match="sharpness must be one number for each memory, got 3 for 2"):
        weighting(sharpness=[1.0, 2.0, 3.0], forgetting=[6.0, 0.1])
    with pytest.raises(ValueError, match="forgetting must be a positive number, got 0"):
        weighting(forgetting=[6.0, 0.0])
    with pytest.raises(ValueError, match="slope must be one number for each memory, got 1 for 2"):
        weighting(forgetting=[6.0, 0.1], slope=[1.0])
    with pytest.raises(ValueError, match="relative must be a finite number"):
        weighting(relative=float("nan"))


def test_numbers_of_memories_may_be_any_sequence() -> None:
    for rates in ([6.0, 0.1], (6.0, 0.1), np.array([6.0, 0.1]), torch.tensor([6.0, 0.1])):
        module = weighting(sharpness=rates, forgetting=rates)
        assert module.sharpness.value.tolist() == pytest.approx([6.0, 0.1])
    assert weighting(forgetting=np.float32(2.0)).forgetting.value.tolist() == [2.0]
