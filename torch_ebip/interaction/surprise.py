"""Surprise of an interaction: each sensor against what the demonstrations themselves give when left out.

What a model misfits is usual, so thresholds come from interactions left out (see `torch_ebip.learning.surprising`)
and from no table of chi-square. What is asked of samples is in `torch_ebip.interaction.sensor_levels`.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.surprise import Noticed
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.sensor_levels import SensorLevels
from torch_ebip.interaction.single_judge import SingleJudge, serves
from torch_ebip.interaction.surprise_memory import ABSURD, ALONE, HERE, LEAST_SAY, SurpriseMemory
from torch_ebip.interaction.tail import BODY, FEWEST, Tail, as_chances, on_one_scale
from torch_ebip.recordings.layout import Layout

POINTS = 41
"""Phases of the grid."""
LEAST_SPREAD = 0.02
"""Of the pace, as a share of its mean: recordings cut to one length say nothing of people."""


class InteractionSurprise(SensorLevels):
    """Judges sensors, the modalities of a layout, and the interaction as a whole, by their levels.

    A sensor is suspect above the level that demonstrations left out exceed with the chance ``suspect`` in a whole
    interaction, and rejected above that of ``rejected``; between them it counts less and less. What most sensors are
    surprised by is no fault of one: the excess of the middle one is taken off. A sample beyond `ALONE` always is.

    The whole is as surprising as its sensors are in the mean, each as far as it counts; or as its pace, where that is
    more: the velocity of the phase, in deviations from that of demonstrations.

    Args:
        mean: [P, D], of the demonstrations at phases evenly from 0 to 1, units of the DoFs.
        variance: [P, D], the same of their variance, squared units.
        noise: [D], R, squared units.
        sensor_of_dof: int64 [D].
        pace: [2], mean and deviation of the demonstrations' phase velocity, 1/s.
        window: s, over which levels are means.
        bias_window: s, over which differences with a direction are.
        memory: s, over which a surprise of the whole is forgotten by forecasts; familiarity never does.
        suspect, rejected: chances, see above; the second is the smaller one.

    Raises:
        ValueError: settings outside their range, shapes that do not fit.
    """

    pace: Tensor
    pace_scale: Tensor
    alone_scale: Tensor
    tail: Tail | None

    def __init__(
        self,
        mean: Tensor,
        variance: Tensor,
        noise: Tensor,
        sensor_of_dof: Tensor,
        pace: Tensor,
        window: float = 0.15,
        bias_window: float = 0.5,
        memory: float = 1.0,
        suspect: float = 0.03,
        rejected: float = 0.005,
    ) -> None:
        super().__init__(mean, variance, noise, sensor_of_dof, window, bias_window, memory)
        self.suspect, self.rejected = as_chances(suspect, rejected).values()
        self.register_buffer("pace", owned(pace))
        self.register_buffer("pace_scale", pace.new_tensor([-math.inf, 0.0]))  # says nothing, see `bias_scale`
        self.register_buffer("alone_scale", pace.new_zeros(2))
        self.tail = None
        self._single: SingleJudge | None = None

    @classmethod
    def of(cls, primitive: InteractionPrimitive, **settings: float) -> InteractionSurprise:
        """That of a primitive's demonstrations, which judges nobody: see `know`.

        Args:
            primitive: of the demonstrations.
            settings: ``window``, ``bias_window``, ``memory`` (default: half as long as a demonstration),
                ``suspect``, ``rejected``.
        """
        weights, basis = primitive.weights, primitive.basis
        phase = torch.linspace(0, 1, POINTS, dtype=weights.dtype, device=weights.device)
        with torch.no_grad():
            mean, variance = basis.project_moments(phase, weights.mean(0), basis.variances(weights))
        # A DoF that never moved, and was never noisy, is not surprised by rounding.
        least = 1e-6 * primitive.value_variance + torch.finfo(weights.dtype).eps ** 1.5
        noise = torch.maximum(primitive.residual_variance, least)
        sensors = primitive.layout.modality_of_dof.to(weights.device)
        settings = {"memory": 0.5 * float(primitive.durations.median()), **settings}
        pace = primitive.phase_velocity.mean()
        deviation = primitive.phase_velocity.var(correction=0).sqrt().clamp(min=LEAST_SPREAD * pace)
        return cls(mean, variance.clamp(min=0), noise, sensors, torch.stack([pace, deviation]), **settings)

    def settings(self) -> dict[str, float]:
        """What `of` takes."""
        return {name: getattr(self, name) for name in ("window", "bias_window", "memory", "suspect", "rejected")}

    def know(self, largest: Tensor, finest: float = 0.0) -> None:
        """Bounds of the sensors, of which `usual` and `usual_bias` are known; it judges from `know_whole` on.

        Args:
            largest: [B, S, 2], the largest logarithms of each sensor in B interactions left out, see `update`; NaN:
                not shown.
            finest: the smallest chance that they tell: a smaller one is not looked for in their tail.
        """
        rejected = max(self.rejected, finest)
        for sensor in range(self.n_sensors):
            shown = largest[:, sensor][~largest[:, sensor].isnan().any(-1)]
            self.known[sensor] = len(shown) >= FEWEST
            if not bool(self.known[sensor]):
                continue
            self.bias_scale[:, sensor] = scale = on_one_scale(*shown.unbind(-1))
            larger = torch.maximum(shown[:, 0], scale[0] + scale[1] * shown[:, 1])
            tail = Tail.fit(larger.unsqueeze(-1))
            self.bounds[:, sensor] = torch.cat([tail.at(max(self.suspect, 2 * rejected)), tail.at(rejected)])

    def know_pace(self, largest: Tensor) -> None:
        """On which scale the pace says as much as the sensors together.

        Args:
            largest: [B, 2], of sensors together and of the pace in B interactions left out, see `verdict`.
        """
        self.pace_scale.copy_(on_one_scale(*largest.unbind(-1)))

    def know_alone(self, together: Tensor, alone: Tensor) -> None:
        """On which scale an interaction of which one sensor tells is as surprising as one of which all do.

        Args:
            together: [A], the largest `whole` of interactions left out, all sensors shown.
            alone: [B], the same with one of them shown.
        """
        scale = on_one_scale(together, alone)
        self.alone_scale.copy_(torch.stack([scale[0], scale[1] - 1]))

    def know_whole(self, largest: Tensor) -> None:
        """The tail of the whole, from [B], the largest `whole` of interactions left out."""
        self.tail = Tail.fit(largest.unsqueeze(-1))

    def whole(self, parts: Tensor) -> Tensor:
        """How surprising it is as a whole, [...], of parts [..., 3], see `verdict`."""
        sensors, pace, few = parts.unbind(-1)
        whole = torch.maximum(sensors, self.pace_scale[0] + self.pace_scale[1] * pace)
        least = 1 / self.known.sum().clamp(min=2)
        alone = ((few - least) / (1 - least)).clamp(0, 1)
        return whole + alone * (self.alone_scale[0] + self.alone_scale[1] * whole)

    def check(self, model: StateSpace) -> None:
        """See `Part.check`: it is for as many DoFs as the model has."""
        if len(self.noise) != model.n_dofs:
            raise ValueError(f"the surprise is for {len(self.noise)} DoFs, the model has {model.n_dofs}")

    def select(self, view: View) -> InteractionSurprise:
        """See `Part.select`."""
        part = super().select(view)
        assert isinstance(part, InteractionSurprise)
        part._single = None
        return part

    def named_values(self, layout: Layout) -> dict[str, float]:
        """See `Part.named_values`: ``surprise/suspect/SENSOR``, the multiple of what is usual from which it is."""
        pairs = zip(layout.names, self.bounds[0].exp().tolist(), self.known.tolist(), strict=True)
        return {f"surprise/suspect/{name}": level for name, level, known in pairs if known}

    def judge(self, memory: SurpriseMemory, noticed: Noticed) -> tuple[SurpriseMemory, Tensor | None]:
        """See `Surprise.judge`: a memory and a sample that was noticed."""
        if self.tail is not None and serves(memory, noticed):
            single = self._single
            if single is None or single.changed(self):
                self._single = single = SingleJudge(self)
            kept, counts = single(memory, noticed)
            memory = SurpriseMemory(kept)
        else:
            memory, seen, _ = self.update(memory, noticed)
            if self.tail is None:
                return memory, None
            parts, counts = self.verdict(memory, noticed)
            whole = self.whole(parts)
            beyond = (whole - self.tail.quantiles[0, -1]).clamp(min=0)
            some = seen.any(-1) & self.voices(memory).any(-1)
            kept = memory.kept.clone()
            kept[..., :-1, 3] = torch.where(some.unsqueeze(-1), counts, memory.counts)
            kept[..., -1, 0] = torch.where(some, torch.maximum(memory.largest, whole), memory.largest)
            kept[..., -1, 1] = torch.where(some, torch.maximum(memory.recent, beyond), memory.recent)
            memory = SurpriseMemory(kept)
            counts = memory.counts
            if bool((counts == 1).all()):
                return memory, None
        if counts is None:
            return memory, None
        sensors_of = self.sensor_of_dof if noticed.rows is None else self.sensor_of_dof[noticed.rows]
        return memory, counts[..., sensors_of]

    def familiarity(self, memory: SurpriseMemory) -> Tensor:
        """See `Surprise.familiarity`: the chance of a larger one in an interaction like those demonstrated."""
        if self.tail is None:
            return torch.full_like(memory.largest, torch.nan)
        found = self.tail.above(memory.largest.clamp(min=-1e3).unsqueeze(-1)).squeeze(-1)
        return torch.where(memory.largest.isinf(), 1, found)

    def doubt(self, memory: SurpriseMemory) -> Tensor:
        """[...], how unlikely the surprise of late is, of a memory: minus the decadic logarithm of its chance.

        At least that of the end of the distribution's body; 0 where nobody knows.
        """
        if self.tail is None:
            return torch.zeros_like(memory.recent)
        return (memory.recent / self.tail.length[0] - math.log(1 - BODY[-1])) / math.log(10)

    @property
    def tail_known(self) -> bool:
        """Whether it is calibrated."""
        return self.tail is not None

    def voices(self, memory: SurpriseMemory) -> Tensor:
        """bool [..., S], which sensors have a say in a memory: those that are known, and were here lately."""
        return self.known & (memory.sensors[..., 1] > HERE)

    def verdict(self, memory: SurpriseMemory, noticed: Noticed) -> tuple[Tensor, Tensor]:
        """How surprising sensors are together, and the pace, and one by the number of sensors that have a say,
        [..., 3]; and what sensors count, [..., S].

        Args:
            memory: after the sample.
            noticed: the sample.
        """
        voices, level = self.voices(memory), memory.level
        low, high = self.bounds
        excess = (level - low) / (high - low)
        ordered = torch.where(voices, excess, torch.inf).sort(-1).values
        number = voices.sum(-1, keepdim=True)
        # Of two the calmer one; of an even number beyond that the more surprised one of the two in the middle.
        middle = ordered.gather(-1, torch.where(number > 2, number.div(2, rounding_mode="floor"), 0))
        middle = torch.where(number > 0, middle, 0).clamp(min=0)
        alone = (memory.sensors[..., 4] - high - math.log(ALONE[0])) / math.log(ALONE[1] / ALONE[0])
        part = torch.maximum(excess - middle, alone).clamp(0, 1)
        # Who says nothing is neither better nor worse than before.
        counts = torch.where(voices, 1 - part.square() * (3 - 2 * part), memory.counts)
        # A sensor that counts less says less of the interaction, too; where none counts all are asked again.
        say = voices * (counts + LEAST_SAY)
        whole = (torch.where(voices, excess, 0) * say).sum(-1) / say.sum(-1).clamp(min=LEAST_SAY)
        few = say.square().sum(-1) / say.sum(-1).clamp(min=LEAST_SAY).square()
        pace = torch.zeros_like(whole)
        if noticed.mean.shape[-1] > 1:  # of phases that have a velocity
            pace = ((noticed.mean[..., 1] - self.pace[0]) / self.pace[1]).square().clamp(max=ABSURD).log1p()
        return torch.stack([whole, pace, few], -1), counts

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have nothing kept."""
        return {**super().__getstate__(), "_single": None}

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return "; ".join(f"{name}={value:g}" for name, value in self.settings().items())

    def extra_repr(self) -> str:
        """Its settings, and whether it judges."""
        return f"{self.meant()}, {'calibrated' if self.tail is not None else 'not calibrated, judges nobody'}"
