"""How the time of a step grows with the sizes, and that it does not grow with what no sensor sees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from experiments.benchmark.problem import make_problem
from experiments.benchmark.versions import Live
from experiments.timing import interleaved, threads

SIZES = {
    "weights": (559, 1118, 2496, 5005),
    "members": (40, 80, 160, 320, 640),
    "sensors": (5, 10, 20, 43),
    "batch": (1, 4, 16, 64),
}
BASE = {"weights": 559, "members": 80, "sensors": 10, "batch": 0}


def growth(rounds: int, seed: int) -> list[dict[str, Any]]:
    """Times of the live path for each size, one of them varied at a time; and the exponents fitted to them.

    The exponent is the slope of a straight line through the logarithms of all sizes: 0 for a time that does not
    depend on the size, 1 for one proportional to it. At small sizes the overhead of calls hides the arithmetic.
    """
    found = []
    for name, sizes in SIZES.items():
        problems: dict[int, Any] = {}
        for size in sizes:
            now = {**BASE, name: size}
            problem = make_problem(now["weights"], now["members"], now["sensors"], torch.float32, seed=seed)
            problems[size] = problem, now["batch"], problem.y[:, problem.sensors]
        state: dict[str, Any] = {"t": 0}

        def before(round_: int, state: dict[str, Any] = state, problems: Any = problems) -> None:
            """Next sample; a new interaction after the last."""
            state["t"] = round_ % 80
            if state["t"] == 0 or "versions" not in state:
                state["versions"] = {
                    size: Live(problem, torch.Generator().manual_seed(seed), batch)
                    for size, (problem, batch, _) in problems.items()
                }
                for size, (_, _, y) in problems.items():
                    state["versions"][size].step(y[0])

        def action(size: int, state: dict[str, Any] = state, problems: Any = problems) -> Callable[[], object]:
            """One step."""
            return lambda: state["versions"][size].step(problems[size][2][state["t"]])

        with threads(1):
            timings = interleaved({size: action(size) for size in sizes}, rounds, before=before, warmup=20)
        times = [timings[size].median for size in sizes]
        slope = float(np.polyfit(np.log(sizes), np.log(times), 1)[0])
        found.append(
            {
                "varied": name,
                "sizes": list(sizes),
                "microseconds": [1e6 * t for t in times],
                "exponent": slope,
                "last_over_first": times[-1] / times[0],
            }
        )
    return found
