"""How far off sensors are, as multiples of what is usual, remembered: what `InteractionSurprise` judges by.

Two things are asked of every sample: how far it is from what the members expect, and how far from all that was
demonstrated at that phase; each as a multiple of what is usual there. And one of many: whether their differences
from what was expected have a direction, as those of a sensor that drifts.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_number
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.surprise import Noticed, Surprise
from torch_ebip.interaction.grid import between
from torch_ebip.interaction.surprise_memory import (
    ABSURD,
    BACK,
    BEFORE,
    LEAST_SAY,
    MOST,
    MOST_BIAS,
    ONE_SIDED,
    PER_SENSOR,
    SurpriseMemory,
)


class SensorLevels(Surprise):
    """Levels of S sensors: the larger of how far off they are of late, and of how one-sidedly.

    The first is the logarithm of a mean, over ``window``, of multiples: the larger of (y - h)^2 / (var h + R) and
    (y - m)^2 / (v + R), each as a mean over a sensor's DoFs and divided by what is usual at the phase; h of the
    members, m and v of the demonstrations there, R the closed form. The second is that of the square of the mean,
    over ``bias_window``, of (y - h) / sqrt(var h + R), over what is usual of that: as a mean over DoFs, too, and on
    the scale of the first. Each difference is at most `ONE_SIDED` times as large as usual there: spikes have no
    direction.

    Args:
        mean: [P, D], of the demonstrations at phases evenly from 0 to 1, units of the DoFs.
        variance: [P, D], the same of their variance, squared units.
        noise: [D], R, squared units.
        sensor_of_dof: int64 [D].
        window: s, see above.
        bias_window: s, see above.
        memory: s, over which a surprise of the whole is forgotten by forecasts; familiarity never does.

    Raises:
        ValueError: settings outside their range, shapes that do not fit.
    """

    mean: Tensor
    variance: Tensor
    noise: Tensor
    sensor_of_dof: Tensor
    place_of_dof: Tensor
    usual: Tensor
    usual_bias: Tensor
    bias_scale: Tensor
    known: Tensor
    bounds: Tensor

    def __init__(
        self,
        mean: Tensor,
        variance: Tensor,
        noise: Tensor,
        sensor_of_dof: Tensor,
        window: float,
        bias_window: float,
        memory: float,
    ) -> None:
        super().__init__()
        D = len(noise)
        if mean.shape != variance.shape or mean.shape[1:] != (D,) or len(mean) < 2 or sensor_of_dof.shape != (D,):
            raise ValueError(
                f"mean and variance must be [P, {D}], sensor_of_dof [{D}], got {list(mean.shape)}, "
                f"{list(variance.shape)} and {list(sensor_of_dof.shape)}"
            )
        self.window = as_number("window", window, 0, above=True)
        self.bias_window = as_number("bias_window", bias_window, 0, above=True)
        self.memory = as_number("memory", memory, 0, above=True)
        S = int(sensor_of_dof.max()) + 1
        same = (sensor_of_dof == sensor_of_dof.unsqueeze(1)).long()
        self.register_buffer("mean", owned(mean))
        self.register_buffer("variance", owned(variance))
        self.register_buffer("noise", owned(noise))
        self.register_buffer("sensor_of_dof", owned(sensor_of_dof))
        self.register_buffer("place_of_dof", same.tril(-1).sum(1), persistent=False)
        self.register_buffer("usual", mean.new_ones(len(mean), 2, S))
        self.register_buffer("usual_bias", mean.new_ones(len(mean), S))
        # Until somebody knows what is usual of it, and in files of before, a bias says nothing.
        self.register_buffer("bias_scale", torch.stack([mean.new_full((S,), -math.inf), mean.new_zeros(S)]))
        self.register_buffer("known", torch.zeros(S, dtype=torch.bool, device=mean.device))
        self.register_buffer("bounds", torch.stack([mean.new_zeros(S), mean.new_ones(S)]))
        self.most_dofs = int(same.sum(1).max())
        self._kept: tuple[Tensor, int, tuple[float, ...], Tensor] | None = None

    @property
    def n_sensors(self) -> int:
        """S."""
        return self.usual.shape[-1]

    def select(self, view: View) -> SensorLevels:
        """See `Part.select`: of the DoFs of a view; sensors keep their numbers."""
        part = super().select(view)
        assert isinstance(part, SensorLevels)
        for name in ("mean", "variance", "noise", "sensor_of_dof", "place_of_dof"):
            part.register_buffer(name, getattr(self, name)[..., view.dofs], persistent=name != "place_of_dof")
        part._kept = None
        return part

    def start(self, like: Tensor) -> SurpriseMemory:
        """See `Surprise.start`: members ``like`` [..., E, n]."""
        kept = self.noise.new_zeros(*like.shape[:-2], self.n_sensors + 1, PER_SENSOR + self.most_dofs)
        kept[..., :-1, 3] = 1
        kept[..., -1, 0] = -math.inf
        return SurpriseMemory(kept)

    def forget(self, memory: SurpriseMemory, dt: Tensor) -> SurpriseMemory:
        """See `Surprise.forget`, over dt [...] s."""
        if dt.requires_grad or dt.is_inference() or torch.is_inference_mode_enabled():
            return SurpriseMemory(memory.kept * self._left(dt))
        kept = self._kept  # another thread may exchange it
        spans = self.window, self.bias_window, self.memory
        if kept is None or kept[0] is not dt or kept[1:3] != (dt._version, spans):
            self._kept = kept = dt, dt._version, spans, self._left(dt)
        return SurpriseMemory(memory.kept * kept[3])

    def _left(self, dt: Tensor) -> Tensor:
        """[..., S + 1, 6 + m], what is left after dt [...] s, as a share."""
        one = torch.ones_like(dt)
        window, bias, slowly = (torch.exp(-dt / s) for s in (self.window, self.bias_window, self.memory))
        each = torch.stack([window, window, one, one, one, *[bias] * (1 + self.most_dofs)], -1)
        whole = torch.stack([one, slowly, *[one] * (PER_SENSOR - 2 + self.most_dofs)], -1)
        return torch.stack([*[each] * self.n_sensors, whole], -2)

    def squares(self, noticed: Noticed) -> tuple[Tensor, Tensor, Tensor]:
        """What a sample says of each sensor.

        Args:
            noticed: the sample, over K DoFs.

        Returns:
            Both squares, [..., 2, S], in the variances expected; 1 or 0, [..., S], for whether it is here; and
            (y - h) / sqrt(var h + R) of each DoF, [..., K], 0 where it was not observed.
        """
        y, observed, rows = noticed.y, noticed.observed, noticed.rows
        moments = torch.cat([self.mean, self.variance], -1)
        noise, sensors = self.noise, self.sensor_of_dof
        if rows is not None:
            moments = torch.cat([self.mean[:, rows], self.variance[:, rows]], -1)
            noise, sensors = noise[rows], sensors[rows]
        mean, variance = between(moments, noticed.mean[..., 0]).chunk(2, -1)
        near = (y - noticed.expected) / (noticed.variance + noise).sqrt()
        far = (y - mean) / (variance + noise).sqrt()
        # Infinity times nothing would reach other sensors, and gradients.
        off, far = (part.clamp(-math.sqrt(ABSURD), math.sqrt(ABSURD)) for part in (near, far))
        both = torch.stack([off.square(), far.square()], -2)
        member = one_hot(sensors, self.n_sensors).to(both)
        if observed is None:
            count = member.sum(0).expand(*both.shape[:-2], -1)
        else:
            both = torch.where(observed.unsqueeze(-2), both, 0)
            off = torch.where(observed, off, 0)
            count = observed.to(both) @ member
        return both @ member / count.clamp(min=1).unsqueeze(-2), (count > 0).to(both), off

    def update(self, memory: SurpriseMemory, noticed: Noticed) -> tuple[SurpriseMemory, Tensor, Tensor]:
        """After a sample.

        Args:
            memory: before it.
            noticed: the sample, over K DoFs.

        Returns:
            Sums and levels; bool [..., S], which sensors it has; and the logarithms [..., S, 2] that levels are made
            of, of the second one without its scale.
        """
        squares, here, off = self.squares(noticed)
        phase = noticed.mean[..., 0]
        S = self.n_sensors
        usual = between(torch.cat([self.usual.flatten(1), self.usual_bias], -1), phase)
        usual = usual.view(*usual.shape[:-1], 3, S)
        sensors, places = self.sensor_of_dof, self.place_of_dof
        if noticed.rows is not None:
            sensors, places = sensors[noticed.rows], places[noticed.rows]
        off = (off / usual[..., 0, sensors].sqrt()).clamp(-ONE_SIDED, ONE_SIDED)
        signed = off @ one_hot(sensors * self.most_dofs + places, S * self.most_dofs).to(off)
        signed = signed.view(*signed.shape[:-1], S, self.most_dofs)
        multiples = (squares / usual[..., :2, :]).amax(-2).clamp(max=ABSURD) * here
        total, samples, level, counts, last, lately = memory.sensors[..., :PER_SENSOR].unbind(-1)
        most = MOST * self.bounds[1].exp() if self.tail_known else ABSURD
        total, samples = total + multiples.clamp(max=most) * self.stride, samples + here * self.stride
        lately, sums = lately + here * self.stride, memory.sensors[..., PER_SENSOR:] + signed * self.stride
        seen = here > 0
        last = torch.where(seen, torch.where(seen, multiples, 1).clamp(min=LEAST_SAY).log(), last)
        # As if there had been one usual sample before.
        recent = ((total + 1) / (samples + 1)).log()
        mean = (sums / (lately + BEFORE).unsqueeze(-1)).square().sum(-1) / self.dofs_of_sensor
        bias = (mean / usual[..., 2, :]).clamp(min=LEAST_SAY).log()
        if self.tail_known:  # what it is at most, for the same reason as a sample's
            offset, scale = self.bias_scale
            beyond = offset + scale * bias - self.most_bias
            less = torch.where(seen & (beyond > 0), beyond / scale.clamp(min=1e-6), 0)
            bias, sums = bias - less, sums * torch.exp(-0.5 * less).unsqueeze(-1)
        level = torch.where(seen, torch.maximum(recent, self.bias_scale[0] + self.bias_scale[1] * bias), level)
        kept = torch.stack([total, samples, level, counts.expand_as(level), last, lately], -1)
        rows = torch.cat([torch.cat([kept, sums], -1), memory.kept[..., -1:, :].expand(*sums.shape[:-2], 1, -1)], -2)
        return SurpriseMemory(rows), seen, torch.stack([recent, bias], -1)

    @property
    def most_bias(self) -> Tensor:
        """[S], the level that a bias has at most: one that ends falls below the first bound within `BACK`."""
        low, high = self.bounds
        falls: Tensor = 2 * self.bias_scale[1] * BACK / self.bias_window
        most: Tensor = high + (falls - (high - low)).clamp(0, math.log(MOST_BIAS))
        return most

    @property
    def dofs_of_sensor(self) -> Tensor:
        """[S], how many DoFs each has here; at least 1."""
        counts = torch.bincount(self.sensor_of_dof, minlength=self.n_sensors)
        return counts.clamp(min=1).to(self.noise)

    @property
    def tail_known(self) -> bool:
        """Whether it is calibrated."""
        return False

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have nothing kept."""
        return {**self.__dict__, "_kept": None}
