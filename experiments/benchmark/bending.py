"""What a forecast with analogues, and with an expert too, costs, beside one without and an update, live."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from experiments.surprise.reaches import reaches
from experiments.timing import interleaved, threads
from torch_ebip import AnalogueReadout, Analogues, InteractionPrimitive, LiveFilter, ebip
from torch_ebip.interaction.expert import SLOWER, Expert
from torch_ebip.interaction.horizons import LEVELS, SECONDS
from torch_ebip.interaction.present import recent_of


def bending(rounds: int, seed: int, quick: bool) -> list[dict[str, Any]]:
    """Three sensors, 8 DoFs, one thread, half-way through an interaction: a row each for one horizon and for five.

    Args:
        rounds: calls that count.
        seed: of data and draws.
        quick: 40 members, not 200.
    """
    count = 40 if quick else 200
    primitive = InteractionPrimitive.fit(reaches(count, 10 * seed + 1))
    path, observed = reaches(1, 10 * seed + 2)[0].nan_to_num(), ~primitive.layout.controlled
    lives = {name: _live(primitive, name, observed, path, seed) for name in ("heard", "bends", "straight")}
    sample = path[len(path) // 2]
    rows = []
    for horizons in ((0.3,), SECONDS):
        asked: dict[str, Callable[[], object]] = {
            name: lambda live=live, horizons=horizons: live.forecast(dofs=~observed, ahead=list(horizons))
            for name, live in lives.items()
        }
        asked["update"] = lambda: lives["bends"].update(sample, observed)
        asked["update_heard"] = lambda: lives["heard"].update(sample, observed)
        with threads(1):
            timings = interleaved(asked, rounds, warmup=20)
        microseconds = {key: 1e6 * timing.median for key, timing in timings.items()}
        row = {"horizons": len(horizons), **microseconds, "members": count}
        ratios = {f"{name}_over_update": microseconds[name] / microseconds["update"] for name in ("bends", "heard")}
        rows.append(row | ratios)
    return rows


def _live(primitive: InteractionPrimitive, name: str, observed: torch.Tensor, path: torch.Tensor, seed: int) -> Any:
    """A filter that has seen half of a path; its numbers do not matter."""
    filter = ebip(primitive, weigh=True, square_root=True)
    if name != "straight":
        D, K = primitive.layout.n_dofs, len(SECONDS)
        half = 0.5 * torch.eye(D).repeat(K, 1, 1)
        follow, width = half.repeat(1, 1, len(LEVELS)), torch.ones(K, D, 3) / 3
        filter.analysis.recent = recent_of(primitive, slower=SLOWER if name == "heard" else ())
        expert = Expert.of(primitive, observed, ~observed) if name == "heard" else None
        heed = None if expert is None else torch.full((K, D, len(LEVELS)), 0.3)
        analogues = Analogues.of(primitive)
        filter.readout = AnalogueReadout(
            analogues, follow, 0.1 * half, width, levels=LEVELS, expert=expert, heed=heed
        )
    live = LiveFilter(filter, observed, generator=torch.Generator().manual_seed(seed))
    for step, sample in enumerate(path[: len(path) // 2]):
        if step:
            live.predict()
        live.update(sample, observed)
    return live
