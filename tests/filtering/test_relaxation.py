"""Relaxation to the prior's perturbations against its formula, on both carriers."""

import pytest
import torch

from tests.conftest import interactions, small_primitive
from torch_ebip import LiveFilter, Positive, RelaxationToPrior, SquareRoot, Stochastic, Update, ebip
from torch_ebip.filtering.updates import Rule
from torch_ebip.interaction import InteractionEnsembleFilter

HUMAN = torch.tensor([True, True, True, False, False])
RULES = {"square root": SquareRoot(), "stochastic": Stochastic()}


def relaxed(rule: Rule, alpha: float | torch.nn.Module | None) -> InteractionEnsembleFilter:
    plain = ebip(small_primitive(torch.float64))
    inflation = None if alpha is None else RelaxationToPrior(alpha)
    return InteractionEnsembleFilter(plain.model, plain.prior, 24, Update(rule, inflation=inflation))


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_anomalies_are_a_mixture_of_those_before_and_after(rule: Rule) -> None:
    y = torch.where(HUMAN, interactions(2, seed=9, dtype=torch.float64)[1][5], torch.nan)
    state = relaxed(rule, None).initial_state()
    prior = state.members - state.mean
    after = [relaxed(rule, a).update(state, y, generator=torch.Generator().manual_seed(0))[0] for a in (None, 0.3)]
    plain, mixed = (each.members.detach() - each.mean.detach() for each in after)
    torch.testing.assert_close(after[0].mean, after[1].mean)
    torch.testing.assert_close(mixed, 0.7 * plain + 0.3 * prior)
    assert (plain.std(0) < prior.std(0)).any()


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
@pytest.mark.parametrize("batch", [(), (3,)])
def test_both_carriers_serve_it(rule: Rule, batch: tuple[int, ...]) -> None:
    made = relaxed(rule, 0.4)
    assert made.has_live_path
    y = (
        torch.where(HUMAN, interactions(2, seed=9, dtype=torch.float64)[1][:25], torch.nan)
        .expand(*batch, 25, 5)
        .clone()
    )
    if batch:
        y[1, 7] = torch.nan  # an entry that measured nothing is left as it is
    dense = made(y, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        span = made(y, generator=torch.Generator().manual_seed(0), engine="span")
    assert (dense.engine, span.engine) == ("dense", "span")
    torch.testing.assert_close(span.state.members, dense.state.members)
    live = LiveFilter(made, HUMAN, batch, generator=torch.Generator().manual_seed(0))
    live.update(y[..., 0, :])
    assert live.finite


def test_it_is_learned_and_a_sample_for_four_relaxes_four_times() -> None:
    made = relaxed(SquareRoot(), Positive(torch.tensor(0.2, dtype=torch.float64)))
    y = torch.where(HUMAN, interactions(2, seed=9, dtype=torch.float64)[1][:5], torch.nan)
    made.forecast(made(y).state, 1.0).variance.sum().backward()
    gradient = made.analysis.inflation.alpha.raw.grad
    assert gradient.isfinite()
    assert gradient > 0  # the more is kept, the wider the forecast
    part = made.restrict(torch.ones(5, dtype=torch.bool), 4)
    spread, _ = part.analysis.inflation(None, torch.ones((), dtype=torch.float64))
    assert float(spread.keep.detach()) == pytest.approx(0.8**4)
    with pytest.raises(ValueError, match="alpha must"):
        RelaxationToPrior(1.5)
