"""A soak: a million steps in float32, looked at in windows for NaN, growth of memory and growth of step time.

Live filters, filters step by step and sessions are shown held-out interactions one after the other, with random gaps,
sensors that fall silent for a second, and uneven times between samples. Ends with exit status 1 if anything is wrong.
One thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib.pyplot as plt
import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from experiments import figures  # chooses a backend without a screen
from experiments.command_line import add_run_options, command, experiment_parser
from experiments.data import load
from experiments.folds import split
from experiments.run_folder import RunFolder, save_figure
from experiments.soak.stream import Sample, stream
from experiments.soak.subjects import DEFAULT, SHARES, SUBJECTS, Subject
from experiments.soak.watch import Window, relative_time, verdict, watch
from torch_ebip import BSplineBasis, InteractionPrimitive, StackedBasis
from torch_ebip.common.files import read_json, write_json

WINDOWS = 100
LEAST = 100
"""Steps of a window, where there are fewer windows for it."""
MEMBERS = 80
SENSORS = ("head", "ball")
"""Two sensors of three DoFs each, of the simulated task: the step is then mostly that of the ensemble."""
LINES = {"closed_form": "ebip", "square_root": "ebip_scaled", "tuned": "ebip_tuned", "particle": "particle_filter"}


def soak(name: str, make: Callable[[], Subject], samples: Iterator[Sample], steps: int, path: Path) -> dict[str, Any]:
    """Run one of the subjects; what is known of it is written after each window, the verdict at the end."""
    record: dict[str, Any] = {"name": name, "asked": steps, "steps": 0, "seconds": 0.0, "windows": [], "wrong": None}
    windows: list[Window] = []
    began = time.monotonic()
    with tqdm(total=steps, desc=name, unit="step", dynamic_ncols=True, mininterval=1) as bar:
        for window in watch(make, samples, steps, min(WINDOWS, steps // LEAST), bar.update):
            windows.append(window)
            bar.set_postfix_str(f"{1e6 * window.median:.0f} us, {window.memory:.0f} MiB, spread {window.spread:.1e}")
            record |= {"steps": window.step, "seconds": round(time.monotonic() - began, 1)}
            record["windows"] = [window._asdict() for window in windows]
            write_json(path, record)
    record["wrong"] = verdict(windows)
    write_json(path, record)
    return record


def figure(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Time of a step, memory and spread over steps."""
    made, axes = plt.subplots(3, 1, figsize=(7.2, 8), sharex=True, layout="constrained")
    for record in records:
        windows = record["windows"]
        steps = [window["step"] for window in windows]
        colour = figures.colour(LINES.get(record["name"], record["name"]))
        (line,) = axes[0].plot(steps, [1e3 * w["median"] for w in windows], lw=1.2, label=record["name"], c=colour)
        axes[0].plot(steps, [1e3 * w["p99"] for w in windows], ":", lw=0.8, c=line.get_color())
        axes[1].plot(steps, [w["memory"] for w in windows], lw=1.2, c=line.get_color())
        axes[2].plot(steps, [w["spread"] or float("nan") for w in windows], lw=1.2, c=line.get_color())
    axes[0].set_yscale("log")
    axes[0].set_ylabel("time of a step [ms]\n(dotted: 99th percentile)")
    axes[1].set_ylabel("resident memory [MiB]")
    axes[2].set_yscale("log")
    axes[2].set_ylabel("smallest spread\n[share of the first]")
    axes[2].set_xlabel("steps")
    axes[0].legend(fontsize=8, ncols=3)
    for axis in axes:
        axis.grid(alpha=0.3)
    return made


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line; exit status 1 if anything is wrong."""
    options = _parser().parse_args(arguments)
    torch.set_num_threads(1)
    steps = min(options.steps, 20_000) if options.quick else options.steps
    if steps < 10 * LEAST:
        raise SystemExit(f"--steps must be at least {10 * LEAST}, got {options.steps}")
    count = 40 if options.quick else 100
    demonstrations, _ = load(options.data, count, options.seed)
    layout = demonstrations.layout
    controlled = {modality.name for modality in layout.modalities if modality.controlled}
    names = SENSORS if options.data is None else [name for name in layout.names if name not in controlled]
    sensors = layout.mask(names)
    settings = {"data": options.data, "steps": steps, "seed": options.seed, "filters": options.filters}
    run = RunFolder("soak", settings, options.out, options.force, arguments)
    training, testing = split(len(demonstrations), 1, 0, options.seed)
    known, shown = demonstrations.subset(training[:MEMBERS]), demonstrations.subset(testing)
    basis = StackedBasis([BSplineBasis(8)] * layout.n_dofs)
    primitive = InteractionPrimitive.fit(known, basis)
    records = []
    for name in options.filters:
        path = run.path / f"soak_{name}.json"
        stored = read_json(path) if path.exists() else {"wrong": None}
        if stored["wrong"] is None:  # not finished
            asked = max(10 * LEAST, round(SHARES.get(name, 1.0) * steps))
            make = partial(SUBJECTS[name], primitive, sensors, options.seed)
            stored = soak(name, make, stream(shown, sensors, options.seed), asked, path)
        records.append(stored)
    wrong = {record["name"]: record["wrong"] for record in records if record["wrong"]}
    results = {
        "experiment": "soak",
        "dtype": "float32",
        "sensors": list(names),
        "measured_dofs": int(sensors.sum()),
        "members": len(primitive),
        "state": 2 + primitive.basis.n_weights,
        "threads": 1,
        "wrong": wrong,
        "filters": records,
    }
    save_figure(figure(records), run.path / "soak.png")
    run.finish(results)
    _print(results)
    print(f"written to {run.path}")
    if wrong:
        raise SystemExit(1)


def _print(results: Mapping[str, Any]) -> None:
    sizes = f"state {results['state']}, E = {results['members']}, {results['measured_dofs']} measured DoFs"
    table = Table(title=f"soak in float32: {sizes}", title_justify="left")
    heads = ("steps", "median\n[us]", "p99\n[us]", "time, end\nover start", "memory\n[MiB]", "grown\n[MiB]", "spread")
    table.add_column("filter")
    for head in heads:
        table.add_column(head, justify="right")
    table.add_column("verdict", overflow="fold")
    for record in results["filters"]:
        windows = [Window(**_numbers(window)) for window in record["windows"]]
        tenth = max(1, len(windows) // 10)
        early, late = windows[tenth : 2 * tenth], windows[-tenth:]
        memory = median(w.memory for w in late)
        table.add_row(
            record["name"],
            f"{record['steps']:,}",
            f"{1e6 * median(w.median for w in windows):.0f}",
            f"{1e6 * median(w.p99 for w in windows):.0f}",
            f"{relative_time(late) / relative_time(early):.2f}" if early else "-",
            f"{memory:.0f}",
            f"{memory - median(w.memory for w in early):+.1f}" if early else "-",
            f"{windows[-1].spread:.1e}",
            "; ".join(record["wrong"]) or "fine",
        )
    Console().print(table)


def _numbers(window: Mapping[str, Any]) -> dict[str, Any]:
    """A window as it was before JSON, which knows no NaN."""
    return {key: float("nan") if value is None else value for key, value in window.items()}


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("soak", __doc__)
    slow = ", ".join(f"{name} {share:g}" for name, share in SHARES.items())
    parser.add_argument("--data", metavar="FILE.npz", help="recordings in the project's format (default: simulated)")
    parser.add_argument("--steps", type=int, default=1_000_000, help=f"of each; of some a share: {slow}")
    parser.add_argument(
        "--filters", nargs="+", choices=list(SUBJECTS), default=list(DEFAULT), help=f"default: {', '.join(DEFAULT)}"
    )
    add_run_options(parser, "soak", "data, splits and draws", "a small run")
    return parser


if __name__ == "__main__":
    main()
