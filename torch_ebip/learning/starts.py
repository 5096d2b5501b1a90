"""Where the gradient starts: a factor on the closed-form R, how sharply the evidence weighs, how far back it looks.

Both are searched for on interactions that are left out. One factor is what a sceptic does instead of gradients.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.files import read_json, write_json
from torch_ebip.filtering.noise.constraints import AboveOne
from torch_ebip.filtering.updates.trust import RobustWeights
from torch_ebip.interaction.basis.bspline import BSplineBasis
from torch_ebip.interaction.basis.periodic import PeriodicBSplineBasis
from torch_ebip.interaction.filter_kinds import InteractionEnsembleFilter
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.presets import ebip
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.learning.course import bank_of
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.remaining import remaining_error

FACTORS = (1.0, 10.0, 100.0, 1000.0, 10000.0)
"""Coarse grid of factors on the closed-form R; the best one is refined by half-decades."""
SHARPNESSES = (1.0, 3.16, 10.0, 31.6, 100.0)
"""Of the evidence weights. With more of it one or two members speak for all."""
FORGETTING = (6.0, 0.01)
"""Rates of the memories, 1/s: a sixth of a second, and the whole interaction."""
MEMORIES = ((0.95, 0.0), (0.5, 0.0), (0.05, 0.0), (0.05, 4.0), (0.05, 8.0))
"""Shares of the fast memory in the sharpness, and the primacy of the slow one: how much more it holds of what came
first. From none of the past to its beginning."""
FIRST = (1, 3)
"""Which of them are tried first."""
SLOPES = (-2.0, 0.0, 2.0)
"""How much more the evidence counts late than early."""
TRIES = 28
"""Starts that are tried, at most."""
INFLATION = 1.002
"""Of the anomalies a sample, where the gradient starts."""


class Start(NamedTuple):
    """Where the gradient starts: a factor on R, the sharpness of the evidence weights, and the memories.

    ``balance`` is the fast memory's share of the sharpness, None if it is alone; ``primacy`` is the slow one's,
    ``slope`` that of both.
    """

    factor: float
    sharpness: float
    balance: float | None = None
    primacy: float = 0.0
    slope: float = 2.0


def scaled(primitive: InteractionPrimitive, factor: float, members: int | None = None) -> InteractionEnsembleFilter:
    """The paper's eBIP of a primitive with its R times one factor, and an ensemble of so many members."""
    return ebip(primitive, members, residual_variance=factor * primitive.residual_variance)


def tunable(
    primitive: InteractionPrimitive, start: Start, members: int | None = None, robust: RobustWeights | None = None
) -> InteractionEnsembleFilter:
    """What is tuned: square-root eBIP whose R depends on phase, with inflation and evidence weights.

    Args:
        primitive: of the demonstrations.
        start: where the gradient starts.
        members: E; default: all demonstrations.
        robust: what surprising measurements count; default: as much as others.
    """
    sharpness: list[float] | float = start.sharpness
    if start.balance is not None:
        sharpness = [start.balance * start.sharpness, (1 - start.balance) * start.sharpness]
    return ebip(
        primitive,
        members,
        residual_variance=start.factor * primitive.residual_variance,
        context=PeriodicBSplineBasis(4) if primitive.periodic else BSplineBasis(4),
        robust=robust,
        inflation=AboveOne(primitive.weights.new_tensor(INFLATION)),
        square_root=True,
        weigh=True,
        sharpness=sharpness,
        forgetting=FORGETTING[0] if start.balance is None else FORGETTING,
        primacy=0.0 if start.balance is None else (0.0, start.primacy),
        slope=start.slope,
        relative=1.0,
        pace=bank_of(primitive),
    )


def scanned(held_out: HeldOut, count: int) -> Tensor:
    """int64 [M], at most ``count`` of the demonstrations: those that decide where to start."""
    generator = torch.Generator("cpu").manual_seed(held_out.settings.seed + 1)
    return torch.randperm(len(held_out.task.primitive), generator=generator, device="cpu")[:count]


def best_factor(
    held_out: HeldOut,
    build: Callable[[InteractionPrimitive, float], InteractionFilter],
    interactions: int,
    factors: Sequence[float] = FACTORS,
    record: Path | None = None,
    tick: Callable[[], None] = lambda: None,
) -> float:
    """The factor on R with the smallest loss on interactions left out.

    Args:
        held_out: the demonstrations, and what is asked of them.
        build: a filter from a primitive and a factor.
        interactions: how many of them decide.
        factors: grid; half-decades around its best one are tried too.
        record: file of the losses, written when all are known; if it exists, its best factor is returned.
        tick: called after each filter that was tried.

    Raises:
        ValueError: a record that is none.
    """
    if record is not None and record.exists():
        content = read_json(record)
        try:
            stored = {float(factor): _loss(loss) for factor, loss in content.items()}
            return min(stored, key=lambda factor: stored[factor])
        except (AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"{record}: expected a loss for every factor: {error}") from error
    losses: dict[float, float] = {}
    order = scanned(held_out, interactions)

    def measure(factors: Sequence[float]) -> None:
        """Losses of those that are not known yet."""
        for factor in factors:
            if factor not in losses:
                losses[factor] = _loss(held_out.evaluate(build(held_out.task.primitive, factor), order)["loss"])
            tick()

    measure(factors)
    best = min(losses, key=lambda factor: losses[factor])
    measure([float(f"{best * 10**half:.4g}") for half in (-0.5, 0.5)])
    if record is not None and held_out.ranks.first:
        write_json(record, losses)
    return min(losses, key=lambda factor: losses[factor])


def best_start(
    held_out: HeldOut,
    factor: float,
    interactions: int,
    members: int | None = None,
    record: Path | None = None,
    tick: Callable[[], None] = lambda: None,
    memories: int = 2,
) -> Start:
    """The start of `tunable` with the least `remaining_error`: of a few, and from there downhill, an axis at a time.

    Args:
        held_out: the demonstrations, and what is asked of them.
        factor: the best one without evidence weights, which take over a part of what a large R is for.
        interactions: how many of them decide.
        members: E of the filter.
        record: file of what remains, written when all are known; if it exists, its best start is returned.
        tick: called `TRIES` times, after each filter that was tried.
        memories: 2, a fast and a slow one; or 1.

    Raises:
        ValueError: a record that is none.
    """
    if record is None or not record.exists():
        order = scanned(held_out, interactions)
        kept: Sequence[tuple[float | None, float]] = MEMORIES if memories == 2 else [(None, 0.0)]
        scales = [float(f"{factor * 10 ** (half / 2):.4g}") for half in range(-4, 3)]
        axes = (scales, SHARPNESSES, kept, SLOPES)
        left_of: dict[tuple[int, ...], float] = {}

        def start_at(place: tuple[int, ...]) -> Start:
            """Of a number on each axis."""
            return Start(scales[place[0]], SHARPNESSES[place[1]], *kept[place[2]], SLOPES[place[3]])

        def measure(place: tuple[int, ...]) -> float:
            """What remains with a filter that starts there; when enough were tried, no other is."""
            inside = all(0 <= i < len(axis) for i, axis in zip(place, axes, strict=True))
            if inside and place not in left_of and len(left_of) < TRIES:
                filter = tunable(held_out.task.primitive, start_at(place), members)
                left_of[place] = _loss(remaining_error(held_out, filter, order))
                tick()
            return left_of.get(place, math.inf)

        _descend(measure, list(product((2, 4, 6), (2, 4), FIRST if memories == 2 else (0,), (2,))))
        for _ in range(TRIES - len(left_of)):
            tick()
        known = [{**start_at(place)._asdict(), "remaining": left} for place, left in left_of.items()]
        if record is not None and held_out.ranks.first:
            write_json(record, known)
    else:
        known = read_json(record)
    try:
        best = min(known, key=lambda entry: _loss(entry["remaining"]))
        return Start(best["factor"], best["sharpness"], best["balance"], best["primacy"], best["slope"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{record}: expected a list of starts with what remains of the error: {error}") from error


def _descend(measure: Callable[[tuple[int, ...]], float], first: Sequence[tuple[int, ...]]) -> None:
    """Walk a grid downhill from the best of the ``first`` places, an axis at a time, until none leads on."""
    at = min(first, key=measure)
    while True:
        before = at
        for axis, way in product(range(len(at)), (1, -1)):
            while True:
                there = (*at[:axis], at[axis] + way, *at[axis + 1 :])
                if measure(there) >= measure(at):
                    break
                at = there
        if at == before:
            return


def _loss(loss: float | None) -> float:
    """A loss that can be compared: one that is no number, in a file null, is the worst."""
    return math.inf if loss is None or math.isnan(loss) else loss
