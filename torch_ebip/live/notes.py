"""What is wrong with time in a session, in sentences."""

from __future__ import annotations

from collections.abc import Sequence

from torch_ebip.live.clocks import Clocks, SensorClock
from torch_ebip.live.report import SensorReport
from torch_ebip.live.settings import SessionSettings
from torch_ebip.live.track import REPEATS

ENOUGH = 20
"""Samples of which at least half were too late, before a window is called too short."""


def notes(
    names: Sequence[str],
    clocks: Clocks,
    reports: Sequence[SensorReport],
    settings: SessionSettings,
    dt: float,
    began: float,
    turned_back: float,
    over: float | None,
) -> tuple[str, ...]:
    """One sentence for each thing; empty if all is well.

    Args:
        names: of the sensors, M of them.
        clocks, reports: of the sensors.
        settings: of the session.
        dt: seconds between ticks.
        began: how long after its start an interaction whose start was given sent its first sample, s.
        turned_back: by how much ``now`` was before what it had been, s.
        over: when the interaction ended, s; None if it goes on.
    """
    said = []
    for name, clock, report in zip(names, clocks.sensors, reports, strict=True):
        if clock.jumps:
            said.append(_jump(name, clock, clocks.corrected))
        late = clock.lateness
        if report.late >= ENOUGH and report.late > report.accepted:
            said.append(
                f"{name}: {report.late} samples came later than the window of {settings.window:g} s and were not used"
                + (f"; they come {late:.2f} s late, so choose a longer window" if late > settings.window else "")
            )
        elif late > settings.settle + REPEATS * dt:
            waits = f"longer than settle, {settings.settle:g} s" if settings.settle else f"{round(late / dt)} ticks"
            said.append(f"{name}: its samples come {late:.2f} s late, {waits}")
    if began > settings.window:
        said.append(
            f"the first sample was taken {began:.2f} s after the start that was given: somebody waited, or "
            "stamps are late"
        )
    if turned_back > 0:
        said.append(f"now was {turned_back:.3f} s before what it had been; the present does not run backwards")
    if over is not None:
        said.append(f"the interaction ended at {over:.2f} s: what comes after needs `restart`, or a new session")
    return tuple(said)


def _jump(name: str, clock: SensorClock, corrected: bool) -> str:
    """How a clock jumped."""
    times = f"{clock.jumps} times, last" if clock.jumps > 1 else "once,"
    what = "taken out of its stamps" if corrected else "not corrected"
    gap = " (or nothing came for so long)" if clock.jump > 0 else ""
    return f"{name}: its clock jumped {times} by {clock.jump:+.2f} s at {clock.at:.2f} s{gap}; {what}"
