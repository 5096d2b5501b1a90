"""What decides how far a forecast is drawn: numbers made for it, against numpy."""

import numpy as np
import pytest
import torch

from torch_ebip.learning.drawing import CERTAIN, DOUBT, Said, _trust, _widening


def said(rho: float, n: int = 40, heavy: bool = False) -> Said:
    """One target at one horizon, forecast with a correlation; three moments and two sets of sensors each."""
    draws = np.random.default_rng(3)
    wanted = draws.standard_normal((n, 3, 1, 1)).repeat(2, 0)
    noise = draws.standard_t(2, wanted.shape) if heavy else draws.standard_normal(wanted.shape)
    towards = torch.tensor(rho * wanted + np.sqrt(1 - rho**2) * noise)
    one = torch.ones(2 * n, 3, 1, 1, dtype=torch.float64)
    interaction = torch.arange(n).repeat_interleave(2)
    return Said(interaction, towards, torch.tensor(wanted), one, one, one.unsqueeze(-1), one)


@pytest.mark.parametrize("rho", [0.0, 0.2, 0.45, 0.9])
def test_trust_grows_with_the_standard_errors_of_the_gain(rho: float) -> None:
    """Moments and sets of sensors of one interaction are one piece of evidence."""
    part, share = said(rho), 0.4
    fold = part.interaction % 5
    trust = _trust(part, torch.full((5, 1, 1), share, dtype=torch.float64), fold)
    wanted, towards = part.wanted.numpy(), part.towards.numpy()
    gain = wanted**2 - (wanted - share * towards) ** 2
    each = gain.reshape(40, -1).mean(-1)
    z = each.mean() / (each.std(ddof=1) / np.sqrt(40))
    assert trust.item() == pytest.approx(np.clip((z - DOUBT) / (CERTAIN - DOUBT), 0, 1), abs=1e-6)


def test_what_cannot_be_shown_is_not_trusted_and_what_can_is() -> None:
    fold = said(0.0).interaction % 5
    share = torch.full((5, 1, 1), 0.2, dtype=torch.float64)
    assert [_trust(said(rho), share, fold).item() for rho in (0.0, 0.9)] == [0.0, 1.0]
    half = _trust(said(0.3), share, fold).item()
    assert 0 < half < 1


@pytest.mark.parametrize("heavy", [False, True])
def test_deviations_are_stretched_until_they_hold_what_they_say(heavy: bool) -> None:
    part = said(0.5, n=400, heavy=heavy)
    fold = part.interaction % 5
    share, width = torch.full_like(part.own, 0.3), torch.full_like(part.own, 0.5)
    whole, left_out = _widening(part, share, width, fold)
    miss = (part.wanted - share * part.towards).abs()
    assert float((miss <= 1.96 * whole.item() * width).double().mean()) == pytest.approx(0.95, abs=0.002)
    stretched = left_out[:, 0].view(-1, 1, 1, 1) * width
    assert float((miss <= 1.96 * stretched).double().mean()) == pytest.approx(0.95, abs=0.01)
    for f in range(5):
        others = (miss / width)[fold != f].flatten().numpy()
        assert left_out[fold == f, 0].unique().item() == pytest.approx(np.quantile(others, 0.95) / 1.959964)
