"""Members that stay in the span of where they started, stored so that an update touches little."""

from __future__ import annotations

import torch
from torch import Tensor


class ColumnMembers:
    """E members as columns: what moves, what stands still and sensors see, and a stand-in for the rest.

    Updates that mix whole members add combinations of members to members, the same for every entry that stands still
    otherwise: X <- T X. So entries that no sensor sees need not follow each of them. If they are more than E, the
    transform itself is kept, which is updated as if it were E more entries of the state (it starts as the identity),
    and they are T times where they started, whenever somebody asks.

    Args:
        start: initial members, [..., E, n].
        seen: int64 [k], ascending, the entries that stand still and that measurements depend on, counted from the
            first that stands still.
        moving: m, how many leading entries move.
        first: as they started, [..., E, n], for `renew`; default: nobody knows.

    Attributes:
        matrix: [..., m + k + min(E, rest), E]; to be changed in place, and never replaced: others hold views of it.
    """

    def __init__(self, start: Tensor, seen: Tensor, moving: int, first: Tensor | None = None) -> None:
        E, n = start.shape[-2:]
        self._moving = moving
        hidden = torch.ones(n - moving, dtype=torch.bool, device=start.device)
        hidden[seen] = False
        rest = hidden.nonzero().squeeze(-1)
        self._start, self._seen_count = start, len(seen)
        # A transform of where they are now leads to where they started only if that is the same.
        self._transformed = len(rest) > E and (first is None or torch.equal(start[..., moving:], first[..., moving:]))
        # Where each weight is in the matrix; those behind the transform are counted from the end of the seen ones.
        self._place = torch.empty(n - moving, dtype=torch.long, device=start.device)
        self._place[seen] = torch.arange(len(seen), device=start.device)
        self._place[rest] = len(seen) + torch.arange(len(rest), device=start.device)
        last = start[..., moving + rest]
        if self._transformed:
            last = torch.eye(E, dtype=start.dtype, device=start.device).expand(*start.shape[:-2], E, E)
        leading = start[..., torch.cat([torch.arange(moving, device=start.device), moving + seen])]
        self.matrix = torch.cat([leading, last], dim=-1).transpose(-1, -2).contiguous()
        self._still: Tensor | None = None
        self._first = first
        self._order = torch.cat([seen, rest])

    @property
    def moving(self) -> Tensor:
        """What moves, [..., m, E]: a view."""
        return self.matrix[..., : self._moving, :]

    def seen(self, part: slice) -> Tensor:
        """A slice of what stands still and sensors see, [..., k, E]: a view."""
        return self.matrix[..., self._moving + part.start : self._moving + part.stop, :]

    def renew(self, share: Tensor) -> None:
        """Of what stands still a share [...] becomes what it was at first."""
        m, still = self._moving, self._still
        if self._first is None:
            return
        if still is None:
            still = self._first[..., m + self._order].transpose(-1, -2)
            if self._transformed:
                one = torch.eye(still.shape[-1], dtype=still.dtype, device=still.device)
                seen = still[..., : self._seen_count, :]
                still = torch.cat([seen, one.expand(*still.shape[:-2], -1, -1)], -2)
            self._still = still
        self.matrix[..., m:, :].lerp_(still, share[..., None, None])

    def members(self, columns: Tensor, entry: int | None = None) -> Tensor:
        """What moves and some of what stands still, int64 [k], up to date: [..., E, m + k], a copy.

        With ``entry`` those of one entry of the batch only, without that dimension.
        """
        matrix, start, m = self.matrix, self._start, self._moving
        if entry is not None:
            matrix, start = matrix[entry], start[entry]
        place = self._place[columns]
        found = matrix.new_empty(*matrix.shape[:-2], matrix.shape[-1], m + len(columns))
        found[..., :m] = matrix[..., :m, :].transpose(-1, -2)
        if not self._transformed:
            found[..., m:] = matrix[..., m + place, :].transpose(-1, -2)
            return found
        behind = place >= self._seen_count
        found[..., m:][..., ~behind] = matrix[..., m + place[~behind], :].transpose(-1, -2)
        transform = matrix[..., m + self._seen_count :, :].transpose(-1, -2)
        found[..., m:][..., behind] = transform @ start[..., m + columns[behind]]
        return found
