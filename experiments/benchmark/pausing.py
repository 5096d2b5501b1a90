"""What a bank of phase hypotheses costs: live steps of an interaction with and without it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from experiments.ball_catching.dataset import load_or_generate
from experiments.surprise.reaches import reaches
from experiments.timing import interleaved, threads
from torch_ebip import InteractionFilter, InteractionPrimitive, LiveFilter, PhaseBank, ebip, learn
from torch_ebip.common.modules import sharing

MEMBERS = 80
SAMPLES = 60
"""Of an interaction, along which each round steps: the bank takes a step every third of them."""


def pausing(rounds: int, seed: int, quick: bool) -> list[dict[str, Any]]:
    """E = 80, one thread: a row for each kind of filter, the last as `learn` makes it.

    Eight sensors of the simulated ball catching at 60 Hz; for what is learned, three sensors of made-up reaches.

    Args:
        rounds: that count.
        seed: of recordings and draws.
        quick: learn from fewer recordings.
    """
    known = load_or_generate(MEMBERS + 1, seed)
    primitive = InteractionPrimitive.fit(known.subset(range(MEMBERS)))
    options: Mapping[str, dict[str, Any]] = {
        "ensemble filter, 8 sensors": {"square_root": True},
        "weighted by evidence, 8 sensors": {"square_root": True, "weigh": True, "inflation": 1.002},
    }
    rows = [
        _row(name, ebip(primitive, **chosen), primitive, known[MEMBERS], rounds) for name, chosen in options.items()
    ]
    reached = reaches((40 if quick else MEMBERS) + 1, seed)
    model = learn(reached.subset(range(len(reached) - 1)), steps=0, scan=8 if quick else 24, seed=seed, shrink=False)
    return [*rows, _row("learned, 3 sensors", model.filter, model.primitive, reached[len(reached) - 1], rounds)]


def _row(
    name: str, filter: InteractionFilter, primitive: InteractionPrimitive, path: Tensor, rounds: int
) -> dict[str, Any]:
    """Microseconds a step along a recording [T, D]."""
    shown = ~primitive.layout.controlled
    path = torch.where(shown, path, torch.nan)[:SAMPLES]
    actions = {}
    for key, bank in (("with", PhaseBank.of(primitive)), ("without", None)):
        paced = sharing(filter)
        paced.analysis = sharing(filter.analysis)
        paced.analysis.pace = bank
        actions[key] = _steps(LiveFilter(paced, shown), path)
    with threads(1):
        timings = interleaved(actions, max(rounds // 30, 3), warmup=2)
    microseconds = {key: 1e6 * timing.median / len(path) for key, timing in timings.items()}
    ratio = microseconds["with"] / microseconds["without"]
    return {"what": name, **microseconds, "with_over_without": ratio, "members": len(primitive)}


def _steps(live: LiveFilter, path: Tensor) -> Callable[[], object]:
    """Predict and update along a recording [T, D]."""
    start = live.save()

    def steps() -> object:
        """From its beginning."""
        live.load(start)
        for t, row in enumerate(path):
            if t:
                live.predict()
            live.update(row)
        return live.phase

    return steps
