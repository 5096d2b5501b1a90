"""A recorded session, lived through again."""

from __future__ import annotations

import os
from dataclasses import fields
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.live.forecast import SessionForecast
from torch_ebip.live.log import fingerprint, read_log
from torch_ebip.live.session import InteractionSession
from torch_ebip.live.settings import SessionSettings

NEWER = {"delays", "correct_clocks"}
"""Settings that recordings of the first format do not know."""
MOST_TICKS = 2000
"""Of a window, and of a gap."""
MOST_MEMORY = 1 << 28
"""Bytes of the states that a window keeps, one a tick."""
TICKS_A_LINE = 100
"""To be filtered, on the average, beside `MOST_TICKS` at the start: late samples have their window filtered again."""
MOST_HORIZONS = 10_000
"""Of one forecast."""


class Replay(NamedTuple):
    """A session as it was at the end of its recording.

    Attributes:
        session: to be asked further.
        forecasts: all that were asked for, computed again.
        recorded: their means as they were recorded, [P, D_c] each, in the dtype of the filter.
    """

    session: InteractionSession
    forecasts: list[SessionForecast]
    recorded: list[Tensor]

    def __repr__(self) -> str:
        return brief(self)

    @property
    def identical(self) -> bool:
        """Whether every forecast is the recorded one to the bit."""
        pairs = zip(self.forecasts, self.recorded, strict=True)
        return all(torch.equal(again.mean.cpu().view(-1, len(again.dofs)), then) for again, then in pairs)


def replay(path: str | os.PathLike[str], filter: InteractionFilter, primitive: InteractionPrimitive) -> Replay:
    """Live through a recording again; on the same machine and software to the bit.

    Args:
        path: what `InteractionSession` wrote under ``record``.
        filter, primitive: those of the session.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no recording, is damaged, or is one of another filter or primitive.
    """
    header, entries = read_log(path)
    for name, module in (("filter", filter), ("primitive", primitive)):
        if header.get(name) != fingerprint(module):
            raise ValueError(f"{path}: recorded with another {name} than this one")
    try:
        known = {field.name for field in fields(SessionSettings)}
        known -= NEWER if header["format"] == 1 else set()
        if set(header["settings"]) != known:
            raise ValueError(f"expected {', '.join(sorted(known))}, got {str(header['settings'])[:200]}")
        settings = SessionSettings(**header["settings"])
        if max(settings.window, settings.longest_gap) > MOST_TICKS * filter.dt:
            raise ValueError(f"a window or a gap of more than {MOST_TICKS} ticks")
        state = filter.initial_state(generator=torch.Generator("cpu").manual_seed(0))
        size = state[0].numel() * state[0].element_size() * settings.window / filter.dt
        if size > MOST_MEMORY:
            raise ValueError(f"a window whose states take {size:.0f} bytes, expected at most {MOST_MEMORY}")
        session = InteractionSession(filter, primitive, header["sensors"], settings)
    except (KeyError, TypeError, ValueError, OverflowError, RuntimeError, MemoryError) as error:
        raise ValueError(f"{path}: the settings of the session are damaged: {error}") from error
    forecasts, recorded = [], []
    for line, entry in enumerate(entries, 2):
        try:
            if session.ticks_filtered > MOST_TICKS + TICKS_A_LINE * line:
                raise ValueError(f"{session.ticks_filtered} ticks to filter already, for {line} lines")
            if entry[0] == "push":
                session.push(entry[1], entry[3], entry[2])
            elif entry[0] == "advance":
                session.advance(entry[1])
            elif entry[0] == "restart":
                session.restart(entry[1])
            else:
                if isinstance(entry[2], list) and len(entry[2]) > MOST_HORIZONS:
                    raise ValueError(f"more than {MOST_HORIZONS} horizons")
                forecasts.append(session.forecast(entry[2], entry[1]))
                recorded.append(torch.tensor(entry[3], dtype=next(filter.parameters()).dtype, device="cpu"))
        except (TypeError, ValueError, OverflowError, RuntimeError, MemoryError) as error:
            raise ValueError(f"{path}: damaged: {str(entry)[:80]}: {error}") from error
    return Replay(session, forecasts, recorded)
