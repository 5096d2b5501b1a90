"""Load: threads that push a thousand samples a second each, while a robot asks for forecasts sixty times a second.

Each push is timed beside one into a bare queue, by the same thread at the same moment; interactions follow each
other, with `restart` between them. Forecasts are timed from the moment they are due until they are there.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from experiments import figures  # chooses a backend without a screen
from experiments.command_line import add_run_options, command, experiment_parser
from experiments.data import load
from experiments.folds import split
from experiments.load.feeding import Feeder, alone
from experiments.run_folder import RunFolder, save_figure
from experiments.soak.subjects import START
from experiments.soak.watch import resident
from torch_ebip import BSplineBasis, Demonstrations, InteractionPrimitive, InteractionSession, StackedBasis, ebip

MEMBERS = 80
POLLS = 60.0
"""Forecasts a second."""
SHARES = (50.0, 99.0, 99.9, 100.0)
"""Percentiles in the table."""


def under_load(
    session: InteractionSession, shown: Demonstrations, names: list[str], options: argparse.Namespace
) -> dict[str, Any]:
    """Push and ask for as long as was asked for."""
    began = [(time.monotonic(), 0)]
    sensors = [names[i % len(names)] for i in range(options.threads)]
    feeders = [Feeder(session, name, shown, options.rate, options.seconds, began) for name in sensors]
    for feeder in feeders:
        feeder.start()
    took, memory, late, refused, interactions, finished = [], [], 0, 0, 0, 0
    start = due = time.monotonic()
    with tqdm(total=round(options.seconds), unit="s", dynamic_ncols=True, mininterval=1) as bar:
        while due - start < options.seconds:
            due += 1 / POLLS
            time.sleep(max(due - time.monotonic(), 0.0))
            told = session.forecast(0.1, time.monotonic())
            took.append(time.monotonic() - due)
            for feeder in feeders:  # nothing piles up there either
                for _ in range(feeder.queue.qsize()):
                    feeder.queue.get_nowait()
            moment, which = began[0]
            if due - moment > len(shown[which]) / shown.rate + 0.2:
                report = session.report()
                late += sum(of.late for of in report.values())
                refused += sum(of.early + of.malformed for of in report.values())
                interactions, finished = interactions + 1, finished + told.finished
                session.restart()
                began[0] = (time.monotonic(), (which + 1) % len(shown))
                memory.append((due - start, resident()))
                bar.update(int(due - start) - bar.n)
                bar.set_postfix_str(f"forecast p99 {1e3 * float(np.percentile(took, 99)):.1f} ms")
    for feeder in feeders:
        feeder.stop.set()
    for feeder in feeders:
        feeder.join()
    push, bare = (np.concatenate([getattr(of, kind) for of in feeders]) for kind in ("push", "bare"))
    return {
        "push": push[np.isfinite(push)], "bare": bare[np.isfinite(bare)], "forecast": np.array(took),
        "memory": memory,
        "late": late, "refused": refused, "interactions": interactions, "finished": finished,
    }  # fmt: skip


def figure(measured: Mapping[str, Any]) -> Figure:
    """How long things take, and memory."""
    made, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for name in LABELS:
        values = np.sort(measured[name])
        beyond = 1 - np.arange(len(values)) / len(values)
        left.loglog(1e3 * values.clip(1e-7), beyond, lw=1.3, label=LABELS[name])
    left.axvline(1e3 / POLLS, c="0.5", ls=":", lw=1)
    left.set_xlabel(f"time [ms]; dotted: {POLLS:g} Hz")
    left.set_ylabel("share that takes longer")
    made.legend(loc="outside lower center", ncols=4, fontsize=8)
    right.plot(*zip(*measured["memory"], strict=True), lw=1.3, c=figures.colour("ebip_tuned"))
    right.set_xlabel("time [s]")
    right.set_ylabel("resident memory [MiB]")
    for axis in (left, right):
        axis.grid(alpha=0.3)
    return made


LATE = 0.2
"""Seconds that one of the sensors is late, in one of the measurements."""
LABELS = {
    "bare": "SimpleQueue.put",
    "push": "session.push",
    "alone": "forecast, nothing else going on",
    "behind": "the same, a sensor 200 ms late",
    "forecast": "forecast under load, from when it is due",
}


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    torch.set_num_threads(1)
    if options.quick:
        options.seconds = min(options.seconds, 20.0)
    demonstrations, _ = load(options.data, 100, options.seed)
    layout = demonstrations.layout
    names = [modality.name for modality in layout.modalities if not modality.controlled]
    settings = {key: getattr(options, key) for key in ("data", "seconds", "threads", "rate", "seed")}
    run = RunFolder("load", settings, options.out, options.force, arguments)
    training, testing = split(len(demonstrations), 1, 0, options.seed)
    primitive = InteractionPrimitive.fit(
        demonstrations.subset(training[:MEMBERS]), StackedBasis([BSplineBasis(8)] * layout.n_dofs)
    )
    shown = demonstrations.subset(testing)
    filter = ebip(
        primitive, residual_variance=START.factor * primitive.residual_variance, square_root=True, weigh=True
    )
    with InteractionSession(filter, primitive) as session:
        measured: dict[str, Any] = {"alone": alone(session, shown, names, 1200, POLLS)}
    with InteractionSession(filter, primitive) as session:
        measured["behind"] = alone(session, shown, names, 1200, POLLS, round(LATE * POLLS))
    with InteractionSession(filter, primitive) as session:
        measured |= under_load(session, shown, names, options)
    times = {
        name: dict(zip(map(str, SHARES), np.percentile(measured[name], SHARES).tolist(), strict=True))
        for name in LABELS
    }
    results = {
        "experiment": "load", "members": len(primitive), "sensors": names, "threads": options.threads,
        "pushed": len(measured["push"]), "asked": len(measured["forecast"]), "times": times,
        "out_of_time": int((measured["forecast"] > 1 / POLLS).sum()),
        **{key: measured[key] for key in ("late", "refused", "interactions", "finished", "memory")},
    }  # fmt: skip
    save_figure(figure(measured), Path(run.path) / "load.png")
    run.finish(results)
    _print(results)
    print(f"written to {run.path}")


def _print(results: Mapping[str, Any]) -> None:
    sizes = f"{results['threads']} threads, {results['pushed']:,} pushes, {results['asked']:,} forecasts"
    table = Table(title=f"{sizes}, E = {results['members']}", title_justify="left")
    table.add_column("time [ms]")
    for share in SHARES:
        table.add_column("most" if share == 100 else f"p{share:g}", justify="right")
    for name, label in LABELS.items():
        table.add_row(label, *(f"{1e3 * value:.3f}" for value in results["times"][name].values()))
    Console().print(table)
    push, bare = (results["times"][name]["99.9"] for name in ("push", "bare"))
    memory = [size for _, size in results["memory"]]
    print(f"push p99.9 over that of a bare queue: {push / bare:.2f}")
    print(f"forecasts that came after the next was due: {results['out_of_time']} of {results['asked']}")
    print(f"samples late {results['late']}, refused {results['refused']}")
    print(f"interactions {results['interactions']}, of which the last forecast said finished: {results['finished']}")
    if len(memory) > 1:
        print(
            f"memory {memory[-1]:.0f} MiB, grown by {memory[-1] - memory[len(memory) // 10]:+.1f} MiB since a tenth"
        )


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("load", __doc__)
    parser.add_argument("--data", metavar="FILE.npz", help="recordings in the project's format (default: simulated)")
    parser.add_argument("--seconds", type=float, default=600.0, help="how long (default: 600)")
    parser.add_argument("--threads", type=int, default=8, help="that push (default: 8)")
    parser.add_argument("--rate", type=float, default=1000.0, help="samples a second of each (default: 1000)")
    add_run_options(parser, "load", "data, split and draws", "20 seconds")
    return parser


if __name__ == "__main__":
    main()
