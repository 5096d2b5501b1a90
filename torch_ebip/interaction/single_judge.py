"""The fast twin of `InteractionSurprise.judge`: one sequence, no gradients, all that is measured measured whole.

The same numbers up to rounding, in plain numbers: a handful of sensors is too little for tensors, of which every
operation costs as much as a dozen of theirs.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torch_ebip.common.modules import Versions
from torch_ebip.filtering.updates.surprise import Noticed
from torch_ebip.interaction.surprise_memory import (
    ABSURD,
    ALONE,
    BEFORE,
    HERE,
    LEAST_SAY,
    MOST,
    MOST_BIAS,
    ONE_SIDED,
    PER_SENSOR,
    SurpriseMemory,
)

if TYPE_CHECKING:
    from torch_ebip.interaction.surprise import InteractionSurprise

KEPT = 64
"""Sets of DoFs that are measured together for which tables are kept."""


def serves(memory: SurpriseMemory, noticed: Noticed) -> bool:
    """Whether it can be asked: about one sequence on a CPU, all of the sample measured, without gradients."""
    return (
        memory.sensors.ndim == 2
        and noticed.observed is None
        and noticed.y.ndim == 1
        and not torch.is_grad_enabled()
        and memory.sensors.device.type == "cpu"
    )


class SingleJudge:
    """Tables of a surprise that is calibrated, for those DoFs that are measured together.

    Args:
        surprise: whose twin it is, as it is now.
    """

    def __init__(self, surprise: InteractionSurprise) -> None:
        self._alone = math.log(ALONE[0]), math.log(ALONE[1] / ALONE[0])
        self._versions = Versions(surprise)
        self._versions.changed()
        self._surprise, self._stride = surprise, surprise.stride
        self._last = len(surprise.mean) - 1
        self._bounds = surprise.bounds.double().T.tolist()
        self._dofs = surprise.dofs_of_sensor.tolist()
        self._most = [MOST * math.exp(high) for _, high in self._bounds]
        self._scales = surprise.bias_scale.double().T.tolist()
        self._known = surprise.known.tolist()
        self._pace, self._pace_scale = surprise.pace.tolist(), surprise.pace_scale.tolist()
        assert surprise.tail is not None
        self._body = float(surprise.tail.quantiles[0, -1])
        self._tables: dict[int, tuple[Any, ...]] = {}

    def changed(self, surprise: InteractionSurprise) -> bool:
        """Whether it is a twin no more."""
        return surprise is not self._surprise or self._versions.changed()

    def __call__(self, memory: SurpriseMemory, noticed: Noticed) -> tuple[Tensor, Tensor, Tensor | None]:
        """Sensors and together of a `SurpriseMemory` after a sample, and what sensors count [S]; None: all alike."""
        table = self._tables.get(id(noticed.rows))
        if table is None or table[0] is not noticed.rows:
            table = self._made(noticed.rows)
        _, levels, rises, usual, usual_rises, sensor, places, count = table
        moving = noticed.mean.tolist()
        place = min(max(moving[0], 0.0), 1.0) * self._last
        cell = min(int(place), self._last - 1)
        part, S = place - cell, len(count)
        near, far = [0.0] * S, [0.0] * S
        remembered = memory.sensors.tolist()
        values = zip(
            sensor,
            places,
            noticed.y.tolist(),
            noticed.expected.tolist(),
            noticed.variance.tolist(),
            levels[cell],
            rises[cell],
            strict=True,
        )
        stride = self._stride
        usual, usual_rises = usual[cell], usual_rises[cell]
        expected_square = [usual[s] + part * usual_rises[s] for s in range(S)]
        for s, place, y, expected, variance, (mean, spread, noise), (rise, growth) in values:
            off, away = y - expected, y - mean - part * rise  # ** would raise where a product is infinite
            square = off * off / (variance + noise)
            near[s] += square
            remembered[s][place] += (
                math.copysign(min(math.sqrt(square / expected_square[s]), ONE_SIDED), off) * stride
            )
            far[s] += away * away / (spread + part * growth)
        excesses = []
        for s, ours in enumerate(remembered):
            total, samples, level, _, last, lately = ours[:PER_SENSOR]
            if count[s]:
                one, other = expected_square[s], usual[S + s] + part * usual_rises[S + s]
                multiple = min(max(near[s] / one, far[s] / other) / count[s], ABSURD)
                last = math.log(max(multiple, LEAST_SAY))
                total, samples = total + min(multiple, self._most[s]) * stride, samples + stride
                lately += stride
                level = math.log((total + 1) / (samples + 1))
                level = max(level, self._bias(s, ours, lately, usual[2 * S + s] + part * usual_rises[2 * S + s]))
            ours[:PER_SENSOR] = total, samples, level, 1.0, last, lately
            if self._known[s] and samples > HERE:
                first, second = self._bounds[s]
                alone = (last - second - self._alone[0]) / self._alone[1]
                excesses.append((s, (level - first) / (second - first), alone))
        ordered = sorted(excess for _, excess, _ in excesses)
        middle = max(ordered[(len(ordered) - 1) // 2], 0.0) if ordered else 0.0
        say = whole = 0.0
        less = False
        for s, excess, alone in excesses:
            far_off = min(max(excess - middle, alone, 0.0), 1.0)
            counts = 1 - far_off * far_off * (3 - 2 * far_off)
            remembered[s][3] = counts
            less = less or counts < 1
            say += counts + LEAST_SAY
            whole += excess * (counts + LEAST_SAY)
        whole = max(whole / say if say else 0.0, self._at_pace(moving))
        largest, recent = memory.together.tolist()
        like = memory.sensors
        if excesses:
            largest, recent = max(largest, whole), max(recent, whole - self._body)
        sensors = torch.tensor(remembered, dtype=like.dtype)
        return sensors, torch.tensor([largest, recent], dtype=like.dtype), sensors[:, 3] if less else None

    def _at_pace(self, moving: list[float]) -> float:
        """How surprising the pace is of what moves, on the scale of the sensors together."""
        offset, scale = self._pace_scale
        if len(moving) < 2 or scale == 0:
            return float(offset)
        away = (moving[1] - self._pace[0]) / self._pace[1]
        return float(offset + scale * math.log1p(min(away * away, ABSURD)))

    def _bias(self, sensor: int, ours: list[float], lately: float, usual: float) -> float:
        """The level that a bias is, of the sums of a sensor; they are made smaller where it would be too large."""
        offset, scale = self._scales[sensor]
        assert isinstance(offset, float)
        if scale == 0:
            return offset
        total = 0.0
        for value in ours[PER_SENSOR:]:
            total += value * value
        mean = total / ((lately + BEFORE) ** 2 * self._dofs[sensor])
        level: float = offset + scale * math.log(max(mean / usual, LEAST_SAY))
        beyond: float = level - self._bounds[sensor][1] - math.log(MOST_BIAS)
        if beyond <= 0:
            return level
        less = math.exp(-0.5 * beyond / max(scale, 1e-6))
        ours[PER_SENSOR:] = [value * less for value in ours[PER_SENSOR:]]
        return level - beyond

    def _made(self, rows: Tensor | None) -> tuple[Any, ...]:
        """Tables of DoFs int64 [K], as plain numbers.

        For each cell between phases mean, spread and noise of each DoF and how they rise; what is usual [3 S] and
        how it rises, that of biases [S] behind it; the sensor of each DoF, its place among what is kept of that, and
        how many DoFs each sensor has. The rows are kept, so that no others get their identity.
        """
        ours = self._surprise
        chosen = torch.arange(len(ours.noise)) if rows is None else rows
        noise, sensors = ours.noise[chosen].double(), ours.sensor_of_dof[chosen]
        places = PER_SENSOR + ours.place_of_dof[chosen]
        mean, spread = ours.mean[:, chosen].double(), ours.variance[:, chosen].double() + noise
        usual = torch.cat([ours.usual.flatten(1), ours.usual_bias], -1).double()
        levels = torch.stack([mean, spread, noise.expand_as(mean)], -1)
        rises = torch.stack([mean, spread], -1).diff(dim=0)
        count = torch.bincount(sensors, minlength=ours.n_sensors)
        if len(self._tables) >= KEPT:
            self._tables.clear()
        made = (rows, *(part.tolist() for part in (levels, rises, usual, usual.diff(dim=0), sensors, places, count)))
        self._tables[id(rows)] = made
        return made
