"""How the time of a step grows with the sizes, and that it does not grow with what no sensor sees."""

from __future__ import annotations

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
        versions: dict[int, Live] = {}
        samples = {}
        for size in sizes:
            now = {**BASE, name: size}
            problem = make_problem(now["weights"], now["members"], now["sensors"], torch.float32, seed=seed)
            generator = torch.Generator().manual_seed(seed)
            versions[size] = Live(problem, generator, now["batch"])
            samples[size] = problem.y[:, problem.sensors]
        position = {"t": 0}

        def before(round_: int, position: dict[str, int] = position) -> None:
            """Next sample."""
            position["t"] = round_ % 80

        with threads(1):
            timings = interleaved(
                {size: (lambda v=versions[size], y=samples[size], p=position: v.step(y[p["t"]])) for size in sizes},
                rounds,
                before=before,
                warmup=20,
            )
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
