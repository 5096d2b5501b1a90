"""One long recording cut into interactions: by labels, or by when somebody moves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from torch_ebip.common.arguments import as_number
from torch_ebip.recordings.streams import Interaction


class Span(NamedTuple):
    """A part of a recording, s, and what it shows."""

    start: float
    end: float
    label: str = ""


def cut(streams: Interaction, spans: Sequence[Sequence[Any]]) -> list[Interaction]:
    """The interactions of a long recording.

    Args:
        streams: {modality: (times [T] in s, values [T, d])}.
        spans: (start, end), s, each, or `Span`; the same go to `Demonstrations.from_streams` as ``span``.

    Raises:
        ValueError: a span that ends before it begins.

    Example:
        >>> hand = (np.arange(10.0), np.arange(10.0)[:, None])
        >>> [part["hand"][0].tolist() for part in cut({"hand": hand}, [(1, 3), (6.5, 8)])]
        [[1.0, 2.0, 3.0], [7.0, 8.0]]
    """
    found: list[Interaction] = []
    for start, end, *_ in spans:
        if not start < end:
            raise ValueError(f"a span must be start < end in seconds, got {start}, {end}")
        parts = {}
        for name, (times, values) in streams.items():
            when = np.asarray(times, dtype=np.float64)
            inside = (when >= start) & (when <= end)
            parts[name] = when[inside], np.asarray(values)[inside]
        found.append(parts)
    return found


def spans_of_labels(times: Any, labels: Sequence[str]) -> list[Span]:
    """Where the same label goes on; where it is empty nothing is.

    Args:
        times: [T], s, increasing.
        labels: T names.

    Example:
        >>> spans_of_labels([0.0, 1.0, 2.0, 3.0, 4.0], ["", "wave", "wave", "", "reach"])
        [Span(start=1.0, end=2.0, label='wave'), Span(start=4.0, end=4.0, label='reach')]
    """
    if len(times) != len(labels):
        raise ValueError(f"{len(times)} times and {len(labels)} labels, expected as many")
    found: list[Span] = []
    before = ""
    for time, label in zip(np.asarray(times, dtype=np.float64).tolist(), labels, strict=True):
        if label and label == before:
            found[-1] = found[-1]._replace(end=time)
        elif label:
            found.append(Span(time, time, label))
        before = label
    return found


def spans_of_movement(times: Any, values: Any, speed: float, pause: float = 0.5, least: float = 0.5) -> list[Span]:
    """Where somebody moves, between times of stillness.

    Args:
        times: [T], s, increasing.
        values: [T, d], such as a hand's position.
        speed: in units of the values per s, mean over a tenth of a second: slower is still.
        pause: s, of stillness that ends a movement.
        least: s, that a movement lasts at least.

    Raises:
        ValueError: numbers that are not positive; times and values that do not go together.

    Example:
        >>> t = np.arange(0, 6, 0.02)
        >>> x = np.clip(t - 1, 0, 1) + np.clip(t - 4, 0, 1)  # moves from 1 to 2 s and from 4 to 5 s
        >>> [(round(s.start, 1), round(s.end, 1)) for s in spans_of_movement(t, x[:, None], speed=0.5)]
        [(1.0, 2.0), (4.0, 5.0)]
    """
    speed = as_number("speed", speed, 0, above=True)
    pause, least = as_number("pause", pause, 0, above=True), as_number("least", least, 0, above=True)
    when, path = np.asarray(times, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if when.ndim != 1 or path.ndim != 2 or len(path) != len(when) or len(when) < 2:
        raise ValueError(f"times {when.shape} and values {path.shape}, expected [T >= 2] and [T, d]")
    said = ~np.isnan(path).any(-1)
    when, path = when[said], path[said]
    # How far in the tenth of a second around each sample.
    before, after = np.searchsorted(when, when - 0.05), np.searchsorted(when, when + 0.05, side="right") - 1
    gone = np.linalg.norm(path[after] - path[before], axis=-1)
    moves = when[gone > speed * np.maximum(when[after] - when[before], 1e-9)]
    if not len(moves):
        return []
    breaks = np.flatnonzero(np.diff(moves) > pause)
    starts, ends = moves[np.r_[0, breaks + 1]], moves[np.r_[breaks, len(moves) - 1]]
    return [Span(float(a), float(b)) for a, b in zip(starts, ends, strict=True) if b - a >= least]
