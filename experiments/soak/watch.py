"""Watching something run: its times, its memory and its health in windows of steps, and the verdict on them."""

from __future__ import annotations

import gc
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np

from experiments.soak.stream import Sample
from experiments.soak.subjects import Subject

GROWTH = 16.0
"""MiB by which memory may grow from the second tenth of a run to its last."""
SLOWING = 1.2
"""Factor by which a step, over its twin's, may take longer in the last tenth of a run than in the second."""
EVERY = 10
"""Steps from one timing of the twin to the next."""


class Window(NamedTuple):
    """Some steps in a row.

    Attributes:
        step: number of the last one.
        median, p99: seconds a step.
        reference: median seconds a step of a twin that was new at the beginning of the window and takes some of the
            same samples, in turns: what slows the machine slows both.
        memory: MiB resident at the end.
        finite, phase, spread, largest: see `Health`, at the end; not finite if a step raised an error.
        error: what a step said that could not be taken, or nothing.
    """

    step: int
    median: float
    p99: float
    reference: float
    memory: float
    finite: bool
    phase: float
    spread: float
    largest: float
    error: str = ""


def watch(
    make: Callable[[], Subject],
    samples: Iterator[Sample],
    steps: int,
    windows: int,
    report: Callable[[int], object] = lambda steps: None,
) -> Iterator[Window]:
    """Run something for some steps; ends early after an error.

    Args:
        make: what to run, and its twins.
        samples: without end.
        steps: how many.
        windows: how many of them, at most one a step.
        report: called with the steps done since it was called last.
    """
    subject = make()
    done = 0
    for edge in np.linspace(0, steps, min(windows, steps) + 1).round().astype(int)[1:].tolist():
        taken, compared = [], []
        error = ""
        twin = make()
        twin.begin()
        while done < edge and not error:
            sample = next(samples)
            if sample.first or not done:
                subject.begin()
            both = [(subject, taken)]
            if done % EVERY == 0:
                both.insert(done // EVERY % 2, (twin, compared))
            for one, times in both:
                began = time.perf_counter()
                try:
                    one.step(sample)
                except ValueError as problem:
                    error = str(problem)
                times.append(time.perf_counter() - began)
            done += 1
        health = subject.health()
        gc.collect()  # what only waits to be collected is no growth
        report(len(taken))
        yield Window(
            done,
            float(np.median(taken)),
            float(np.quantile(taken, 0.99)),
            float(np.median(compared)) if compared else float("nan"),
            resident(),
            health.finite and not error,
            health.phase,
            health.spread,
            health.largest,
            error,
        )
        if error:
            return


def verdict(windows: Sequence[Window]) -> list[str]:
    """What is wrong with a run; nothing if all is well."""
    wrong = []
    for window in windows:
        if window.error:
            wrong.append(f"step {window.step} could not be taken: {window.error}")
        elif not window.finite:
            wrong.append(f"NaN or infinite at step {window.step}")
        if wrong:
            break
    tenth = max(1, len(windows) // 10)
    if len(windows) <= tenth:
        return [*wrong, f"{len(windows)} windows are too few to compare"]
    early, late = windows[tenth : 2 * tenth], windows[-tenth:]  # the first tenth fills caches
    memory = [median(window.memory for window in part) for part in (early, late)]
    if memory[1] - memory[0] > GROWTH:
        wrong.append(f"memory grew from {memory[0]:.0f} to {memory[1]:.0f} MiB")
    slowing = relative_time(late) / relative_time(early)
    if not slowing <= SLOWING:
        wrong.append(f"a step takes {slowing:.2f} times as long at the end")
    return wrong


def relative_time(windows: Sequence[Window]) -> float:
    """Median time of a step over that of the twin's."""
    ratios = [window.median / window.reference for window in windows if window.reference == window.reference]
    return median(ratios) if ratios else float("nan")


def resident() -> float:
    """Memory of this process now, MiB; the most it ever was where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return pages * resource.getpagesize() / 2**20
