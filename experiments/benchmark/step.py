"""One predict and update: ours against the floor, a loop, numpy and public peers; and over a grid of sizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch

from experiments.benchmark.floor import floor
from experiments.benchmark.problem import Problem, make_problem
from experiments.benchmark.versions import FilterPy, Live, Loop, Module, Numpy, Version
from experiments.timing import Timing, interleaved, threads

BATCH = 22
"""Interactions of a test fold."""
SLOW = {"loop": 7, "filterpy": 37}
"""Versions that take part in every k-th round only; no divisors of an interaction's length, to see all of it."""


def make(name: str, problem: Problem, seed: int, given: bool = False) -> Version:
    """A version at the start of the interaction; with ``given``, all of them have the same draws."""
    generator = torch.Generator().manual_seed(seed)
    dtype = problem.y.dtype

    def draw(*shape: int) -> torch.Tensor:
        """Draws of torch."""
        return torch.randn(shape, generator=generator, dtype=dtype)

    own = np.random.default_rng(seed)
    narrow: Any = np.float32 if dtype == torch.float32 else np.float64

    def draw_array(shape: tuple[int, ...]) -> Any:
        """Draws of numpy, or those of torch."""
        return draw(*shape).numpy() if given else own.standard_normal(shape, dtype=narrow)

    builders: Mapping[str, Callable[[], Version]] = {
        "live": lambda: Live(problem, generator),
        "live, batch": lambda: Live(problem, generator, BATCH),
        "live, weighted": lambda: Live(problem, generator, weigh=True),
        "filter": lambda: Module(problem, generator),
        "loop": lambda: Loop(problem, draw),
        "numpy": lambda: Numpy(problem, draw_array),
        "filterpy": lambda: FilterPy(problem, draw_array),
    }
    return builders[name]()


def check(problem: Problem, names: list[str], steps: int = 5) -> dict[str, float]:
    """Largest difference of members from `EnsembleFilter`'s after some steps with the same draws, float64.

    A batch has draws of its own, and weights are something else: they are compared in the tests of the live path.

    Raises:
        RuntimeError: a version that does not do the same; there is no point in timing it.
    """
    expected = _run(make("filter", problem, 0), problem, steps)
    differences = {}
    for name in names:
        version = make(name, problem, 0, given=True)
        with version.given_draws() if isinstance(version, FilterPy) else nullcontext():
            found = _run(version, problem, steps)
        differences[name] = float((found - expected).abs().max())
        if not differences[name] < 1e-8:
            raise RuntimeError(f"{name} differs from the filter by {differences[name]:.2g} after {steps} steps")
    return differences


def _run(version: Version, problem: Problem, steps: int) -> torch.Tensor:
    for y in problem.y[:steps, problem.sensors]:
        version.step(y)
    return version.members()


def compare(
    problem: Problem, names: list[str], rounds: int, seed: int = 0, bare: bool = True, weigh: bool = False
) -> dict[str, Timing]:
    """Time versions in turn along the interaction, which begins again at its end.

    Args:
        problem: the interaction.
        names: of the versions.
        rounds: calls that count.
        seed: of the draws.
        bare: time the floors, too.
        weigh: among them that of a step with evidence weights.
    """
    samples = problem.y[:, problem.sensors].unbind(0)
    now: dict[str, Any] = {"y": samples[0]}

    def before(round_: int) -> None:
        """Next sample; all start over together."""
        position = round_ % len(samples)
        if position == 0 or "live" not in now:
            now.update({name: make(name, problem, seed + round_ + 1_000) for name in names})
            for name in names:  # what a new one does once is no part of a step
                now[name].step(samples[0])
        now["y"] = samples[position]

    def action(name: str) -> Callable[[], object]:
        """One step of a version."""
        return lambda: now[name].step(now["y"])

    actions: dict[str, Callable[[], object]] = {name: action(name) for name in names}
    if bare:
        actions |= {"floor": floor(problem), "floor, whole state": floor(problem, whole=True)}
    if weigh:
        actions |= {"floor, weighted": floor(problem, weigh=True)}
    return interleaved(actions, rounds, SLOW, before, warmup=20)


def live_size(rounds: int, seed: int) -> list[dict[str, Any]]:
    """The paper's live size, 1 thread, against everything there is: a row for each version."""
    rows = []
    for sensors in (10, 43):
        names = ["live", "live, batch", "filter", "loop", "numpy"]
        names += ["filterpy"] if find_spec("filterpy") else []
        differences = check(
            make_problem(559, 80, sensors, torch.float64, seed=seed), [n for n in names if n != "live, batch"]
        )
        problem = make_problem(559, 80, sensors, torch.float32, seed=seed)
        with threads(1):
            # The floor finds warm caches only among its like: peers are timed in a group of their own.
            floors = compare(problem, ["live"], 3 * rounds, seed)
            timings = compare(problem, names, rounds, seed, bare=False)
            weighted = compare(problem, ["live, weighted"], rounds, seed, weigh=True)
        over_floor = floors["live"].median / floors["floor"].median
        for name, timing in timings.items():
            ratio = timing.median / (BATCH if name == "live, batch" else 1) / timings["live"].median
            rows.append(_row(name, sensors, floors["live"] if name == "live" else timing, ratio, ratio * over_floor))
            rows[-1]["difference"] = differences.get(name)
        for name in ("live, weighted", "floor, weighted"):
            ratio = weighted[name].median / weighted["floor"].median
            rows.append(_row(name, sensors, weighted[name], ratio / over_floor, ratio))
        for name in ("floor", "floor, whole state"):
            ratio = floors[name].median / floors["live"].median
            rows.append(_row(name, sensors, floors[name], ratio, ratio * over_floor))
    return rows


def _row(name: str, sensors: int, timing: Timing, over_live: float, over_floor: float) -> dict[str, Any]:
    return {
        "version": name,
        "sensors": sensors,
        "microseconds": 1e6 * timing.median / (BATCH if name == "live, batch" else 1),
        "p99_over_median": timing.p99 / timing.median,
        "over_live": over_live,
        "over_floor": over_floor,
        "calls": timing.calls,
    }


def grid(rounds: int, seed: int, quick: bool) -> list[dict[str, Any]]:
    """Live path against its floor over sizes, types and threads."""
    rows = []
    sizes = [(559, 80), (559, 1000)] if quick else [(n, E) for n in (559, 5005) for E in (20, 80, 198, 1000)]
    for n_weights, members in sizes:
        for dtype in (torch.float32, torch.float64):
            problem = make_problem(n_weights, members, 10, dtype, seed=seed)
            for count in (1, 2):
                with threads(count):
                    timings = compare(problem, ["live"], rounds, seed)
                live, bare = timings["live"], timings["floor"]
                rows.append(
                    {
                        "weights": n_weights,
                        "members": members,
                        "dtype": str(dtype).removeprefix("torch."),
                        "threads": count,
                        "microseconds": 1e6 * live.median,
                        "over_floor": live.median / bare.median,
                        "over_whole_floor": live.median / timings["floor, whole state"].median,
                        "p99_over_median": live.p99 / live.median,
                        "floor_p99_over_median": bare.p99 / bare.median,
                    }
                )
    return rows
