"""The fast twin of `InteractionSurprise.judge`: one sequence, no gradients, all that is measured measured whole.

The same numbers up to rounding, in plain numbers: a handful of sensors is too little for tensors, of which every
operation costs as much as a dozen of theirs.
"""

from __future__ import annotations

import math
from array import array
from itertools import chain
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
    ONE_SIDED,
    PER_SENSOR,
    SurpriseMemory,
)

if TYPE_CHECKING:
    from torch_ebip.interaction.surprise import InteractionSurprise

CODES = {torch.float32: "f", torch.float64: "d"}
"""Of types, as `array` names them."""
KEPT = 64
"""Sets of DoFs that are measured together for which tables are kept."""


def serves(memory: SurpriseMemory, noticed: Noticed) -> bool:
    """Whether it can be asked: about one sequence on a CPU, all of the sample measured, without gradients."""
    return (
        noticed.observed is None
        and noticed.y.dim() == 1
        and memory.kept.dim() == 2
        and noticed.y.is_cpu
        and not torch.is_grad_enabled()
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
        scales = torch.cat([surprise.bias_scale, surprise.most_bias.unsqueeze(0)])
        self._scales: list[list[float]] = scales.double().T.tolist()
        self._few, self._least = surprise.alone_scale.tolist(), 1 / max(int(surprise.known.sum()), 2)
        self._known = surprise.known.tolist()
        self._pace, self._pace_scale = surprise.pace.tolist(), surprise.pace_scale.tolist()
        assert surprise.tail is not None
        self._body = float(surprise.tail.quantiles[0, -1])
        self._tables: dict[int, tuple[Any, ...]] = {}

    def changed(self, surprise: InteractionSurprise) -> bool:
        """Whether it is a twin no more."""
        return surprise is not self._surprise or self._versions.changed()

    def __call__(self, memory: SurpriseMemory, noticed: Noticed) -> tuple[Tensor, Tensor | None]:
        """What is kept after a sample, see `SurpriseMemory`, and what sensors count [S]; None: all alike."""
        table = self._tables.get(id(noticed.rows))
        if table is None or table[0] is not noticed.rows:
            table = self._made(noticed.rows)
        _, cells, usual, usual_rises, count, asked = table
        moving = noticed.mean.tolist()
        place = min(max(moving[0], 0.0), 1.0) * self._last
        cell = min(int(place), self._last - 1)
        part, S, stride = place - cell, len(count), self._stride
        usual = [low + part * rise for low, rise in zip(usual[cell], usual_rises[cell], strict=True)]
        near, far = [0.0] * S, [0.0] * S
        kept = memory.kept.tolist()
        said = zip(noticed.y.tolist(), noticed.expected.tolist(), noticed.variance.tolist(), cells[cell], strict=True)
        for y, expected, variance, (s, at, mean, rise, spread, growth, noise) in said:
            off, away = (y - expected) / math.sqrt((variance + noise) * usual[s]), y - mean - part * rise
            near[s] += off * off  # ** would raise where a product is infinite
            far[s] += away * away / (spread + part * growth)
            kept[s][at] += (off if -ONE_SIDED < off < ONE_SIDED else math.copysign(ONE_SIDED, off)) * stride
        excesses, known = [], self._known
        for s in asked:
            ours = kept[s]
            if count[s]:
                multiple = min(max(near[s], far[s] / usual[S + s]) / count[s], ABSURD)
                ours[0] += min(multiple, self._most[s]) * stride
                ours[1] += stride
                ours[4] = math.log(max(multiple, LEAST_SAY))
                ours[5] += stride
                ours[2] = max(math.log((ours[0] + 1) / (ours[1] + 1)), self._bias(s, ours, usual[2 * S + s]))
            if known[s] and ours[1] > HERE:
                first, second = self._bounds[s]
                alone = (ours[4] - second - self._alone[0]) / self._alone[1]
                excesses.append((s, (ours[2] - first) / (second - first), alone))
        if excesses:
            ordered = sorted(excess for _, excess, _ in excesses)
            middle = max(ordered[len(ordered) // 2 if len(ordered) > 2 else 0], 0.0)
            say = whole = squares = 0.0
            for s, excess, alone in excesses:
                far_off = min(max(excess - middle, alone, 0.0), 1.0)
                kept[s][3] = counts = 1 - far_off * far_off * (3 - 2 * far_off)
                weight = counts + LEAST_SAY
                say += weight
                squares += weight * weight
                whole += excess * weight
            whole /= say
            few = min(max((squares / (say * say) - self._least) / (1 - self._least), 0.0), 1.0)
            whole, together = max(whole, self._at_pace(moving)), kept[S]
            whole += few * (self._few[0] + self._few[1] * whole)
            together[:2] = max(together[0], whole), max(together[1], whole - self._body)
        made = self._tensor(kept, memory.kept)
        return made, made[:-1, 3] if min(row[3] for row in kept[:-1]) < 1 else None

    @staticmethod
    def _tensor(rows: list[list[float]], like: Tensor) -> Tensor:
        """As torch.tensor makes it, in half of the time."""
        code = CODES.get(like.dtype)
        if code is None:
            return torch.tensor(rows, dtype=like.dtype, device="cpu")
        return torch.frombuffer(array(code, chain.from_iterable(rows)), dtype=like.dtype).view_as(like)

    def _at_pace(self, moving: list[float]) -> float:
        """How surprising the pace is of what moves, on the scale of the sensors together."""
        offset, scale = self._pace_scale
        if len(moving) < 2 or scale == 0:
            return float(offset)
        away = (moving[1] - self._pace[0]) / self._pace[1]
        return float(offset + scale * math.log1p(min(away * away, ABSURD)))

    def _bias(self, sensor: int, ours: list[float], usual: float) -> float:
        """The level that a bias is, of what is kept of a sensor; sums become smaller where it would be too large."""
        offset, scale, most = self._scales[sensor]
        if scale == 0:
            return offset
        total = 0.0
        for value in ours[PER_SENSOR:]:
            total += value * value
        mean = total / ((ours[5] + BEFORE) ** 2 * self._dofs[sensor])
        level = offset + scale * math.log(max(mean / usual, LEAST_SAY))
        if level <= most:
            return level
        less = math.exp(-0.5 * (level - most) / max(scale, 1e-6))
        ours[PER_SENSOR:] = [value * less for value in ours[PER_SENSOR:]]
        return most

    def _made(self, rows: Tensor | None) -> tuple[Any, ...]:
        """Tables of DoFs int64 [K], as plain numbers.

        For each cell between phases, of each DoF: its sensor, its place among what is kept of that, mean and how it
        rises, spread with noise and how it grows, noise; what is usual [3 S], of both squares and of biases, and how
        it rises; how many DoFs each sensor has, and which of them are here or have a say. The rows are kept, so that
        no others get their identity.
        """
        ours = self._surprise
        chosen = torch.arange(len(ours.noise), device="cpu") if rows is None else rows
        noise, sensors = ours.noise[chosen].double(), ours.sensor_of_dof[chosen]
        places = PER_SENSOR + ours.place_of_dof[chosen]
        mean, spread = ours.mean[:, chosen].double(), ours.variance[:, chosen].double() + noise
        usual = torch.cat([ours.usual.flatten(1), ours.usual_bias], -1).double()
        each = [mean[:-1], mean.diff(dim=0), spread[:-1], spread.diff(dim=0), noise.expand_as(mean[:-1])]
        who = list(zip(sensors.tolist(), places.tolist(), strict=True))
        cells = [
            [(*one, *numbers) for one, numbers in zip(who, row, strict=True)]
            for row in torch.stack(each, -1).tolist()
        ]
        count = torch.bincount(sensors, minlength=ours.n_sensors)
        asked = [s for s in range(ours.n_sensors) if self._known[s] or count[s]]
        if len(self._tables) >= KEPT:
            self._tables.clear()
        made = (rows, cells, usual.tolist(), usual.diff(dim=0).tolist(), count.tolist(), asked)
        self._tables[id(rows)] = made
        return made
