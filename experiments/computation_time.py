"""The paper's figure of computation time: filtering time over observation length, and accuracy bought with time.

Above: time to filter the first samples of one interaction with all sensors, for BIP, the particle filter and eBIP
at the same state. Below: time a sample and error of the ball for eBIP with growing ensembles, with the closed-form
R and with the best single factor on it. One thread; methods take turns; medians.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Any

import matplotlib.pyplot as plt
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor
from tqdm import tqdm

from experiments.command_line import add_data_options, add_run_options, command, experiment_parser
from experiments.data import load, thinning
from experiments.entries import METHODS, Fold
from experiments.evaluate import FilterMethod, evaluate
from experiments.figures import colour, plain
from experiments.folds import mean_of_cells, split
from experiments.run_folder import RunFolder, save_figure
from torch_ebip import Filter, TuningSettings, ebip
from torch_ebip.learning.starts import scaled

FRACTION = 0.82


def interleaved(actions: Mapping[Any, Callable[[], object]], repeats: int) -> dict[Any, float]:
    """Median seconds of each action; they take turns, so that what slows the machine slows all of them."""
    taken: dict[Any, list[float]] = {key: [] for key in actions}
    for repeat in range(repeats + 1):
        for key, action in actions.items():
            began = time.perf_counter()
            action()
            if repeat:  # the first round warms caches
                taken[key].append(time.perf_counter() - began)
    return {key: median(values) for key, values in taken.items()}


def filtering(filter: Filter, y: Tensor, observed: Tensor) -> Callable[[], object]:
    """Filter a sequence, without gradients."""

    @torch.no_grad()
    def run() -> object:
        return filter(y, observed, generator=torch.Generator().manual_seed(0), project=False)

    return run


def time_by_length(
    filters: Mapping[str, Filter], trajectory: Tensor, shown: Tensor, lengths: Sequence[int], repeats: int
) -> list[dict[str, Any]]:
    """Rows of method, samples and seconds."""
    rows = []
    for length in tqdm(lengths, desc="lengths", unit="length", dynamic_ncols=True):
        y = trajectory[:length]
        observed = shown & ~y.isnan()
        taken = interleaved({name: filtering(f, y, observed) for name, f in filters.items()}, repeats)
        rows += [{"method": name, "samples": length, "seconds": seconds} for name, seconds in taken.items()]
    return rows


def figure(by_length: Sequence[Mapping[str, Any]], by_members: Sequence[Mapping[str, Any]], unit: str) -> plt.Figure:
    """Time over length; time and error over ensemble size."""
    made, (above, below) = plt.subplots(2, 1, figsize=(6.4, 7.2), layout="constrained")
    for name in dict.fromkeys(row["method"] for row in by_length):
        rows = [row for row in by_length if row["method"] == name]
        above.semilogy(
            [r["samples"] for r in rows], [r["seconds"] for r in rows], "o-", ms=4, color=colour(name), label=name
        )
    rate = max(row["rate"] for row in by_members)
    lengths = sorted({row["samples"] for row in by_length})
    above.plot(lengths, [n / rate for n in lengths], "k:", lw=1, label="real time")
    above.set_xlabel("samples observed")
    above.set_ylabel("filtering time [s]")
    above.grid(alpha=0.3, which="both")
    above.legend(fontsize=8)
    times = below.twinx()
    for name in dict.fromkeys(row["method"] for row in by_members):
        rows = [row for row in by_members if row["method"] == name]
        below.plot(
            [r["members"] for r in rows], [r["error"] for r in rows], "o-", ms=4, color=colour(name), label=name
        )
    rows = [row for row in by_members if row["method"] == by_members[0]["method"]]
    times.plot([r["members"] for r in rows], [1e3 * r["seconds_per_sample"] for r in rows], "s--", ms=4, color="0.4")
    below.set_xlabel("ensemble members E")
    below.set_ylabel(plain(f"error after {FRACTION:.0%} [{unit}]"))
    below.set_ylim(bottom=0)
    times.set_ylabel("time a sample [ms] (dashed)")
    times.set_ylim(bottom=0)
    below.grid(alpha=0.3)
    below.legend(fontsize=8)
    return made


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    torch.set_num_threads(1)
    began = time.monotonic()
    count = min(options.demonstrations, 60) if options.quick else options.demonstrations
    repeats, seeds = (1, 1) if options.quick else (options.repeats, 3)
    demonstrations, task = load(options.data, count, options.seed)
    settings = {
        "data": options.data,
        "demonstrations": None if options.data else count,
        "seed": options.seed,
        "repeats": repeats,
        "seeds": seeds,
    }
    run = RunFolder("computation_time", settings, options.out, options.force, arguments)
    print(demonstrations)
    training, testing = split(len(demonstrations), 1, 0, options.seed)
    known, tests = demonstrations.subset(training), demonstrations.subset(testing)
    tuning = TuningSettings(seed=options.seed, thinning=thinning(demonstrations))
    fold = Fold.of(known, task, options.seed, tuning, run.path, scan=8 if options.quick else 48)
    primitive = fold.primitive
    subset, names = list(task.subsets.items())[-1]
    shown = demonstrations.layout.mask(names)
    longest = int(demonstrations.lengths.argmax())
    lengths = [n for n in (10, 25, 50, 75, 100, 125, 150, 200) if n <= len(demonstrations[longest])]
    filters = {
        name: method.filter
        for name in ("bip", "particle_filter", "ebip")
        if isinstance(method := METHODS[name](fold), FilterMethod)
    }
    by_length = time_by_length(
        filters, demonstrations[longest], shown, lengths[:2] if options.quick else lengths, repeats
    )
    factor = fold.factor()
    sizes = [e for e in (10, 20, 40, 80, 120, 160, 198) if e < len(primitive)] + [len(primitive)]
    y = demonstrations[longest][: lengths[-1]]
    steps = {e: filtering(ebip(primitive, e), y, shown & ~y.isnan()) for e in sizes}
    taken = interleaved(steps, repeats)
    asked = task._replace(subsets={subset: names}, fractions=(FRACTION,), skipped=[])
    target = task.targets[-1]
    by_members = []
    for members in tqdm(sizes, desc="ensemble sizes", unit="size", dynamic_ncols=True):
        for name, scale in (("ebip", 1.0), ("ebip_scaled", factor)):
            errors = []
            for seed in range(seeds):
                method = FilterMethod(scaled(primitive, scale, members), options.seed + seed)
                values = evaluate(asked._replace(targets=[target], arm=None), {name: method}, tests)
                errors.append(mean_of_cells(values, name, "mae"))
            by_members.append(
                {
                    "method": name,
                    "members": members,
                    "seconds_per_sample": taken[members] / len(y),
                    "error": sum(errors) / len(errors),
                    "rate": demonstrations.rate,
                }
            )
    unit = demonstrations.layout[target].unit
    ratios = {
        name: median(
            row["seconds"]
            / next(r for r in by_length if (r["method"], r["samples"]) == ("ebip", row["samples"]))["seconds"]
            for row in by_length
            if row["method"] == name
        )
        for name in filters
    }
    results = {
        "experiment": "computation_time",
        "dataset": {"source": options.data or "simulated ball catching", "demonstrations": len(demonstrations)},
        "state": 2 + primitive.basis.n_weights,
        "members": len(primitive),
        "observed_dofs": int(shown.sum()),
        "threads": 1,
        "factor": factor,
        "by_length": by_length,
        "by_members": by_members,
        "time_relative_to_ebip": ratios,
        "target": {"modality": target, "unit": unit, "observed": FRACTION},
        "seconds": round(time.monotonic() - began, 1),
    }
    save_figure(figure(by_length, by_members, unit), run.path / "computation_time.png")
    run.finish(results)
    _print(results)
    print(f"{results['seconds']:.0f} s; written to {run.path}")


def _print(results: Mapping[str, Any]) -> None:
    console = Console()
    lengths = list(dict.fromkeys(row["samples"] for row in results["by_length"]))
    table = Table(
        title=f"time to filter, ms; state {results['state']}, E = {results['members']}", title_justify="left"
    )
    table.add_column("method")
    for length in lengths:
        table.add_column(f"{length} samples", justify="right")
    table.add_column("relative\nto eBIP", justify="right")
    for name, ratio in results["time_relative_to_ebip"].items():
        taken = [f"{1e3 * row['seconds']:.0f}" for row in results["by_length"] if row["method"] == name]
        table.add_row(name, *taken, f"{ratio:.2g}")
    console.print(table)
    target = results["target"]
    table = Table(
        title=f"{target['modality']} after {target['observed']:.0%} [{target['unit']}]", title_justify="left"
    )
    for head in ("E", "ms a sample", "ebip", "ebip_scaled"):
        table.add_column(head, justify="right")
    for closed in (row for row in results["by_members"] if row["method"] == "ebip"):
        other = next(
            row
            for row in results["by_members"]
            if row["method"] == "ebip_scaled" and row["members"] == closed["members"]
        )
        milliseconds = f"{1e3 * closed['seconds_per_sample']:.2f}"
        table.add_row(str(closed["members"]), milliseconds, f"{closed['error']:.3g}", f"{other['error']:.3g}")
    console.print(table)


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("computation_time", __doc__)
    add_data_options(parser)
    parser.add_argument("--repeats", type=int, default=5, help="of each timing, beside one to warm up (default: 5)")
    add_run_options(parser, "computation_time", "data, splits and draws", "a small run", resumes=False)
    return parser


if __name__ == "__main__":
    main()
