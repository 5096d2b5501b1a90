"""A pause as a film: what sensors say, where bank and members believe the person to be, and what is forecast."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import torch
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure
from torch import Tensor

from experiments.figures import plain
from torch_ebip import Demonstrations, InteractionModel
from torch_ebip.common.ambient import owned
from torch_ebip.common.draws import seeded
from torch_ebip.filtering.states import EnsembleState
from torch_ebip.learning.interruptions import Interrupted, pause

FRAMES = 50
SECONDS = 8.0
"""Of the film."""


class Story(NamedTuple):
    """What happened, sample by sample; arrays over T.

    Attributes:
        time: [T], s.
        seen: [T], what one sensor said, unit of the DoF.
        truth: [T], true phase.
        phases: [T, E], of the members.
        bank: [T, P], probability of each phase.
        standing: [T], probability that the person stands still.
        mean, deviation: [T], forecast of the end of one DoF, its unit.
        end: what it was.
    """

    time: np.ndarray
    seen: np.ndarray
    truth: np.ndarray
    phases: np.ndarray
    bank: np.ndarray
    standing: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    end: float


@torch.no_grad()
def tell(model: InteractionModel, recording: Tensor, seconds: float, seed: int) -> tuple[Story, str, str]:
    """A recording [T, D] with a pause of so many seconds near its middle; and which DoFs are shown.

    The model must have a bank.
    """
    filter, layout = model.filter, model.layout
    noise = model.primitive.residual_variance.sqrt()
    made: Interrupted = pause(seconds, seconds, (0.4, 0.5))(recording, model.rate, noise.to(recording), seeded(seed))
    shown = ~layout.controlled
    sensor, target = int(shown.nonzero()[0]), int(layout.controlled.nonzero()[0])
    generator = seeded(seed)
    state = filter.initial_state(generator=generator)
    rows = []
    for t, row in enumerate(made.values.to(model.primitive.weights)):
        state = filter.predict(state, filter.dt, generator) if t else state
        state, _ = filter.update(state, torch.where(shown, row, torch.nan), generator=generator)
        assert isinstance(state, EnsembleState)
        share = state.memory.pace.share.sum(-2)
        P = len(share) // 2
        end = filter.forecast(state, ahead=[torch.inf])
        rows.append((
            owned(state.deviations[:, 0]), share[:P] + share[P:], share[P:].sum(),
            end.mean[0, target], end.variance[0, target].sqrt(),
        ))  # fmt: skip
    phases, bank, standing, mean, deviation = (torch.stack(part).numpy() for part in zip(*rows, strict=True))
    last = len(recording) - 1
    story = Story(
        np.arange(len(rows)) / model.rate, made.values[:, sensor].numpy(), made.source.numpy() / last, phases, bank,
        standing, mean, deviation, float(recording[-1, target]),
    )  # fmt: skip
    units = [next(m.unit for m in layout.modalities if layout.dofs[d] in m.dofs) for d in (sensor, target)]
    return story, f"{layout.dofs[sensor]} [{units[0]}]", f"{layout.dofs[target]} [{units[1]}]"


def film(model: InteractionModel, tests: Demonstrations, path: Path, seconds: float = 1.5, seed: int = 0) -> None:
    """Write a film (GIF) of the first of some test recordings, paused for so many seconds, to a path."""
    story, sensor, target = tell(model, tests[0], seconds, seed)
    figure = Figure(figsize=(8, 8), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=[1, 2, 1])
    extent = (story.time[0], story.time[-1], 0, 1)
    stop = np.linspace(2, len(story.time), FRAMES).astype(int)
    colours = matplotlib.colormaps["viridis"]

    def draw(frame: int) -> list[object]:
        """What is known at a frame."""
        n = stop[frame]
        time = story.time[:n]
        for axis in axes:
            axis.clear()
            axis.spines[["top", "right"]].set_visible(False)
        axes[0].plot(time, story.seen[:n], color="black", linewidth=1)
        axes[0].set_ylabel(plain(sensor))
        axes[0].set_title(
            "a person pauses: what a sensor says, where they are, what is expected of the end", fontsize=10
        )
        known = np.where(np.arange(len(story.time))[:, None] < n, story.bank, np.nan)
        axes[1].imshow(known.T, origin="lower", aspect="auto", extent=extent, cmap="Greys", vmin=0, vmax=0.5)
        axes[1].plot(time, story.phases[:n, ::8], color=colours(0.3), linewidth=0.4, alpha=0.5)
        axes[1].plot(time, story.phases[:n].mean(1), color=colours(0.3), linewidth=1.5, label="members, their mean")
        axes[1].plot(time, story.truth[:n], color="C3", linewidth=1, linestyle="--", label="true")
        axes[1].plot(time, story.standing[:n], color="C1", linewidth=1, label="probability of standing still")
        axes[1].set_ylabel("phase [1]; grey: the bank")
        axes[1].set_ylim(0, 1)
        axes[1].legend(loc="upper left", fontsize=8)
        low, high = story.mean[:n] - 2 * story.deviation[:n], story.mean[:n] + 2 * story.deviation[:n]
        axes[2].fill_between(time, low, high, color=colours(0.3), alpha=0.3, linewidth=0)
        axes[2].plot(time, story.mean[:n], color=colours(0.3), label="forecast of the end, 2 deviations")
        axes[2].axhline(story.end, color="C3", linewidth=1, linestyle="--", label="true")
        middle, wide = np.median(story.mean), 4 * np.median(story.deviation) + abs(story.end - np.median(story.mean))
        axes[2].set_ylim(middle - wide, middle + wide)
        axes[2].set_xlim(story.time[0], story.time[-1])
        axes[2].set_ylabel(plain(target))
        axes[2].set_xlabel("time [s]")
        axes[2].legend(loc="upper right", fontsize=8)
        return []

    animation = FuncAnimation(figure, draw, frames=FRAMES, interval=1000 * SECONDS / FRAMES)  # type: ignore[arg-type]
    animation.save(path, PillowWriter(fps=round(FRAMES / SECONDS)), dpi=70)
