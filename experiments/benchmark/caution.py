"""What surprise costs: a live step and a session's cycle of a filter that was learned, with and without it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from experiments.surprise.reaches import reaches
from experiments.surprise.sure import sure
from experiments.timing import interleaved, threads
from torch_ebip import InteractionModel, InteractionSession, LiveFilter, learn


def caution(rounds: int, seed: int, quick: bool) -> list[dict[str, Any]]:
    """Three sensors, 8 DoFs, one thread, each step along one interaction: a row each for a step and a cycle.

    Args:
        rounds: calls that count.
        seed: of data and draws.
        quick: learn from 40 interactions, not from 120.
    """
    model = learn(reaches(40 if quick else 120, 10 * seed + 1), steps=0, scan=8 if quick else 48, seed=seed)
    models = {"with": model, "without": sure(model)}
    rows = []
    for name, action in (("live step", _step), ("push and forecast", _cycle)):
        with threads(1):
            timings = interleaved({key: action(its, seed) for key, its in models.items()}, rounds, warmup=50)
        microseconds = {key: 1e6 * timing.median for key, timing in timings.items()}
        ratio = microseconds["with"] / microseconds["without"]
        rows.append({"what": name, **microseconds, "with_over_without": ratio, "members": len(model.primitive)})
    return rows


def _step(model: InteractionModel, seed: int) -> Callable[[], object]:
    """Predict and update of `LiveFilter`, with all sensors."""
    path = reaches(1, 10 * seed + 2)[0]
    path[:, model.layout.controlled] = torch.nan
    samples, observed = path.nan_to_num().unbind(0), ~model.layout.controlled
    state: dict[str, Any] = {"step": 0}

    def step() -> object:
        """The next sample; the interaction begins again at its end."""
        at = state["step"] % len(samples)
        if at == 0:
            state["live"] = LiveFilter(model.filter, observed, generator=torch.Generator().manual_seed(seed))
        state["step"] += 1
        live = state["live"]
        live.predict()
        return live.update(samples[at], observed)

    return step


def _cycle(model: InteractionModel, seed: int) -> Callable[[], object]:
    """Three pushes and a forecast of a session."""
    path = reaches(1, 10 * seed + 2)[0]
    parts = {name: model.layout.slice(name) for name in model.sensors}
    samples = [{name: row[part].tolist() for name, part in parts.items()} for row in path]
    state: dict[str, Any] = {"step": 0}

    def cycle() -> object:
        """The next sample of each sensor; a new session at the interaction's end."""
        at = state["step"] % len(samples)
        if at == 0:
            state["session"] = InteractionSession(model.filter, model.primitive)
        state["step"] += 1
        session = state["session"]
        for name, values in samples[at].items():
            session.push(name, values, at / model.rate)
        return session.forecast(horizon=0.3)

    return cycle
