"""Baselines: each learns what it can learn, none reads what it was not shown."""

import math

import numpy as np
import pytest
import torch

from experiments.baselines import (
    BallisticMethod,
    RecurrentMethod,
    RecurrentSettings,
    RidgeMethod,
    TreesMethod,
    UntoldTreesMethod,
)
from experiments.baselines.regression import last_values, resampled_prefix
from experiments.evaluate import MeanMethod, Method, Task, evaluate
from tests.conftest import interactions, layout, small_primitive
from torch_ebip import Demonstrations, Layout, Modality

FRACTIONS = (0.43, 0.82)
AHEAD = (0.1, 0.25, math.inf)
TASK = Task({"all": ["hand", "gaze"]}, FRACTIONS, [], ["arm"], {}, None, AHEAD[:-1])
QUICK = RecurrentSettings(networks=2, hidden=24, steps=150, batch_size=24)


def learned() -> dict[str, Method]:
    """Everything that learns from the demonstrations in conftest."""
    made = interactions(40)
    targets = layout().mask(["arm"])
    subsets = {"all": layout().mask(["hand", "gaze"])}
    return {
        "ridge": RidgeMethod(made, targets, FRACTIONS, AHEAD),
        "trees": TreesMethod(made, targets, FRACTIONS, AHEAD, trees=50),
        "trees_untold": UntoldTreesMethod(made, targets, FRACTIONS, AHEAD, trees=50),
        "gru": RecurrentMethod(made, targets, subsets, QUICK, AHEAD),
    }


@pytest.fixture(scope="module")
def methods() -> dict[str, Method]:
    return learned()


def test_they_learn(methods: dict[str, Method]) -> None:
    """The arm's end is a linear function of two causes that the hand shows, to a noise of 0.01."""
    values = evaluate(TASK, {**methods, "mean": MeanMethod(small_primitive())}, interactions(30, seed=5))
    cells = [cell for cell in values if cell.metric == "mae"]
    assert len(cells) == 6
    for cell in cells:
        mean = np.nanmean(values[cell]["mean"])
        assert np.nanmean(values[cell]["ridge"]) < 0.25 * mean
        assert np.nanmean(values[cell]["trees"]) < 0.5 * mean
        assert np.nanmean(values[cell]["trees_untold"]) < 0.6 * mean
        assert np.nanmean(values[cell]["gru"]) < (0.5 if cell.ahead is None else 0.6) * mean
    covered = next(values[cell]["gru"].mean() for cell in values if cell.metric == "coverage_95")
    assert 0.8 < covered <= 1


def test_nobody_reads_what_is_not_shown(methods: dict[str, Method]) -> None:
    """Garbage in the future, in hidden sensors and in the targets changes no answer."""
    y, measured = interactions(6, seed=5).pad()
    keep = torch.tensor([[10, 20]] * 6)
    shown = torch.tensor([True, True, False, False, False])
    observed = measured & shown & (torch.arange(y.shape[1]) <= 20).view(1, -1, 1)
    spoiled = torch.where(observed, y, 99.0)
    targets = layout().mask(["arm"])
    for name, method in methods.items():
        a, b = (method(values, observed, keep, targets).forecast.mean for values in (y, spoiled))
        assert torch.equal(a, b), name
        early = method(
            torch.where(observed & (torch.arange(y.shape[1]) > 10).view(1, -1, 1), 7.0, y), observed, keep, targets
        )
        assert torch.equal(early.forecast.mean[:, 0], a[:, 0]), name
        assert not torch.equal(early.forecast.mean[:, 1], a[:, 1]), name


def test_untold_trees_do_not_know_how_much_they_see(methods: dict[str, Method]) -> None:
    """One regressor answers at every share, and the same samples get the same answer whatever share they are."""
    trees = methods["trees_untold"]
    assert isinstance(trees, UntoldTreesMethod)
    shown = torch.tensor([True, True, False, False, False])
    assert trees.fit(shown, 0.43) is trees.fit(shown, 0.82)
    y, measured = interactions(4, seed=5).pad()
    observed = measured & shown & (torch.arange(y.shape[1]) <= 15).view(1, -1, 1)
    said = trees(y, observed, torch.tensor([[15, 15]] * 4), layout().mask(["arm"])).forecast.mean
    assert torch.equal(said[:, 0], said[:, 1])
    told = methods["trees"](y, observed, torch.tensor([[15, 15]] * 4), layout().mask(["arm"])).forecast.mean
    assert not torch.equal(told[:, 0], told[:, 1])


def test_nothing_shown_is_the_mean(methods: dict[str, Method]) -> None:
    y, measured = interactions(3, seed=5).pad()
    nothing = torch.zeros_like(measured)
    ends = torch.stack([trajectory[-1, 3:] for trajectory in interactions(40)]).mean(0)
    for name in ("ridge", "trees"):
        mean = methods[name](y, nothing, torch.tensor([[10, 20]] * 3), layout().mask(["arm"])).forecast.mean
        torch.testing.assert_close(mean, ends.expand(3, 2, 1, 2), atol=0.35, rtol=0, msg=name)


def test_a_seed_reproduces_and_the_global_generator_is_left_alone() -> None:
    before = torch.get_rng_state()
    y, measured = interactions(3, seed=5).pad()
    shown = measured & torch.tensor([True, True, True, False, False])
    answers = [learned()["gru"](y, shown, torch.tensor([[9, 19]] * 3), layout().mask(["arm"])) for _ in range(2)]
    assert torch.equal(answers[0].forecast.mean, answers[1].forecast.mean)
    assert torch.equal(before, torch.get_rng_state())


def test_features_of_a_prefix() -> None:
    y = torch.tensor([[[0.0, 1.0], [2.0, math.nan], [4.0, 3.0], [9.0, 9.0]]])
    seen = torch.tensor([[[True, True], [True, False], [True, True], [False, False]]])
    assert last_values(y, seen).tolist() == [[4.0, 3.0]]
    assert resampled_prefix(y, seen, torch.tensor([2]), 3).tolist() == [[0.0, 2.0, 4.0, 1.0, 2.0, 3.0]]


def throws(count: int, seed: int) -> Demonstrations:
    """Drag-free parabolas at 100 Hz from x = 0, caught where x = 3; the hand hides the first 10 samples."""
    generator = torch.Generator().manual_seed(seed)
    made = []
    for _ in range(count):
        speed, side, up = 4 + torch.rand(3, generator=generator, dtype=torch.float64)
        end = 3 / speed
        time = torch.arange(int(100 * end) + 1, dtype=torch.float64) / 100
        time = torch.cat([time, end.view(1)]) if 100 * end % 1 > 1e-9 else time
        path = torch.stack([speed * time, 0.2 * (side - 4.5) * time, 1 + up * time - 9.81 / 2 * time**2], -1)
        path[:10] = math.nan
        made.append(torch.cat([path, torch.zeros(len(path), 1).double()], -1))
    modalities = [Modality("ball", ["x", "y", "z"], "m"), Modality("arm", ["a"], "rad", controlled=True)]
    return Demonstrations(Layout(modalities), made, 100.0)


def test_ballistics_is_exact_without_drag() -> None:
    method = BallisticMethod(throws(40, 0), tilted=False, drag=False)
    tests = throws(10, 1)
    y, measured = tests.pad()
    keep = torch.tensor([[30, 5]] * 10)
    answer = method(y, measured & torch.tensor([True] * 3 + [False]), keep, torch.tensor([True] * 4))
    ends = torch.stack([trajectory[-1, :3] for trajectory in tests])
    torch.testing.assert_close(answer.forecast.mean[:, 0, 0, :3], ends, atol=0.01, rtol=0)
    assert answer.forecast.mean[:, 0, 0, 3].isnan().all()  # of the arm it knows nothing
    assert answer.forecast.mean[:, 1].isnan().all()  # nothing to be seen after five samples


def test_bad_input_is_named() -> None:
    made = interactions(8)
    with pytest.raises(ValueError, match="8 demonstrations are too few"):
        RecurrentMethod(made, layout().mask(["arm"]), {"all": layout().mask(["hand"])})
    with pytest.raises(ValueError, match="hand has 2 DoFs, a position has 3"):
        BallisticMethod(made, "hand")
    ridge = RidgeMethod(made, layout().mask(["arm"]), FRACTIONS)
    y, measured = made.pad()
    with pytest.raises(ValueError, match=r"0\.3.* s ahead were not learned"):
        ridge(y, measured, torch.tensor([[5, 6]] * 8), layout().mask(["arm"]), (0.3,))
    with pytest.raises(ValueError, match="1 columns for the 2 fractions"):
        ridge(y, measured, torch.tensor([[5]] * 8), layout().mask(["arm"]))
