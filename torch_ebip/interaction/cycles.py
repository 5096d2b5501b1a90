"""Where the cycles of recordings that repeat lie: a phase on a circle for every sample.

Nobody marks where a wave begins. A recording is like itself after a period (McLeod & Wyvill 2005); the phase is that
of the wave of this period that fits best about each moment; and what all recordings share says which of their moments
belong together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief

SHORTEST = 6
"""Samples, of a period: of fewer nobody can tell a wave from noise."""
LONGEST = 0.75
"""Of a recording, of a period: the rest is what it is compared with."""
PEAKS, HIGH = 4, 0.4
"""Periods that are tried of a recording, and how like it must be to itself after them, of the greatest likeness."""
REPEATS = 0.6
"""Share of the variance of half the recordings that their own cycles must explain: otherwise they do not repeat."""
WINDOW = 0.35
"""Periods, the deviation of the window in which a wave is fitted."""
REACH = 4.0
"""Deviations of a window, up to which it is looked at."""
REFINED, SMOOTH = 4, 0.1
"""How often the phase is moved to where the recording's own cycle fits better, and over how many periods alike."""
TOGETHER = 0.7
"""Of recordings that begin at one phase, the length of the mean of unit vectors: less is anywhere."""
WHOLE = 0.95
"""Cycles that a recording has at least."""
HARMONICS = 3
"""Of the cycle that phases are moved towards."""


class Cycles(NamedTuple):
    """Phases of N recordings of at most T samples.

    Attributes:
        phase: [N, T], in cycles, increasing, not wrapped; the first within -1/2 and 1/2. What is behind the end of a
            recording has the phase of its last sample.
        explained: [N], share of the variance of each recording that its own cycle explains.
    """

    phase: Tensor
    explained: Tensor

    def __repr__(self) -> str:
        return brief(self)


@without_autocast
def cycles_of(values: Tensor, measured: Tensor, lengths: Tensor) -> Cycles:
    """The cycles of recordings that repeat.

    Args:
        values: [N, T, D], units of the DoFs; gaps filled, whatever behind the ends.
        measured: bool [N, T, D], where a value was measured.
        lengths: int64 [N], samples of each.

    Raises:
        ValueError: recordings that do not repeat, or one with less than a cycle: says which.
    """
    values = values.double()
    inside = (torch.arange(values.shape[1], device=values.device) < lengths.unsqueeze(-1)).unsqueeze(-1)
    some = (measured & inside).any(1, keepdim=True)
    count = lengths.view(-1, 1, 1)
    apart = torch.where(inside & some, values - (values * inside).sum(1, keepdim=True) / count, 0)
    spread = (apart.square().sum((0, 1)) / lengths.sum()).sqrt()
    apart = apart / torch.where(spread > 0, spread, torch.inf)

    tried = [_periods(apart[i, :n]) for i, n in enumerate(lengths.tolist())]
    if sum(len(periods) > 0 for periods in tried) * 2 < len(tried):
        raise ValueError("these recordings do not repeat: half of them are never like themselves some time later")
    best = [_best(apart[i, : lengths[i]], periods) for i, periods in enumerate(tried)]
    explained = apart.new_tensor([share for _, share in best])
    clear = explained >= REPEATS
    if not bool(clear.double().mean() >= 0.5):
        raise ValueError(
            "these recordings do not repeat: cycles explain a share of "
            f"{float(explained.median()):.2f} of the variance of the median recording, at least {REPEATS} is needed"
        )
    usual = float(apart.new_tensor([period for period, share in best if share >= REPEATS]).median())
    # Of a recording in which nothing comes again the others say how long a cycle takes.
    periods = [period if share >= REPEATS else usual for period, share in best]
    waves = [_wave(apart[i, :n], period) for i, (n, period) in enumerate(zip(lengths.tolist(), periods, strict=True))]
    direction = _shared(torch.cat(waves))
    phases = [
        _refined(apart[i, : len(wave)], wave, direction, period)[0]
        for i, (wave, period) in enumerate(zip(waves, periods, strict=True))
    ]
    short = [i for i, phase in enumerate(phases) if float(phase[-1] - phase[0]) < WHOLE]
    if short:
        raise ValueError(
            f"recordings {', '.join(map(str, short[:8]))} hold less than one cycle "
            f"(of about {usual:.0f} samples): a periodic interaction is made of whole ones"
        )
    return Cycles(_aligned(phases, values.shape[1]), explained)


def _best(values: Tensor, periods: list[float]) -> tuple[float, float]:
    """The period with which cycles explain most of a recording [T, D], and which share; 0 and 0 if none is to try."""
    best = 0.0, 0.0
    for period in periods:
        wave = _wave(values, period)
        phase, share = _refined(values, wave, _shared(wave), period)
        if share > best[1] and float(phase[-1] - phase[0]) >= WHOLE:
            best = period, share
    return best


def _refined(values: Tensor, wave: Tensor, direction: Tensor, period: float) -> tuple[Tensor, float]:
    """The phase [T] of values [T, D] whose waves are known, and the share of their variance that cycles explain."""
    phase, left = _increasing(_unwrapped(wave @ direction.conj())), 1.0
    for _ in range(REFINED):
        phase, left = _fitted(values, phase, period)
    return phase, 1 - left


def _periods(values: Tensor) -> list[float]:
    """Samples that a cycle of a recording [T, D] may have, the fewest first."""
    T = len(values)
    most = int(LONGEST * T)
    if most <= SHORTEST:
        return []
    # 2 sum x(t) x(t + k) / sum (x(t)^2 + x(t + k)^2), which a changing size does not spoil.
    spectrum = torch.fft.rfft(values, n=2 * T, dim=0)
    products = torch.fft.irfft(spectrum.abs().square().sum(-1), n=2 * T)[:T]
    square = values.square().sum(-1)
    before = torch.cat([square.new_zeros(1), square.cumsum(0)])
    lags = torch.arange(T, device=values.device)
    energy = before[T - lags] + before[T] - before[lags]
    like = 2 * products / energy.clamp(min=torch.finfo(values.dtype).tiny)
    below = (like < 0).nonzero()
    first = max(int(below[0]) if len(below) else most, SHORTEST)
    part = like[first - 1 : most + 1]
    if len(part) < 3:
        return []
    heights = torch.where((part[1:-1] >= part[:-2]) & (part[1:-1] >= part[2:]), part[1:-1], -1)
    high = (heights >= HIGH * heights.max()) & (heights > 0)
    peaks = [float(first + at) for at in high.nonzero().flatten().tolist()[:PEAKS]]
    # Where speed changes, a recording may be most like itself after two cycles, and hardly after one.
    return sorted({peak / part for peak in peaks for part in (1, 2, 3) if peak / part >= SHORTEST})


def _wave(values: Tensor, period: float) -> Tensor:
    """Complex [T, D]: size and phase of the wave of a period that fits values [T, D] best about each moment."""
    reach = round(REACH * WINDOW * period)
    apart = torch.arange(-reach, reach + 1, device=values.device, dtype=values.dtype) / period
    angle = 2 * math.pi * apart
    features = torch.stack([torch.ones_like(apart), apart, angle.cos(), angle.sin()])  # [4, K]
    weighted = torch.exp(-0.5 * (apart / WINDOW).square()) * features
    gram = _about(torch.ones_like(values[:, :1]), (weighted.unsqueeze(1) * features).flatten(0, 1)).view(-1, 4, 4)
    ridge = 1e-9 * gram.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
    moments = _about(values, weighted)  # [T, D, 4]
    found = torch.linalg.solve(gram + torch.diag_embed(ridge.expand(-1, 4)), moments.transpose(-1, -2))
    return torch.complex(found[:, 2], -found[:, 3])


def _about(values: Tensor, kernels: Tensor) -> Tensor:
    """[T, D, M], sums over values [T, D] about each moment, weighed by M kernels [M, 2 reach + 1]."""
    reach = kernels.shape[-1] // 2
    sums = nn.functional.conv1d(values.T.unsqueeze(1), kernels.unsqueeze(1), padding=reach)  # [D, M, T]
    return sums.permute(2, 0, 1)


def _shared(waves: Tensor) -> Tensor:
    """Complex [D], the direction in which waves [T, D] are largest: they have one phase along it."""
    vectors: Tensor = torch.linalg.eigh(waves.T @ waves.conj())[1]
    return vectors[:, -1]


def _unwrapped(wave: Tensor) -> Tensor:
    """Phase [T] of a complex wave [T], in cycles, without jumps."""
    steps = torch.angle(wave[1:] * wave[:-1].conj())
    return torch.cat([torch.angle(wave[:1]), steps]).cumsum(0) / (2 * math.pi)


def _increasing(phase: Tensor) -> Tensor:
    """The phase [T] that is nearest to one and never goes back."""
    up, down = phase.cummax(0).values, phase.flip(0).cummin(0).values.flip(0)
    return 0.5 * (up + down)


def _fitted(values: Tensor, phase: Tensor, period: float) -> tuple[Tensor, float]:
    """A phase [T] moved towards where values [T, D] fit the cycle that they have on the average, and what share of
    their variance was left before."""
    order = 2 * math.pi * torch.arange(1, HARMONICS + 1, device=values.device, dtype=values.dtype)
    angle = phase.unsqueeze(-1) * order
    time = torch.linspace(-1, 1, len(values), device=values.device, dtype=values.dtype)
    shape = torch.cat([angle.cos(), angle.sin()], -1)
    # The size may change while it goes on, and where it goes on, too.
    features = torch.cat([torch.ones_like(shape[:, :1]), time.unsqueeze(-1), shape, time.unsqueeze(-1) * shape], -1)
    gram = features.T @ features
    ridge = 1e-6 * float(gram.diagonal().mean()) * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
    fit = torch.linalg.solve(gram + ridge, features.T @ values)
    left = values - features @ fit
    slopes = torch.cat([-order * angle.sin(), order * angle.cos()], -1)
    none = torch.zeros_like(slopes[:, :1])
    slope = torch.cat([none, none, slopes, time.unsqueeze(-1) * slopes], -1) @ fit
    window = max(SMOOTH * period, 1.0)
    reach = round(REACH * window)
    steps = torch.arange(-reach, reach + 1, device=values.device, dtype=values.dtype)
    near = torch.exp(-0.5 * (steps / window).square()).unsqueeze(0)
    moved, worth = (_about(part.sum(-1, keepdim=True), near).flatten() for part in (slope * left, slope.square()))
    step = (moved / (worth + 0.1 * worth.mean())).clamp(-0.1, 0.1)
    size = float(values.square().sum())
    return _increasing(phase + step), float(left.square().sum()) / size if size > 0 else 1.0


def _aligned(phases: list[Tensor], length: int) -> Tensor:
    """[N, T], with recordings that begin together at phase 0, and all within half a cycle of it."""
    begin = torch.stack([phase[0] for phase in phases])
    mean = torch.polar(torch.ones_like(begin), 2 * math.pi * begin).mean()
    if float(mean.abs()) >= TOGETHER:
        begin = begin - torch.angle(mean) / (2 * math.pi)
    whole = torch.stack([phase[0] for phase in phases]) - (begin - begin.round())
    made = [phase - part for phase, part in zip(phases, whole, strict=True)]
    return torch.stack([torch.cat([phase, phase[-1:].expand(length - len(phase))]) for phase in made])
