"""The lies as a session hears them, sample by sample: how far its forecasts leave what was demonstrated."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import torch
from rich.table import Table
from torch import Tensor

from torch_ebip import Demonstrations, InteractionModel, InteractionSession, SessionSettings, ebip
from torch_ebip.interaction.bounds import demonstrated_range

NOISE = 100.0
"""R of the filter that is made by hand, as a multiple of the closed form."""
EVERY = 5
"""Samples between forecasts."""
HORIZON = 0.3
"""s, how far ahead they are."""
TWICE = "a second interaction"
"""In the same session, right after the first."""


class Heard(NamedTuple):
    """What some sessions said of one kind of lies.

    Attributes:
        mean: rad or the unit of the targets, the forecast that was furthest outside what was demonstrated.
        deviation: its own.
        outside: how far that is outside, as a share of the demonstrated width; 0: never was it outside.
        familiarity: the lowest, a median over sessions; NaN where nobody knows.
        states: of each sensor the worst that it was in most sessions.
    """

    mean: float
    deviation: float
    outside: float
    familiarity: float
    states: dict[str, str]


def by_hand(model: InteractionModel, settings: SessionSettings) -> InteractionSession:
    """A session of a filter that was neither tuned nor calibrated: R x `NOISE`, square root, evidence weights."""
    primitive = model.primitive
    filter = ebip(primitive, residual_variance=NOISE * primitive.residual_variance, square_root=True, weigh=True)
    return InteractionSession(filter, primitive, settings=settings)


def heard(
    model: InteractionModel, known: Demonstrations, said: Mapping[str, Demonstrations], seed: int
) -> dict[str, dict[str, Heard]]:
    """What sessions of both filters, ``ebip by hand`` and ``learned``, say of each kind of what sensors say.

    Args:
        model: that was learned.
        known: familiar interactions; also played twice in one session.
        said: of each kind some interactions.
        seed: of the sessions' draws.
    """
    twice = Demonstrations(known.layout, [torch.cat([path, path]) for path in known], known.rate)
    kinds = {"familiar": known, **said, TWICE: twice}

    def learned(its: InteractionModel, settings: SessionSettings) -> InteractionSession:
        """Of what was learned."""
        return InteractionSession(its.filter, its.primitive, settings=settings)

    return {
        name: {kind: _heard(model, make, them, seed) for kind, them in kinds.items()}
        for name, make in (("ebip by hand", by_hand), ("learned", learned))
    }


def _heard(
    model: InteractionModel,
    make: Callable[[InteractionModel, SessionSettings], InteractionSession],
    them: Demonstrations,
    seed: int,
) -> Heard:
    """Of one kind."""
    low, high = (part[model.layout.controlled] for part in demonstrated_range(model.primitive))
    furthest, familiarity = (-math.inf, math.nan, math.nan), []
    worst: list[dict[str, str]] = []
    order = ("ok", "suspect", "rejected")
    for number, path in enumerate(them):
        with make(model, SessionSettings(seed=seed + number)) as session:
            lowest, states = math.nan, dict.fromkeys(session.sensors, "ok")
            for mean, deviation, known, now in _forecasts(session, path, model):
                outside = torch.maximum(low - mean, mean - high) / (high - low).clamp(min=1e-9)
                dof = int(outside.argmax())
                furthest = max(furthest, (float(outside[dof]), float(mean[dof]), float(deviation[dof])))
                lowest = known if math.isnan(lowest) else min(lowest, known)
                states = {name: max(states[name], now[name], key=order.index) for name in states}
        familiarity.append(lowest)
        worst.append(states)
    usual = {name: sorted((w[name] for w in worst), key=order.index)[len(worst) // 2] for name in worst[0]}
    median = sorted(familiarity)[len(familiarity) // 2]
    return Heard(furthest[1], furthest[2], max(furthest[0], 0.0), median, usual)


def _forecasts(
    session: InteractionSession, path: Tensor, model: InteractionModel
) -> Iterator[tuple[Tensor, Tensor, float, dict[str, str]]]:
    """Means and deviations of the targets, familiarity and states, every few samples of a path [T, D]."""
    layout = model.layout
    for step, row in enumerate(path.tolist()):
        for name in session.sensors:
            part = layout.slice(name)
            session.push(name, row[part.start : part.stop], step / model.rate)
        if step % EVERY == EVERY - 1:
            said = session.forecast(horizon=HORIZON)
            yield said.mean, said.deviation, said.familiarity, dict(said.states)


def table_of(found: Mapping[str, Mapping[str, Heard]], unit: str) -> Table:
    """What was heard, as a table: kinds down, filters across."""
    table = Table(title=f"sessions: forecast furthest outside what was demonstrated (own deviation) {unit}, share of"
                  " its width; familiarity; sensors that are not ok", title_justify="left")  # fmt: skip
    table.add_column("what sensors say")
    for name in found:
        table.add_column(name)
    for kind in next(iter(found.values())):
        table.add_row(kind, *(_cell(rows[kind]) for rows in found.values()))
    return table


def _cell(row: Heard) -> str:
    """One line of text."""
    bad = ", ".join(f"{name} {state}" for name, state in row.states.items() if state != "ok")
    familiar = "-" if math.isnan(row.familiarity) else f"{row.familiarity:.3f}"
    return f"{row.mean:.2f} ({row.deviation:.2f}), {row.outside:.0%}; {familiar}{'; ' if bad else ''}{bad}"


def as_plain(found: Mapping[str, Mapping[str, Heard]]) -> dict[str, Any]:
    """The same for a file."""
    return {name: {kind: row._asdict() for kind, row in rows.items()} for name, rows in found.items()}
