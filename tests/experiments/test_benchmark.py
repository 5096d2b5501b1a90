"""The benchmark compares things that do the same, and takes turns fairly. It asserts no time."""

from importlib.util import find_spec

import pytest
import torch

from experiments.benchmark import bending, growth, step
from experiments.benchmark.floor import floor
from experiments.benchmark.problem import make_problem
from experiments.benchmark.versions import Loop
from experiments.timing import interleaved

PEERS = ["live", "loop", "numpy", *(["filterpy"] if find_spec("filterpy") else [])]


@pytest.mark.parametrize("sensors", [4, 12])
def test_all_versions_do_the_same(sensors: int) -> None:
    problem = make_problem(156, 10, sensors, torch.float64, samples=40)
    differences = step.check(problem, PEERS, steps=30)
    assert max(differences.values()) < 1e-9


def test_a_version_that_does_something_else_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = make_problem(156, 10, 4, torch.float64, samples=40)
    monkeypatch.setattr(Loop, "step", lambda self, y: None)
    with pytest.raises(RuntimeError, match="loop differs"):
        step.check(problem, ["loop"])


def test_timings_take_turns() -> None:
    calls: list[tuple[int, str]] = []
    rounds: list[int] = []
    actions = {name: (lambda name=name: calls.append((rounds[-1], name))) for name in "abc"}
    timings = interleaved(actions, 30, every={"c": 3}, before=rounds.append, warmup=0)
    assert rounds == list(range(30))
    assert {name: timing.calls for name, timing in timings.items()} == {"a": 30, "b": 30, "c": 10}
    orders = {tuple(name for at, name in calls if at == round_) for round_ in range(0, 30, 3)}
    assert len(orders) > 3


def test_the_problem_has_the_size_of_the_paper() -> None:
    problem = make_problem(559, 80, 10, torch.float32)
    assert problem.filter.prior.states.shape == (80, 561)
    assert problem.y.shape == (100, 43)
    floor(problem)()
    floor(problem, whole=True)()
    floor(problem, weigh=True)()


def test_growth_reports_every_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "SIZES", {"members": (10, 20), "batch": (1, 2)})
    rows = growth.growth(3, 0)
    assert [row["varied"] for row in rows] == ["members", "batch"]
    assert all(len(row["microseconds"]) == 2 and min(row["microseconds"]) > 0 for row in rows)


def test_a_forecast_that_bends_is_timed_beside_one_that_does_not() -> None:
    rows = bending.bending(3, 0, quick=True)
    assert [row["horizons"] for row in rows] == [1, 5]
    assert all(row["heard"] > row["bends"] > row["straight"] > 0 for row in rows)
