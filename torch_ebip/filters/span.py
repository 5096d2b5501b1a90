"""Members that stay in the span of where they started, stored so that an update touches little."""

from __future__ import annotations

import torch
from torch import Tensor


class SpanMembers:
    """E members as columns: phase, phase velocity, the weights that sensors see, and a stand-in for the rest.

    Updates without localisation, and dynamics without noise on the weights, add combinations of members to
    members, the same for every weight: X <- T X. So weights that no sensor sees need not follow each of them. If
    they are more than E, the transform itself is kept, which is updated as if it were E more entries of the state
    (it starts as the identity), and they are T times where they started, whenever somebody asks.

    Args:
        start: initial members, [..., E, n].
        seen: int64 [k], ascending, the entries of the state from 2 on that measurements depend on, counted from 2.

    Attributes:
        matrix: [..., 2 + k + min(E, rest), E]; to be changed in place.
    """

    def __init__(self, start: Tensor, seen: Tensor) -> None:
        E, n = start.shape[-2:]
        hidden = torch.ones(n - 2, dtype=torch.bool, device=start.device)
        hidden[seen] = False
        rest = hidden.nonzero().squeeze(-1)
        self._start, self._seen_count = start, len(seen)
        self._transformed = len(rest) > E
        # Where each weight is in the matrix; those behind the transform are counted from the end of the seen ones.
        self._place = torch.empty(n - 2, dtype=torch.long, device=start.device)
        self._place[seen] = torch.arange(len(seen), device=start.device)
        self._place[rest] = len(seen) + torch.arange(len(rest), device=start.device)
        last = start[..., 2 + rest]
        if self._transformed:
            last = torch.eye(E, dtype=start.dtype, device=start.device).expand(*start.shape[:-2], E, E)
        first = start[..., torch.cat([torch.arange(2, device=start.device), 2 + seen])]
        self.matrix = torch.cat([first, last], dim=-1).transpose(-1, -2).contiguous()

    def seen(self, part: slice) -> Tensor:
        """A slice of the weights that sensors see, [..., m, E]: a view."""
        return self.matrix[..., 2 + part.start : 2 + part.stop, :]

    def members(self, columns: Tensor, entry: int | None = None) -> Tensor:
        """Phase, phase velocity and some weights, int64 [m], up to date: [..., E, 2 + m], a copy.

        With ``entry`` those of one entry of the batch only, without that dimension.
        """
        matrix, start = self.matrix, self._start
        if entry is not None:
            matrix, start = matrix[entry], start[entry]
        place = self._place[columns]
        found = matrix.new_empty(*matrix.shape[:-2], matrix.shape[-1], 2 + len(columns))
        found[..., :2] = matrix[..., :2, :].transpose(-1, -2)
        if not self._transformed:
            found[..., 2:] = matrix[..., 2 + place, :].transpose(-1, -2)
            return found
        behind = place >= self._seen_count
        found[..., 2:][..., ~behind] = matrix[..., 2 + place[~behind], :].transpose(-1, -2)
        transform = matrix[..., 2 + self._seen_count :, :].transpose(-1, -2)
        found[..., 2:][..., behind] = transform @ start[..., 2 + columns[behind]]
        return found
