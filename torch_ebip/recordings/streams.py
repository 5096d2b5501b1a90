"""Recordings of several sensors, each with times of its own, put onto one grid."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from torch_ebip.common.arguments import as_number
from torch_ebip.recordings.layout import Layout
from torch_ebip.recordings.resampling import HOWS, USUAL_STEPS, How, Ordered, onto_grid, ordered

Stream = tuple[Any, Any]
"""Times [T], s, and values [T, d] of one modality."""
Interaction = Mapping[str, Stream]
"""By name of the modality."""
MOST_BAD = 1 / 3
"""Share of a stream's stamps that may run backwards or repeat: beyond it they are no times."""
MOST_SAMPLES = 10_000_000
"""Of a grid: more are a wrong stamp, not a recording."""
WHOLE = 5e-3
"""Share by which a rate that was found may be off a whole number and is taken for it."""


class Gridded(NamedTuple):
    """Interactions on one grid each.

    Attributes:
        trajectories: N of [T_i, D], NaN where nothing was measured.
        rate: samples a second, Hz.
        remarks: what was wrong with stamps, a sentence a modality.
    """

    trajectories: list[npt.NDArray[Any]]
    rate: float
    remarks: tuple[str, ...]


def gridded(
    layout: Layout,
    interactions: Sequence[Interaction],
    rate: float | None = None,
    max_gap: float | None = None,
    how: How | Mapping[str, How] = "linear",
    span: str | Sequence[tuple[float, float]] | None = None,
) -> Gridded:
    """Put interactions onto a grid: see `Demonstrations.from_streams`."""
    if isinstance(interactions, Mapping) or len(interactions) == 0:
        raise ValueError("interactions must be a list of at least one {modality: (times, values)}")
    hows: dict[str, How] = dict.fromkeys(layout.names, "linear")
    hows |= dict.fromkeys(layout.names, how) if isinstance(how, str) else how
    for name, asked in hows.items():
        layout.slice(name)
        if asked not in HOWS:
            raise ValueError(f"how of {name!r} must be one of {', '.join(HOWS)}, got {asked!r}")
    if max_gap is not None:
        max_gap = as_number("max_gap", max_gap, 0, above=True, of="of seconds")
    streams = [_streams(i, interaction, layout) for i, interaction in enumerate(interactions)]
    steps = {name: _usual([of[name] for of in streams if name in of]) for name in layout.names}
    if rate is None:
        rate = _fastest(steps)
    rate = as_number("rate", rate, 0, above=True, of="of samples a second")
    spans = _spans(streams, layout, span)
    single = all(_single(interaction) for interaction in interactions)
    trajectories = []
    for i, (of, (start, end)) in enumerate(zip(streams, spans, strict=True)):
        count = math.floor((end - start) * rate + 1e-3) + 1
        if not 2 <= count <= MOST_SAMPLES:
            raise ValueError(
                f"interaction {i}: {end - start:.6g} s at {rate:g} Hz are {count} samples, expected at least 2 and "
                f"at most {MOST_SAMPLES}"
            )
        grid = start + np.arange(count) / rate
        found = np.full((count, layout.n_dofs), np.nan)
        for name, stream in of.items():
            gap = max_gap if max_gap is not None else USUAL_STEPS * (steps[name] or math.inf)
            found[:, layout.slice(name)] = onto_grid(stream.times, stream.values, grid, gap, hows[name])
        trajectories.append(found.astype(np.float32) if single else found)
    return Gridded(trajectories, rate, _remarks(streams, layout, steps))


def _streams(number: int, interaction: Interaction, layout: Layout) -> dict[str, Ordered]:
    """The streams of one interaction, checked and in order."""
    found = {}
    unknown = [name for name in interaction if name not in layout.names]
    if unknown:
        raise ValueError(
            f"interaction {number}: no modality {unknown[0]!r}; this layout has {', '.join(layout.names)}"
        )
    for name, stream in interaction.items():
        where = f"interaction {number}, {name}"
        try:
            given_times, given_values = stream
            times, values = np.asarray(given_times, np.float64), np.asarray(given_values, np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{where}: expected (times [T] in seconds, values [T, d]): {error}") from error
        d = len(layout[name].dofs)
        if values.ndim == 1 and d == 1:
            values = values[:, None]
        if times.ndim != 1 or values.shape != (len(times), d):
            raise ValueError(f"{where}: times {times.shape} and values {values.shape}, expected [T] and [T, {d}]")
        if not len(times):
            continue
        if not np.isfinite(times).all():
            raise ValueError(
                f"{where}: {int((~np.isfinite(times)).sum())} of {len(times)} stamps are NaN or infinite"
            )
        if np.isinf(values).any():
            raise ValueError(f"{where}: infinite values; mark what was not measured as NaN")
        sorted_out = ordered(times, values)
        for count, what in ((sorted_out.backward, "run backwards"), (sorted_out.repeated, "repeat")):
            if count > max(1, MOST_BAD * len(times)):
                raise ValueError(f"{where}: {count} of {len(times)} stamps {what}: these are no times")
        found[name] = sorted_out
    if not found:
        raise ValueError(f"interaction {number}: no samples at all")
    return found


def _usual(streams: Sequence[Ordered]) -> float | None:
    """The usual step of a sensor, s: the mean of those near their median, whose jitter cancels and which no gap
    makes longer; None where it has none."""
    found = [np.diff(stream.times) for stream in streams if len(stream.times) > 1]
    if not found:
        return None
    steps = np.concatenate(found)
    middle = np.median(steps)
    return float(steps[np.abs(steps - middle) <= middle / 2].mean())


def _fastest(steps: Mapping[str, float | None]) -> float:
    known = [step for step in steps.values() if step is not None]
    if not known:
        raise ValueError("no sensor has two samples, so nothing says a rate; give one")
    rate = 1 / min(known)
    return round(rate) if rate >= 1 and abs(rate / round(rate) - 1) < WHOLE else rate


def _spans(
    streams: Sequence[Mapping[str, Ordered]], layout: Layout, span: str | Sequence[tuple[float, float]] | None
) -> list[tuple[float, float]]:
    """Start and end of each interaction, s."""
    if span is not None and not isinstance(span, str):
        if len(span) != len(streams):
            raise ValueError(f"{len(span)} spans, expected {len(streams)}, one an interaction")
        spans = [(float(start), float(end)) for start, end, *_ in span]
        for i, (start, end) in enumerate(spans):
            if not (math.isfinite(start) and math.isfinite(end) and start < end):
                raise ValueError(f"interaction {i}: a span must be start < end in seconds, got {start}, {end}")
        return spans
    if span is not None:
        layout.slice(span)
    found = []
    for i, of in enumerate(streams):
        if span is not None and span not in of:
            raise ValueError(f"interaction {i}: {span!r}, whose span it shall be, has no samples")
        those = {name: stream for name, stream in of.items() if span in (None, name)}
        start = max(float(stream.times[0]) for stream in those.values())
        end = min(float(stream.times[-1]) for stream in those.values())
        if start >= end:
            covers = ", ".join(f"{name} {s.times[0]:.6g} to {s.times[-1]:.6g} s" for name, s in those.items())
            raise ValueError(
                f"interaction {i}: its sensors have no time in common: {covers}. Do their clocks agree? "
                "`span` may name one of them, or give times"
            )
        found.append((start, end))
    return found


def _remarks(
    streams: Sequence[Mapping[str, Ordered]], layout: Layout, steps: Mapping[str, float | None]
) -> tuple[str, ...]:
    """What was wrong, by modality."""
    counts: Counter[tuple[str, str]] = Counter()
    totals: Counter[str] = Counter()
    for of in streams:
        for name in layout.names:
            if name not in of:
                counts[name, "absent"] += 1
                continue
            totals[name] += len(of[name].times) + of[name].repeated
            counts[name, "backward"] += of[name].backward
            counts[name, "repeated"] += of[name].repeated
            first = min(stream.times[0] for stream in of.values())
            counts[name, "late"] += bool(of[name].times[0] - first > max(1.0, 10 * (steps[name] or 0.0)))
    said = {
        "backward": "{} of {} stamps ran backwards; the samples were put in order",
        "repeated": "{} of {} stamps were those of another sample; the first of each was kept",
        "absent": "nothing of it in {} of {} interactions",
        "late": "in {} of {} interactions it begins more than a second after another sensor: is its clock right?",
    }
    return tuple(
        f"{name}: "
        + text.format(counts[name, what], totals[name] if what in ("backward", "repeated") else len(streams))
        for name in layout.names
        for what, text in said.items()
        if counts[name, what]
    )


def _single(interaction: Interaction) -> bool:
    """Whether all values came in single precision."""
    return all(str(getattr(values, "dtype", "")).endswith("float32") for _, values in interaction.values())
