"""Recordings that are there twice: whoever is left out is then known, and scores say nothing of new ones."""

from __future__ import annotations

from collections.abc import Iterable

from torch import Tensor


def copies(demonstrations: Iterable[Tensor]) -> list[tuple[int, ...]]:
    """Which recordings have the same values, number by number, increasing; nothing of those that are there once.

    Args:
        demonstrations: any, or trajectories [T_i, D].

    Example:
        >>> from torch_ebip.recordings import example
        >>> from torch_ebip.recordings.copies import copies
        >>> copies(example().subset([0, 1, 0, 2]))
        [(0, 2)]
    """
    alike: dict[tuple[tuple[int, ...], bytes], list[int]] = {}
    for i, trajectory in enumerate(demonstrations):
        values = trajectory.detach().cpu().contiguous()
        alike.setdefault((tuple(values.shape), values.numpy().tobytes()), []).append(i)
    return [tuple(each) for each in alike.values() if len(each) > 1]
