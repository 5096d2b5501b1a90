"""What decides how far a forecast is drawn: numbers made for it, against numpy."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torch_ebip.learning import Weights, remaining
from torch_ebip.learning.said import Said
from torch_ebip.learning.shares import CERTAIN, DOUBT, standard_errors, trust, widening


def said(rho: float, n: int = 40, heavy: bool = False) -> Said:
    """One target at one horizon, forecast with a correlation; three moments and two sets of sensors each."""
    draws = np.random.default_rng(3)
    wanted = draws.standard_normal((n, 3, 1, 1)).repeat(2, 0)
    noise = draws.standard_t(2, wanted.shape) if heavy else draws.standard_normal(wanted.shape)
    towards = torch.tensor(rho * wanted + np.sqrt(1 - rho**2) * noise)
    one = torch.ones(2 * n, 3, 1, 1, dtype=torch.float64)
    interaction = torch.arange(n).repeat_interleave(2)
    return Said(interaction, towards, torch.tensor(wanted), one, one, one.unsqueeze(-1), one, one, one[..., 0, 0])


@pytest.mark.parametrize("rho", [0.0, 0.2, 0.45, 0.9])
def test_trust_grows_with_the_standard_errors_of_the_gain(rho: float) -> None:
    """Moments and sets of sensors of one interaction are one piece of evidence."""
    part, share = said(rho), 0.4
    believed = trust(part.interaction, part.wanted, share * part.towards, part.place)
    wanted, towards = part.wanted.numpy(), part.towards.numpy()
    gain = wanted**2 - (wanted - share * towards) ** 2
    each = gain.reshape(40, -1).mean(-1)
    z = each.mean() / (each.std(ddof=1) / np.sqrt(40))
    assert believed.item() == pytest.approx(np.clip((z - DOUBT) / (CERTAIN - DOUBT), 0, 1), abs=1e-6)


def test_what_cannot_be_shown_is_not_trusted_and_what_can_is() -> None:
    def found(rho: float) -> float:
        part = said(rho)
        return trust(part.interaction, part.wanted, 0.2 * part.towards, part.place).item()

    assert [found(rho) for rho in (0.0, 0.9)] == [0.0, 1.0]
    assert 0 < found(0.3) < 1


@pytest.mark.parametrize("heavy", [False, True])
def test_deviations_are_stretched_until_they_hold_what_they_say(heavy: bool) -> None:
    part = said(0.5, n=400, heavy=heavy)
    fold = part.interaction % 5
    share, width = torch.full_like(part.own, 0.3), torch.full_like(part.own, 0.5)
    miss = (part.wanted - share * part.towards).abs()
    whole, left_out = widening(miss / width, part.place, fold)
    assert float((miss <= 1.96 * whole.item() * width).double().mean()) == pytest.approx(0.95, abs=0.002)
    stretched = left_out[:, 0].view(-1, 1, 1, 1) * width
    assert float((miss <= 1.96 * stretched).double().mean()) == pytest.approx(0.95, abs=0.01)
    for f in range(5):
        others = (miss / width)[fold != f].flatten().numpy()
        assert left_out[fold == f, 0].unique().item() == pytest.approx(np.quantile(others, 0.95) / 1.959964)


def test_what_remains_is_what_no_share_of_a_forecast_explains(monkeypatch: pytest.MonkeyPatch) -> None:
    """By DoF and horizon, of two modalities; and in units of what the mean errs, of a tool beside them."""
    draws = np.random.default_rng(0)
    wanted = draws.standard_normal((12, 2, 2, 3)) * np.array([1.0, 2.0, 0.5])
    wanted[3, :, 1] = np.nan
    towards = 0.8 * np.nan_to_num(wanted) + 0.4 * draws.standard_normal(wanted.shape)
    mean, one = draws.standard_normal(wanted.shape), np.ones_like(wanted)
    tensors = [torch.tensor(of) for of in (towards, wanted, one, one, one[..., None], one, mean, one[..., 0, 0])]
    monkeypatch.setattr(remaining, "what_it_says", lambda *_: Said(torch.arange(12), *tensors))
    left = []
    for p in range(2):
        for dofs in ([0, 1], [2]):
            w, t = wanted[:, :, p, dofs].ravel(), towards[:, :, p, dofs].ravel()
            w, t = w[~np.isnan(w)], t[~np.isnan(w)]
            share = np.clip((t @ w) / (t @ t), 0, 1)
            left += [np.abs(w - share * t).mean() / np.abs(w).mean()] * len(dofs)

    def held_out(**objective: object) -> SimpleNamespace:
        modality = torch.tensor([0, 0, 1, 2])
        layout = SimpleNamespace(modality_of_dof=modality)
        named = {"arm": None, "joints": None, "weights": Weights(), "scale": torch.full((2, 3), 2.0)} | objective
        task = SimpleNamespace(
            primitive=SimpleNamespace(layout=layout), targets=modality < 2, objective=SimpleNamespace(**named)
        )
        return SimpleNamespace(task=task)

    alone = remaining.remaining_error(held_out(), None, None)
    assert alone == pytest.approx(np.mean(left))
    tool = {"arm": lambda a, b: (a - b).abs().nanmean(), "joints": [2], "weights": Weights(tool=3.0)}
    w, t = wanted[:, :, 1, 2], towards[:, :, 1, 2]
    known = ~np.isnan(w)
    share = np.clip((t[known] @ w[known]) / (t[known] @ t[known]), 0, 1)
    of_tool = np.abs(w - share * t)[known].mean() / np.abs(w)[known].mean()
    assert remaining.remaining_error(held_out(**tool), None, None) == pytest.approx((2 * alone + 3 * of_tool) / 5)


@pytest.mark.parametrize("rest", [0.0, 4.4e-16, 2.4e-7])
def test_who_comes_near_a_horizon_by_rounding_says_nothing_of_it(rest: float) -> None:
    """Half of the interactions end before it; what is left of their weight is rounding."""
    draws = torch.Generator().manual_seed(0)
    wanted = torch.randn(24, 1, 1, 1, generator=draws)
    weight = torch.cat([torch.ones(12, 1, 1, 1), torch.full((12, 1, 1, 1), rest)])
    found = standard_errors(torch.arange(24), wanted, 0.8 * wanted, weight)
    alone = standard_errors(torch.arange(12), wanted[:12], 0.8 * wanted[:12])
    assert found == pytest.approx(alone, rel=1e-6)
