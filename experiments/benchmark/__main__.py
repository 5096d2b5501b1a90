"""How fast a step is, as ratios to things measured in the same run: no time here means anything on its own.

`floor` is the bare matrix products, factorisation, solve and random draws of a step, with operands ready and outputs
preallocated. `live` is `LiveFilter`, `filter` the differentiable `EnsembleFilter` stepwise, `loop` torch member by
member, `numpy` a vectorised numpy version, `filterpy` that package's EnsembleKalmanFilter if it is installed. All
give the same members for the same draws, which is checked before anything is timed. Actions take turns.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from experiments.benchmark import bending, caution, growth, pausing, sequences, startup, step
from experiments.command_line import add_run_options, command, experiment_parser
from experiments.run_folder import RunFolder, save_figure


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    rounds = 100 if options.quick else options.rounds
    samples = 20 if options.quick else sequences.SAMPLES
    settings = {"seed": options.seed, "rounds": rounds, "quick": options.quick}
    run = RunFolder("benchmark", settings, options.out, options.force, arguments)
    seed = options.seed
    sections: dict[str, Callable[[], Any]] = {
        "step": lambda: step.live_size(rounds, seed),
        "grid": lambda: step.grid(max(100, rounds // 3), seed, options.quick),
        "growth": lambda: growth.growth(rounds // 2, seed),
        "caution": lambda: caution.caution(2 * rounds, seed, options.quick),
        "bending": lambda: bending.bending(rounds, seed, options.quick),
        "pausing": lambda: pausing.pausing(rounds, seed, options.quick),
        "fold": lambda: sequences.fold(1 if options.quick else 3, seed, samples),
        "tuning": lambda: sequences.tuning(seed, samples=samples),
        "startup": lambda: startup.startup(run.path, 2 if options.quick else 5),
    }
    results: dict[str, Any] = {"experiment": "benchmark", "threads_available": torch.get_num_threads()}
    with tqdm(sections.items(), desc="benchmark", unit="section", dynamic_ncols=True) as bar:
        for name, section in bar:
            bar.set_postfix_str(name)
            results[name] = section()
    results["seconds"] = round(time.monotonic() - began, 1)
    save_figure(figure(results), run.path / "benchmark.png")
    run.finish(results)
    _print(results)
    print(f"{results['seconds']:.0f} s; written to {run.path}")


def figure(results: Mapping[str, Any]) -> Figure:
    """Time of a step by version over the floor, and how it grows with each size."""
    made, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    rows = [row for row in results["step"] if row["sensors"] == 10 and row["version"] != "floor, whole state"]
    rows.sort(key=lambda row: row["over_floor"])
    colours = ["tab:blue" if row["version"].startswith("live") else "0.6" for row in rows]
    left.barh([row["version"] for row in rows], [row["over_floor"] for row in rows], color=colours)
    left.set_xscale("log")
    left.set_xlabel("time a step and interaction / floor")
    left.set_title("559 weights, 80 members, 10 sensors, float32, 1 thread", fontsize=10)
    for y, row in enumerate(rows):
        ratio = row["over_floor"]
        left.text(ratio, y, f" {ratio:.0f}" if ratio > 100 else f" {ratio:.3g}", va="center", fontsize=8)
    left.margins(x=0.2)
    for row in results["growth"]:
        first = row["microseconds"][0]
        right.loglog(
            [size / row["sizes"][0] for size in row["sizes"]],
            [t / first for t in row["microseconds"]],
            "o-",
            ms=4,
            label=f"{row['varied']} (from {row['sizes'][0]}): exponent {row['exponent']:.2f}",
        )
    right.set_xlabel("size / smallest size")
    right.set_ylabel("time a step / time at the smallest size")
    right.grid(alpha=0.3, which="both")
    right.legend(fontsize=8)
    return made


def _print(results: Mapping[str, Any]) -> None:
    console = Console(width=max(Console().width, 110))
    heads = ["version", "sensors", "us", "over floor", "over live", "p99 / median"]
    table = _table("a step: 559 weights, 80 members, float32, 1 thread (us: a step and interaction)", heads)
    for row in results["step"]:
        numbers = (row["microseconds"], row["over_floor"], row["over_live"], row["p99_over_median"])
        table.add_row(row["version"], str(row["sensors"]), *(f"{number:.3g}" for number in numbers))
    console.print(table)
    heads = ["weights", "members", "type", "threads", "us", "over floor", "over floor of whole state", "p99 / median"]
    table = _table("live path, 10 sensors", [*heads, "p99 / median of the floor"])
    for row in results["grid"]:
        keys = ("microseconds", "over_floor", "over_whole_floor", "p99_over_median", "floor_p99_over_median")
        sizes = (str(row[key]) for key in ("weights", "members", "dtype", "threads"))
        table.add_row(*sizes, *(f"{row[key]:.3g}" for key in keys))
    console.print(table)
    table = _table("growth of a live step, 1 thread", ["varied", "from", "to", "exponent", "last / first"])
    for row in results["growth"]:
        sizes = (str(row["sizes"][0]), str(row["sizes"][-1]))
        table.add_row(row["varied"], *sizes, f"{row['exponent']:.2f}", f"{row['last_over_first']:.3g}")
    console.print(table)
    table = _table("surprise: learned from reaches, 3 sensors, 1 thread, us", ["what", "with", "without", "ratio"])
    for row in results["caution"]:
        numbers = (row["with"], row["without"], row["with_over_without"])
        table.add_row(row["what"], *(f"{number:.3g}" for number in numbers))
    console.print(table)
    heads = ["horizons", "with an expert", "bends", "straight", "an update", "of an expert's filter"]
    table = _table(
        "a forecast with analogues: reaches, 3 sensors, live, 1 thread, us",
        [*heads, "bends / update", "with an expert / update"],
    )
    for row in results["bending"]:
        keys = ("heard", "bends", "straight", "update", "update_heard", "bends_over_update", "heard_over_update")
        numbers = tuple(row[key] for key in keys)
        table.add_row(str(row["horizons"]), *(f"{number:.3g}" for number in numbers))
    console.print(table)
    table = _table(
        "a bank of phase hypotheses: a live step, E = 80, 1 thread, us", ["what", "with", "without", "ratio"]
    )
    for row in results["pausing"]:
        numbers = (row["with"], row["without"], row["with_over_without"])
        table.add_row(row["what"], *(f"{number:.3g}" for number in numbers))
    console.print(table)
    heads = ["sensors", "threads", "us a step and interaction", "one at a time / together"]
    table = _table("a fold: 22 x 198 members x 100 samples x 559 weights", [*heads, "stepwise / together"])
    for row in results["fold"]:
        keys = ("microseconds", "alone_over_together", "stepwise_over_together")
        table.add_row(str(row["sensors"]), str(row["threads"]), *(f"{row[key]:.3g}" for key in keys))
    console.print(table)
    heads = ["sensors", "segment", "s an interaction", "extra memory, GB"]
    table = _table("forward and backward: 16 x 198 members x 559 weights, 2 threads", heads)
    for row in results["tuning"]:
        segment = "none" if row["segment"] is None else str(row["segment"])
        numbers = (row["seconds_per_interaction"], row["extra_gigabytes"])
        table.add_row(str(row["sensors"]), segment, *(f"{number:.3g}" for number in numbers))
    console.print(table)
    table = _table("start-up, s", list(results["startup"]))
    table.add_row(*(f"{seconds:.3g}" for seconds in results["startup"].values()))
    console.print(table)


def _table(title: str, heads: list[str]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column(heads[0])
    for head in heads[1:]:
        table.add_column(head, justify="right")
    return table


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("benchmark", __doc__)
    parser.add_argument("--rounds", type=int, default=1000, help="calls of each action that count (default: 1000)")
    add_run_options(parser, "benchmark", "interactions and draws", "few calls and sizes", resumes=False)
    return parser


if __name__ == "__main__":
    main()
