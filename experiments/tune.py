"""Learn an interaction, tune the filter's noise by gradient, and compare it on interactions it has never seen.

Methods: `ebip` is the paper's closed form, `ebip_scaled` the closed-form R times the best single factor,
`ebip_tuned` the tuned filter; `mean` and `nearest` are what can be said without a filter. Without --data the
recordings are the simulated ball catching.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from tqdm import tqdm

from experiments.data import FRACTIONS, load, thinning
from experiments.evaluate import FilterMethod, MeanMethod, NearestMethod, evaluate
from experiments.figures import forecast_figure, noise_figure, results_figure
from experiments.folds import mean_of_cells, read_values, run_folds, share_cores, split, write_values
from experiments.methods import FACTORS, Problem, best_factor, best_start, scaled, tunable, tune
from experiments.results import Values, print_tables, summarise
from experiments.run_folder import RunFolder, write_json
from torch_ebip import InteractionPrimitive, select_basis
from torch_ebip.basis import rank_candidates, selection_table
from torch_ebip.checkpoint import save_checkpoint
from torch_ebip.monitor import Monitor
from torch_ebip.tuning import TuningSettings


@dataclass(frozen=True)
class Job:
    """One fold: everything a worker needs."""

    fold: int
    folds: int
    data: str | None
    demonstrations: int
    seed: int
    test: float
    scan: int
    threads: int
    folder: str
    tuning: TuningSettings


def run_fold(job: Job, progress: Callable[[int, float, float], None] | None = None) -> Values:
    """Fit, scan, tune and evaluate one fold; a finished one is read from its folder."""
    torch.set_num_threads(job.threads)
    folder = Path(job.folder)
    finished = folder / "values.json"
    if finished.exists():
        return read_values(finished)
    demonstrations, task = load(job.data, job.demonstrations, job.seed)
    layout = demonstrations.layout
    training, testing = split(len(demonstrations), job.folds, job.fold, job.seed, job.test)
    known, tests = demonstrations.subset(training), demonstrations.subset(testing)
    ranking = rank_candidates(known)
    basis = select_basis(known, ranking=ranking)
    primitive = InteractionPrimitive.fit(known, basis)
    subsets = {name: layout.mask(names) for name, names in task.subsets.items()}
    arm = None if task.arm is None else (task.arm[0], layout.mask([task.arm[1]]))
    problem = Problem(known, primitive, layout.mask(task.targets), subsets, arm)
    with Monitor(folder / "tensorboard") as monitor:
        config = {**asdict(job), "tuning": None, **asdict(job.tuning)}
        monitor.text("configuration", "\n".join(f"- `{key}`: {value}" for key, value in config.items()))
        choice = selection_table(ranking)
        (folder / "basis.txt").write_text(f"{choice}\n")
        monitor.text("basis", f"```\n{choice}\n```")
        factor = best_factor(problem, scaled, job.tuning, job.scan, FACTORS, folder / "scan_scaled.json")
        start = best_start(problem, job.tuning, job.scan, factor, folder / "scan_tunable.json")
        tuned = tunable(primitive, start)
        result = tune(problem, tuned, job.tuning, monitor, folder / "checkpoint.pt", progress)
        filters = {"ebip": scaled(primitive, 1.0), "ebip_scaled": scaled(primitive, factor), "ebip_tuned": tuned}
        methods = {"mean": MeanMethod(primitive), "nearest": NearestMethod(primitive)}
        answers = evaluate(task, methods | {name: FilterMethod(f, job.seed) for name, f in filters.items()}, tests)
        sensors = layout.mask(next(reversed(task.subsets.values())))
        shown = [dof for name in task.targets for dof in layout[name].dofs[:3]]
        for step, name in ((0, "ebip"), (result.best_step, "ebip_tuned")):
            figure = forecast_figure({name: filters[name]}, tests, 0, sensors, shown, FRACTIONS)
            monitor.figure("forecast", figure, step)
        pair = {name: filters[name] for name in ("ebip", "ebip_tuned")}
        forecast_figure(pair, tests, 0, sensors, shown, FRACTIONS).savefig(folder / "forecasts.png", dpi=110)
        seen = [name for name in layout.names if not layout[name].controlled]
        noise_figure(tuned, primitive.residual_variance, layout, seen).savefig(folder / "noise.png", dpi=110)
        summary = summarise(answers, "ebip_tuned")["summary"]
        final = {
            f"final/{row['metric']}/{row['modality'] or 'all'}": row["mean"]
            for row in summary
            if row["method"] == "ebip_tuned"
        }
        choices = {**asdict(job.tuning), **start._asdict(), "seed": job.seed, "fold": job.fold}
        monitor.hyperparameters(choices, final)
    report = {
        "n_weights": basis.n_weights,
        "basis": {m.name: str(basis.bases[layout.slice(m.name).start]) for m in layout.modalities},
        "factor_scaled": factor,
        "start": start._asdict(),
        "best_step": result.best_step,
        "stopped_early": result.stopped_early,
        "validation": result.validation,
        "tuning_seconds": result.seconds,
    }
    write_json(folder / "report.json", report)
    save_checkpoint(
        folder / "filter.pt",
        {"start": start._asdict()},
        {"parameters": {name: p.detach() for name, p in tuned.named_parameters()}},
    )
    write_values(finished, answers)
    return answers


def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    tuning = TuningSettings(seed=options.seed, steps=options.steps)
    count, scan, test = options.demonstrations, 48, 0.2
    if options.quick:
        tuning = replace(tuning, steps=min(options.steps, 20), batch_size=8, validate_every=5)
        count, scan = min(count, 100), 12
    demonstrations, task = load(options.data, count, options.seed)
    tuning = replace(tuning, thinning=thinning(demonstrations))
    settings = {
        "data": options.data,
        "demonstrations": None if options.data else count,
        "folds": options.folds,
        "test": test if options.folds == 1 else None,
        "seed": options.seed,
        "scan": scan,
        "tuning": asdict(tuning),
    }
    if not 1 <= options.folds <= len(demonstrations):
        raise SystemExit(
            f"--folds must be between 1 and the {len(demonstrations)} demonstrations, got {options.folds}"
        )
    held = round(test * len(demonstrations)) if options.folds == 1 else -(-len(demonstrations) // options.folds)
    if held < 1 or len(demonstrations) - held < 2 * tuning.folds:
        raise SystemExit(
            f"{len(demonstrations)} demonstrations with {held} held out are too few: tuning filters each of the "
            f"others by the rest in {tuning.folds} folds, and needs {2 * tuning.folds} of them"
        )
    run = RunFolder("tune", settings, options.out, options.force)
    workers, threads = share_cores(options.folds, options.workers)
    jobs = [
        Job(fold, options.folds, options.data, count, options.seed, test, scan, threads,
            str(run.path / f"fold-{fold:02d}" if options.folds > 1 else run.path), tuning)
        for fold in range(options.folds)
    ]  # fmt: skip
    print(demonstrations)
    try:
        values = _single(jobs[0]) if len(jobs) == 1 else run_folds(run_fold, jobs, workers, _headline)
    except ValueError as error:
        raise SystemExit(f"{run.path}: {error}") from error
    results = {
        "experiment": "tune",
        "dataset": {
            "source": options.data or "simulated ball catching",
            "demonstrations": len(demonstrations),
            "dofs": demonstrations.layout.n_dofs,
            "rate": demonstrations.rate,
            "folds": options.folds,
        },
        **summarise(values, "ebip_tuned"),
        "reports": [json.loads((Path(job.folder) / "report.json").read_text()) for job in jobs],
        "seconds": round(time.monotonic() - began, 1),
    }
    panels: list[tuple[str, str | None]] = [(metric, m) for m in task.targets for metric in ("mse", "mae")]
    if task.arm is not None:
        panels = [("mse", "robot"), ("mae", "ball"), ("tool_error", None)]
    panels.append(("coverage_95", task.targets[0]))
    write_json(run.results, results)
    results_figure(results, panels).savefig(run.path / "results.png", dpi=110)
    print_tables(results)
    for report in results["reports"][:1]:
        print(f"state: {report['n_weights']} weights; factor on R: {report['factor_scaled']:.3g} (ebip_scaled)")
    print(f"{results['seconds']:.0f} s; written to {run.path}")
    print(f"watch it: tensorboard --logdir {run.path}")


def _single(job: Job) -> Values:
    with tqdm(total=job.tuning.steps, desc="tuning", unit="step", dynamic_ncols=True) as bar:

        def show(step: int, loss: float, validation: float) -> None:
            bar.set_postfix_str(f"train {loss:.3f}, validation {validation:.3f}", refresh=False)
            bar.update(step - bar.n)

        return run_fold(job, show)


def _headline(values: Values) -> str:
    pairs = ((name, mean_of_cells(values, name, "mae")) for name in ("ebip_scaled", "ebip_tuned"))
    return ", ".join(f"{name} mae {mean:.4f}" for name, mean in pairs)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m experiments.tune", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", metavar="FILE.npz", help="recordings in the project's format (default: simulated)")
    parser.add_argument("--demonstrations", type=int, default=221, metavar="N", help="simulated ones (default: 221)")
    parser.add_argument(
        "--folds", type=int, default=1, help="cross-validation; 1 holds out a fifth once (default: 1)"
    )
    parser.add_argument("--steps", type=int, default=100, help="gradient steps at most (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="of data, splits and draws (default: 0)")
    parser.add_argument("--quick", action="store_true", help="a run of about a minute, to see that all works")
    parser.add_argument("--workers", type=int, help="processes for folds (default: one a core)")
    parser.add_argument(
        "--out", metavar="DIR", help="run folder (default: runs/tune/STAMP); resumes an unfinished run"
    )
    parser.add_argument("--force", action="store_true", help="start over, also where --out holds a finished run")
    return parser


if __name__ == "__main__":
    main()
