"""What looks wrong in recordings is said, each by a sentence of its own, and nothing of recordings that are fine."""

import math
import re

import pytest
import torch

from tests.conftest import interactions
from torch_ebip import Demonstrations, Layout, Modality
from torch_ebip.recordings import example

RATE = 50.0


def made(count: int = 24) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(60 + i, 3, generator=generator).cumsum(0) * 0.01 for i in range(count)]


def report(trajectories: list[torch.Tensor], unit: str = "m", **options):
    layout = Layout([Modality("hand", ["x", "y"], unit), Modality("arm", ["q"], "rad", controlled=True)])
    return Demonstrations(layout, trajectories, RATE, **options).report()


def changed(change, count: int = 24) -> list[torch.Tensor]:
    found = made(count)
    for trajectory in found:
        change(trajectory)
    return found


def still(values: torch.Tensor) -> None:
    values[:, 1] = 2.0


def never(values: torch.Tensor) -> None:
    values[:, 1] = math.nan


def gap(values: torch.Tensor) -> None:
    values[10:40, 0] = math.nan


def large(values: torch.Tensor) -> None:
    values[:, :2] *= 1000


def slow(values: torch.Tensor) -> None:
    values[:, :2] = values[::4, :2].repeat_interleave(4, 0)[: len(values)]


def turned(values: torch.Tensor) -> None:
    noise = 1e-3 * torch.arange(len(values)).sin()
    values[:, 2] = torch.where(torch.arange(len(values)) < 30, 3.1, -3.1) + noise


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (still, "hand: y never moves"), (never, "hand: y never measured"), (gap, "hand: up to 0.62 s without"),
        (large, "hand: values up to .* m: is it in mm?"), (slow, "hand: 7. % of its samples are the one before"),
        (turned, "q jumps by a whole turn"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_and_nothing_else(change, said: str) -> None:
    warnings = report(changed(change)).warnings
    assert len(warnings) == 1
    assert re.search(said, warnings[0])


def test_sets_of_recordings() -> None:
    assert report(made()).warnings == ()
    assert report(made(5)).warnings == ("5 demonstrations are few: from 20 on `learn` uses all that it has",)
    twice = made()
    twice[7] = twice[2].clone()
    assert report(twice).warnings == ("demonstrations are there more than once: 2, 7",)
    long = made()
    long[3] = long[3].repeat(9, 1)
    assert "were all cut alike?" in report(long).warnings[0]
    assert report(made(), remarks=["hand: a word"]).warnings == ("hand: a word",)


def test_numbers() -> None:
    found = report(changed(gap), labels=["wave", "reach"] * 12)
    assert (found.count, found.rate, found.labels) == (24, RATE, {"wave": 12, "reach": 12})
    assert found.durations == pytest.approx((59 / 50, 71 / 50, 82 / 50))
    everything = torch.cat(changed(gap))
    for dof, column in zip(found.dofs, everything.T, strict=True):
        said = column[~column.isnan()]
        assert dof.least == pytest.approx(float(said.min()))
        assert dof.most == pytest.approx(float(said.max()))
        assert dof.missing == pytest.approx(float(column.isnan().double().mean()))
    assert found.dofs[0].gap == pytest.approx(31 / RATE)
    assert found.dofs[1].gap == 0


def test_as_text_and_in_a_notebook() -> None:
    found = example().report()
    assert found.warnings == ()
    text = str(found)
    assert text.splitlines()[0].startswith("30 demonstrations at 30 Hz")
    assert len(text.splitlines()) == 2 + len(found.dofs)
    odd = interactions(4)
    page = Demonstrations(Layout([Modality("<b>", list("abcde"), "m")]), list(odd), 30.0).report()._repr_html_()
    assert "<b>" not in page
    assert page.count("<tr>") == 6
    assert "are few" in page
