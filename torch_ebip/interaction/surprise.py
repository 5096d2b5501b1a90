"""Surprise of an interaction: each sensor against what the demonstrations themselves give when left out.

Two things are asked of every sample: how far it is from what the members expect, and how far from all that was
demonstrated at that phase; each as a multiple of what is usual there. What a model misfits is usual, so thresholds
come from interactions left out (see `torch_ebip.learning.surprising`) and from no table of chi-square.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_number
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.surprise import Noticed, Surprise
from torch_ebip.interaction.grid import between
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.single_judge import SingleJudge, serves
from torch_ebip.interaction.surprise_memory import ABSURD, ALONE, HERE, LEAST_SAY, MOST, SurpriseMemory
from torch_ebip.interaction.tail import BODY, FEWEST, Tail, as_chances
from torch_ebip.recordings.layout import Layout

POINTS = 41
"""Phases of the grid."""


class InteractionSurprise(Surprise):
    """Judges sensors, the modalities of a layout, and the interaction as a whole.

    A multiple is the larger of two: (y - h)^2 / (var h + R) and (y - m)^2 / (v + R), each as a mean over a sensor's
    DoFs and divided by what is usual at the phase; h of the members, m and v of the demonstrations there, R the
    closed form. A level is the logarithm of its mean over a window that forgets.

    A sensor is suspect above the level that demonstrations left out exceed with the chance ``suspect`` in a whole
    interaction, and rejected above that of ``rejected``; between them it counts less and less. What most sensors are
    surprised by is no fault of one: the excess of the middle one is taken off. A sample beyond `ALONE` always is.

    Args:
        mean: [P, D], of the demonstrations at phases evenly from 0 to 1, units of the DoFs.
        variance: [P, D], the same of their variance, squared units.
        noise: [D], R, squared units.
        sensor_of_dof: int64 [D].
        window: s, over which levels are means.
        memory: s, over which a surprise of the whole is forgotten by forecasts; familiarity never does.
        suspect, rejected: chances, see above; the second is the smaller one.

    Raises:
        ValueError: settings outside their range, shapes that do not fit.
    """

    mean: Tensor
    variance: Tensor
    noise: Tensor
    sensor_of_dof: Tensor
    usual: Tensor
    known: Tensor
    bounds: Tensor
    tail: Tail | None

    def __init__(
        self,
        mean: Tensor,
        variance: Tensor,
        noise: Tensor,
        sensor_of_dof: Tensor,
        window: float = 0.15,
        memory: float = 2.0,
        suspect: float = 0.01,
        rejected: float = 0.001,
    ) -> None:
        super().__init__()
        D = len(noise)
        if mean.shape != variance.shape or mean.shape[1:] != (D,) or len(mean) < 2 or sensor_of_dof.shape != (D,):
            raise ValueError(
                f"mean and variance must be [P, {D}], sensor_of_dof [{D}], got {list(mean.shape)}, "
                f"{list(variance.shape)} and {list(sensor_of_dof.shape)}"
            )
        self.window = as_number("window", window, 0, above=True)
        self.memory = as_number("memory", memory, 0, above=True)
        self.suspect, self.rejected = as_chances(suspect, rejected).values()
        S = int(sensor_of_dof.max()) + 1
        self.register_buffer("mean", owned(mean))
        self.register_buffer("variance", owned(variance))
        self.register_buffer("noise", owned(noise))
        self.register_buffer("sensor_of_dof", owned(sensor_of_dof))
        self.register_buffer("usual", mean.new_ones(len(mean), 2, S))
        self.register_buffer("known", torch.zeros(S, dtype=torch.bool, device=mean.device))
        self.register_buffer("bounds", torch.stack([mean.new_zeros(S), mean.new_ones(S)]))
        self.tail = None
        self._kept: tuple[Tensor, Tensor, Tensor] | None = None
        self._single: SingleJudge | None = None

    @classmethod
    def of(cls, primitive: InteractionPrimitive, **settings: float) -> InteractionSurprise:
        """That of a primitive's demonstrations, which judges nobody: see `know`.

        Args:
            primitive: of the demonstrations.
            settings: ``window``, ``memory`` (default: twice as long as a demonstration), ``suspect``, ``rejected``.
        """
        weights, basis = primitive.weights, primitive.basis
        phase = torch.linspace(0, 1, POINTS, dtype=weights.dtype, device=weights.device)
        with torch.no_grad():
            mean, variance = basis.project_moments(phase, weights.mean(0), basis.variances(weights))
        # A DoF that never moved, and was never noisy, is not surprised by rounding.
        least = 1e-6 * primitive.value_variance + torch.finfo(weights.dtype).eps ** 1.5
        noise = torch.maximum(primitive.residual_variance, least)
        sensors = primitive.layout.modality_of_dof.to(weights.device)
        settings = {"memory": 2 * float(1 / primitive.phase_velocity.median()), **settings}
        return cls(mean, variance.clamp(min=0), noise, sensors, **settings)

    @property
    def n_sensors(self) -> int:
        """S."""
        return self.usual.shape[-1]

    def settings(self) -> dict[str, float]:
        """What `of` takes."""
        return {name: getattr(self, name) for name in ("window", "memory", "suspect", "rejected")}

    def know(self, usual: Tensor, largest: Tensor) -> None:
        """Bounds of the sensors; it judges from when it has a `tail`, too.

        Args:
            usual: [P, 2, S], what is usual of both squares at the phases of the grid.
            largest: [B, S], the largest level of each sensor in B interactions left out; NaN: not shown.
        """
        self.usual.copy_(usual)
        for sensor in range(self.n_sensors):
            shown = largest[:, sensor][~largest[:, sensor].isnan()]
            self.known[sensor] = len(shown) >= FEWEST
            if bool(self.known[sensor]):
                tail = Tail.fit(shown.unsqueeze(-1))
                self.bounds[:, sensor] = torch.cat([tail.at(self.suspect), tail.at(self.rejected)])

    def check(self, model: StateSpace) -> None:
        """See `Part.check`: it is for as many DoFs as the model has."""
        if len(self.noise) != model.n_dofs:
            raise ValueError(f"the surprise is for {len(self.noise)} DoFs, the model has {model.n_dofs}")

    def select(self, view: View) -> InteractionSurprise:
        """See `Part.select`: of the DoFs of a view; sensors keep their numbers."""
        part = super().select(view)
        assert isinstance(part, InteractionSurprise)
        for name in ("mean", "variance", "noise", "sensor_of_dof"):
            part.register_buffer(name, getattr(self, name)[..., view.dofs])
        part._kept = part._single = None
        return part

    def named_values(self, layout: Layout) -> dict[str, float]:
        """See `Part.named_values`: ``surprise/suspect/SENSOR``, the multiple of what is usual from which it is."""
        pairs = zip(layout.names, self.bounds[0].exp().tolist(), self.known.tolist(), strict=True)
        return {f"surprise/suspect/{name}": level for name, level, known in pairs if known}

    def start(self, like: Tensor) -> SurpriseMemory:
        """See `Surprise.start`: members ``like`` [..., E, n]."""
        sensors = self.noise.new_zeros(*like.shape[:-2], self.n_sensors, 5)
        sensors[..., 3] = 1
        together = self.noise.new_zeros(*like.shape[:-2], 3)
        together[..., 1] = -math.inf
        return SurpriseMemory(sensors, together)

    def forget(self, memory: SurpriseMemory, dt: Tensor) -> SurpriseMemory:
        """See `Surprise.forget`, over dt [...] s."""
        kept = self._kept  # another thread may exchange it
        if kept is None or kept[0] is not dt:
            one = torch.ones_like(dt)
            window, slowly = torch.exp(-dt / self.window), torch.exp(-dt / self.memory)
            sensors = torch.stack([window, window, one, one, one], -1).unsqueeze(-2)
            self._kept = kept = dt, sensors, torch.stack([one, one, slowly], -1)
        _, sensors, together = kept
        return SurpriseMemory(memory.sensors * sensors, memory.together * together)

    def judge(self, memory: SurpriseMemory, noticed: Noticed) -> tuple[SurpriseMemory, Tensor | None]:
        """See `Surprise.judge`: a memory and a sample that was noticed."""
        if self.tail is not None and serves(memory, noticed):
            single = self._single
            if single is None or single.changed(self):
                self._single = single = SingleJudge(self)
            sensors, together, counts = single(memory, noticed)
            memory = SurpriseMemory(sensors, together)
        else:
            memory, seen = self.update(memory, noticed)
            if self.tail is None:
                return memory, None
            whole, counts = self.verdict(memory)
            beyond = (whole - self.tail.quantiles[0, -1]).clamp(min=0)
            last, largest, recent = memory.together.unbind(-1)
            some = seen.any(-1) & self.voices(memory).any(-1)
            together = torch.stack(
                [
                    torch.where(some, whole, last),
                    torch.where(some, torch.maximum(largest, whole), largest),
                    torch.where(some, torch.maximum(recent, beyond), recent),
                ],
                -1,
            )
            total, samples, level, _, last = memory.sensors.unbind(-1)
            memory = SurpriseMemory(torch.stack([total, samples, level, counts, last], -1), together)
            if bool((counts == 1).all()):
                return memory, None
        if counts is None:
            return memory, None
        sensors_of = self.sensor_of_dof if noticed.rows is None else self.sensor_of_dof[noticed.rows]
        return memory, counts[..., sensors_of]

    def update(self, memory: SurpriseMemory, noticed: Noticed) -> tuple[SurpriseMemory, Tensor]:
        """Sums and levels of a memory after a sample that was noticed, and which sensors it has, bool [..., S]."""
        multiples, here = self.multiples(noticed)
        total, samples, level, counts, last = memory.sensors.unbind(-1)
        most = MOST * self.bounds[1].exp() if self.tail is not None else ABSURD
        total, samples = total + multiples.clamp(max=most) * self.stride, samples + here * self.stride
        seen = here > 0
        last = torch.where(seen, torch.where(seen, multiples, 1).clamp(min=LEAST_SAY).log(), last)
        # As if there had been one usual sample before.
        level = torch.where(seen, ((total + 1) / (samples + 1)).log(), level)
        return memory._replace(sensors=torch.stack([total, samples, level, counts.expand_as(level), last], -1)), seen

    def multiples(self, noticed: Noticed) -> tuple[Tensor, Tensor]:
        """Multiples of what is usual, [..., S], of what was noticed, and 1 or 0 for whether a sensor is here."""
        squares, here = self.squares(noticed)
        usual = between(self.usual.flatten(1), noticed.mean[..., 0])
        return (squares / usual.view_as(squares)).amax(-2).clamp(max=ABSURD) * here, here

    def squares(self, noticed: Noticed) -> tuple[Tensor, Tensor]:
        """Both squares of each sensor, [..., 2, S], in the variances expected, and 1 or 0 [..., S] for it is here."""
        y, observed, rows = noticed.y, noticed.observed, noticed.rows
        moments = torch.cat([self.mean, self.variance], -1)
        noise, sensors = self.noise, self.sensor_of_dof
        if rows is not None:
            moments = torch.cat([self.mean[:, rows], self.variance[:, rows]], -1)
            noise, sensors = noise[rows], sensors[rows]
        mean, variance = between(moments, noticed.mean[..., 0]).chunk(2, -1)
        near = (y - noticed.expected).square() / (noticed.variance + noise)
        far = (y - mean).square() / (variance + noise)
        both = torch.stack([near, far], -2).clamp(max=ABSURD)  # infinity times nothing would reach other sensors
        member = torch.nn.functional.one_hot(sensors, self.n_sensors).to(both)
        if observed is None:
            count = member.sum(0).expand(*both.shape[:-2], -1)
        else:
            both = torch.where(observed.unsqueeze(-2), both, 0)
            count = observed.to(both) @ member
        return both @ member / count.clamp(min=1).unsqueeze(-2), (count > 0).to(both)

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

    def voices(self, memory: SurpriseMemory) -> Tensor:
        """bool [..., S], which sensors have a say in a memory: those that are known, and were here lately."""
        return self.known & (memory.sensors[..., 1] > HERE)

    def verdict(self, memory: SurpriseMemory) -> tuple[Tensor, Tensor]:
        """The whole [...], and what sensors count [..., S], of a memory."""
        voices, level = self.voices(memory), memory.level
        low, high = self.bounds
        excess = (level - low) / (high - low)
        ordered = torch.where(voices, excess, torch.inf).sort(-1).values
        number = voices.sum(-1, keepdim=True)
        middle = ordered.gather(-1, (number - 1).clamp(min=0).div(2, rounding_mode="floor"))
        middle = torch.where(number > 0, middle, 0).clamp(min=0)
        alone = (memory.sensors[..., 4] - high - math.log(ALONE[0])) / math.log(ALONE[1] / ALONE[0])
        part = torch.maximum(excess - middle, alone).clamp(0, 1)
        counts = torch.where(voices, 1 - part.square() * (3 - 2 * part), 1)
        # A sensor that counts less says less of the interaction, too; where none counts all are asked again.
        say = voices * (counts + LEAST_SAY)
        whole = (torch.where(voices, excess, 0) * say).sum(-1) / say.sum(-1).clamp(min=LEAST_SAY)
        return whole, counts

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have nothing kept."""
        return {**self.__dict__, "_kept": None, "_single": None}

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return "; ".join(f"{name}={value:g}" for name, value in self.settings().items())

    def extra_repr(self) -> str:
        """Its settings, and whether it judges."""
        return f"{self.meant()}, {'calibrated' if self.tail is not None else 'not calibrated, judges nobody'}"
