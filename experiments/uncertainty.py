"""What the filters know of their own errors: the paper's figure of uncertainty, calibration, and attribution.

Filters a held-out part of the interactions with the closed-form eBIP, the tuned one and the particle filter. Writes
frames of one interaction (density of a joint at the end, its inferred trajectory), the error over the observed
share with its spread, rank histograms and coverage, and which demonstrations the tuned forecasts rest on.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, replace
from typing import Any

import torch

from experiments.calibration_figures import calibration_figure, error_figure
from experiments.command_line import add_data_options, add_run_options, command, experiment_parser
from experiments.data import load, thinning
from experiments.entries import METHODS, Fold
from experiments.evaluate import FilterMethod, Task, evaluate
from experiments.folds import split
from experiments.frames_figures import attribution_figure, frames_figure
from experiments.results import print_tables, summarise
from experiments.run_folder import RunFolder, save_figure
from torch_ebip import Demonstrations, Forecast, TuningSettings

NAMES = ("ebip", "ebip_tuned", "particle_filter")
LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Nominal probabilities of central intervals."""


def probabilities(method: FilterMethod, task: Task, tests: Demonstrations, target: str) -> torch.Tensor:
    """Predicted probability of less than what happened at the end, [B, K, DoFs of the target].

    Args:
        method: a filter.
        task: its first subset is shown, at its fractions.
        tests: B interactions.
        target: modality.
    """
    y, measured = tests.pad()
    steps = torch.stack([(tests.lengths * f).round().long() - 1 for f in task.fractions], -1).clamp(min=0)
    shown = tests.layout.mask(next(iter(task.subsets.values())))
    stop = int(steps.max()) + 1
    within = torch.arange(stop).view(1, -1, 1) <= steps.amax(-1).view(-1, 1, 1)
    targets = tests.layout.mask([target])
    forecast: Forecast = method(y[:, :stop], measured[:, :stop] & shown & within, steps, targets).forecast.at(0)
    ends = torch.stack([trajectory[-1, targets] for trajectory in tests]).unsqueeze(1)
    return forecast.probability_below(ends.expand_as(forecast.mean))


def calibration(below: torch.Tensor) -> dict[str, Any]:
    """Rank histogram in ten bins and empirical coverage of central intervals; NaN is left out."""
    below = below[~below.isnan()]
    counts = torch.histc(below.float(), 10, 0, 1)
    inside = [(2 * below - 1).abs() <= level for level in LEVELS]
    return {
        "rank_histogram": (counts / counts.sum()).tolist(),
        "nominal": list(LEVELS),
        "empirical": [float(share.double().mean()) for share in inside],
        "n": len(below),
    }


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    tuning = TuningSettings(seed=options.seed, steps=options.steps)
    count = options.demonstrations
    if options.quick:
        tuning, count = replace(tuning, steps=min(options.steps, 10), batch_size=8, validate_every=5), min(count, 60)
    demonstrations, task = load(options.data, count, options.seed)
    layout = demonstrations.layout
    training, testing = split(len(demonstrations), 1, 0, options.seed)
    if not 0 <= options.interaction < len(testing):
        raise SystemExit(f"--interaction must be between 0 and {len(testing) - 1}, got {options.interaction}")
    tuning = replace(tuning, thinning=thinning(demonstrations))
    target = task.targets[0]
    dof = options.dof or layout[target].dofs[min(2, len(layout[target].dofs) - 1)]
    if dof not in [name for name in task.targets for name in layout[name].dofs]:
        raise SystemExit(f"--dof {dof} is not forecast; the targets are {', '.join(task.targets)}")
    settings = {
        "data": options.data,
        "demonstrations": None if options.data else count,
        "seed": options.seed,
        "tuning": asdict(tuning),
        "interaction": options.interaction,
        "dof": dof,
    }
    run = RunFolder("uncertainty", settings, options.out, options.force, arguments)
    print(demonstrations)
    known, tests = demonstrations.subset(training), demonstrations.subset(testing)
    fold = Fold.of(known, task, options.seed, tuning, run.path)
    methods = {name: METHODS[name](fold) for name in NAMES}
    filters = {name: method.filter for name, method in methods.items() if isinstance(method, FilterMethod)}
    # Every sensor, at many shares of the interaction.
    subset, names = list(task.subsets.items())[-1]
    fractions = tuple(round(0.05 * i, 2) for i in range(1, 20))
    curve = task._replace(subsets={subset: names}, fractions=fractions, skipped=[], ahead=())
    values = evaluate(curve, methods, tests)
    shown = layout.mask(names)
    horizons = curve._replace(fractions=(0.2, 0.43, 0.6, 0.82))
    reports = {name: calibration(probabilities(methods[name], horizons, tests, target)) for name in NAMES}
    for name, filter in filters.items():
        frames = frames_figure(name, filter, tests[options.interaction], layout, shown, dof)
        save_figure(frames, run.path / f"frames-{name}.png")
    save_figure(error_figure(values, [(m, "mae") for m in task.targets]), run.path / "error.png")
    save_figure(calibration_figure(reports, target), run.path / "calibration.png")
    attributed = {name: filters[name] for name in ("ebip", "ebip_tuned")}
    save_figure(attribution_figure(attributed, tests[options.interaction], shown), run.path / "attribution.png")
    results = {
        "experiment": "uncertainty",
        "dataset": {
            "source": options.data or "simulated ball catching",
            "demonstrations": len(demonstrations),
            "tests": len(tests),
        },
        **summarise(values, "ebip_tuned"),
        "calibration": {"modality": target, **reports},
        "seconds": round(time.monotonic() - began, 1),
    }
    run.finish(results)
    few = [row for row in results["rows"] if row["observed"] in (0.2, 0.45, 0.6, 0.8, 0.95)]
    print_tables({**results, "rows": few}, only=[("mae", task.targets[-1]), ("coverage_95", target)])
    for name, report in reports.items():
        pairs = zip(report["nominal"], report["empirical"], strict=True)
        print(f"{name}: coverage " + ", ".join(f"{nominal:.0%} -> {empirical:.0%}" for nominal, empirical in pairs))
    print(f"{results['seconds']:.0f} s; written to {run.path}")


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("uncertainty", __doc__)
    add_data_options(parser)
    parser.add_argument("--interaction", type=int, default=0, help="which of the held-out ones is drawn (default: 0)")
    parser.add_argument("--dof", help="which degree of freedom is drawn (default: the robot's third joint)")
    parser.add_argument("--steps", type=int, default=100, help="gradient steps at most (default: 100)")
    add_run_options(parser, "uncertainty", "data, splits and draws", "a small run")
    return parser


if __name__ == "__main__":
    main()
