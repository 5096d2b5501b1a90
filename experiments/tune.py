"""Learn an interaction, tune the filter's noise by gradient, and compare it on interactions it has never seen.

Methods: `ebip` is the paper's closed form, `ebip_scaled` the closed-form R times the best single factor,
`ebip_tuned` the tuned filter; `mean` and `nearest` are what can be said without a filter. Without --data the
recordings are the simulated ball catching.

`torchrun --nproc-per-node K -m experiments.tune` shares the interactions of each step among K processes, or the
folds if there are several; the result is the same.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from tqdm import tqdm

from experiments.command_line import add_data_options, add_run_options, command, experiment_parser
from experiments.data import FRACTIONS, load, thinning
from experiments.evaluate import FilterMethod, MeanMethod, NearestMethod, evaluate
from experiments.figures import forecast_figure, noise_figure, results_figure
from experiments.folds import (
    LOST,
    interleave,
    mean_of_cells,
    read_values,
    run_folds,
    share_cores,
    split,
    write_values,
)
from experiments.methods import FACTORS, Problem, best_factor, best_start, keep, scaled, tunable, tune
from experiments.results import Values, print_tables, summarise
from experiments.run_folder import RunFolder, save_figure
from torch_ebip import InteractionPrimitive, TuningSettings, select_basis
from torch_ebip.common.files import atomic_write, read_json, write_json
from torch_ebip.interaction.basis import rank_candidates, selection_table
from torch_ebip.learning.monitor import Monitor
from torch_ebip.learning.ranks import RankLostError, Ranks


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
    device: str
    folder: str
    tuning: TuningSettings


def run_fold(
    job: Job, progress: Callable[[int, float, float], None] | None = None, ranks: Ranks | None = None
) -> Values:
    """Fit, scan, tune and evaluate one fold; a finished one is read from its folder.

    Several ranks share the interactions of the fold; the first one writes and reports.
    """
    torch.set_num_threads(job.threads)
    ranks = Ranks(device=torch.device(job.device)) if ranks is None else ranks
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
    primitive = InteractionPrimitive.fit(known, basis).to(ranks.device)
    subsets = {name: layout.mask(names) for name, names in task.subsets.items()}
    arm = None if task.arm is None else (task.arm[0], layout.mask([task.arm[1]]))
    problem = Problem(known, primitive, layout.mask(task.targets), subsets, arm, ranks)
    with Monitor(folder / "tensorboard") if ranks.first else nullcontext() as monitor:
        if monitor is not None:
            config = {**asdict(job), "tuning": None, **asdict(job.tuning)}
            monitor.text("configuration", "\n".join(f"- `{key}`: {value}" for key, value in config.items()))
            choice = selection_table(ranking)
            with atomic_write(folder / "basis.txt") as file:
                file.write(f"{choice}\n".encode())
            monitor.text("basis", f"```\n{choice}\n```")
        factor = best_factor(problem, scaled, job.tuning, job.scan, FACTORS, folder / "scan_scaled.json")
        start = best_start(problem, job.tuning, job.scan, factor, folder / "scan_tunable.json")
        tuned = tunable(primitive, start)
        result = tune(problem, tuned, job.tuning, monitor, folder / "checkpoint.pt", progress)
        filters = {"ebip": scaled(primitive, 1.0), "ebip_scaled": scaled(primitive, factor), "ebip_tuned": tuned}
        methods = {"mean": MeanMethod(primitive), "nearest": NearestMethod(primitive)}
        mine = ranks.shard(range(len(tests)))
        answering = {name: FilterMethod(f, job.seed, mine) for name, f in filters.items()}
        shares = ranks.gather(evaluate(task, methods | answering, tests.subset(mine)))
        answers = interleave(shares)
        if monitor is None:
            return answers
        for filter in filters.values():
            filter.cpu()
        sensors = layout.mask(next(reversed(task.subsets.values())))
        shown = [dof for name in task.targets for dof in layout[name].dofs[:3]]
        for step, name in ((0, "ebip"), (result.best_step, "ebip_tuned")):
            figure = forecast_figure({name: filters[name]}, tests, 0, sensors, shown, FRACTIONS)
            monitor.figure("forecast", figure, step)
        pair = {name: filters[name] for name in ("ebip", "ebip_tuned")}
        save_figure(forecast_figure(pair, tests, 0, sensors, shown, FRACTIONS), folder / "forecasts.png")
        seen = [name for name in layout.names if not layout[name].controlled]
        save_figure(noise_figure(tuned, primitive.residual_variance.cpu(), layout, seen), folder / "noise.png")
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
    keep(folder, start, tuned)
    write_values(finished, answers)
    return answers


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    ranks = Ranks.start()
    tuning = TuningSettings(seed=options.seed, steps=options.steps)
    count, scan, test = options.demonstrations, 48, 0.2
    if options.quick:
        tuning = replace(tuning, steps=min(options.steps, 20), batch_size=8, validate_every=5)
        count, scan = min(count, 100), 12
    ranks.from_first(lambda: load(options.data, count, options.seed) and None)  # simulated once, then kept
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
    run = ranks.from_first(lambda: RunFolder("tune", settings, options.out, options.force, arguments))
    ranks.explain_on_termination(LOST.format(run.path))
    workers, threads = share_cores(options.folds, options.workers)
    threads = threads if ranks.size == 1 else torch.get_num_threads()
    jobs = [
        Job(fold, options.folds, options.data, count, options.seed, test, scan, threads, str(ranks.device),
            str(run.path / f"fold-{fold:02d}" if options.folds > 1 else run.path), tuning)
        for fold in range(options.folds)
    ]  # fmt: skip
    if ranks.first:
        print(demonstrations)
    try:
        single = len(jobs) == 1
        values = _single(jobs[0], ranks) if single else run_folds(run_fold, jobs, workers, _headline, ranks)
    except ValueError as error:
        raise SystemExit(f"{run.path}: {error}") from error
    except RankLostError as error:
        raise SystemExit(f"{error}\n{LOST.format(run.path)}") from error
    ranks.stop()
    if not ranks.first:
        return
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
        "reports": [read_json(Path(job.folder) / "report.json") for job in jobs],
        "seconds": round(time.monotonic() - began, 1),
    }
    panels: list[tuple[str, str | None]] = [(metric, m) for m in task.targets for metric in ("mse", "mae")]
    if task.arm is not None:
        panels = [("mse", "robot"), ("mae", "ball"), ("tool_error", None)]
    panels.append(("coverage_95", task.targets[0]))
    save_figure(results_figure(results, panels), run.path / "results.png")
    run.finish(results)
    print_tables(results)
    for report in results["reports"][:1]:
        print(f"state: {report['n_weights']} weights; factor on R: {report['factor_scaled']:.3g} (ebip_scaled)")
    print(f"{results['seconds']:.0f} s; written to {run.path}")
    print(f"watch it: tensorboard --logdir {run.path}")


def _single(job: Job, ranks: Ranks) -> Values:
    silent = not ranks.first
    with tqdm(total=job.tuning.steps, desc="tuning", unit="step", dynamic_ncols=True, disable=silent) as bar:

        def show(step: int, loss: float, validation: float) -> None:
            bar.set_postfix_str(f"train {loss:.3f}, validation {validation:.3f}", refresh=False)
            bar.update(step - bar.n)

        return run_fold(job, show, ranks)


def _headline(values: Values) -> str:
    pairs = ((name, mean_of_cells(values, name, "mae")) for name in ("ebip_scaled", "ebip_tuned"))
    return ", ".join(f"{name} mae {mean:.4f}" for name, mean in pairs)


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("tune", __doc__)
    add_data_options(parser)
    parser.add_argument(
        "--folds", type=int, default=1, help="cross-validation; 1 holds out a fifth once (default: 1)"
    )
    parser.add_argument("--steps", type=int, default=100, help="gradient steps at most (default: 100)")
    add_run_options(parser, "tune", "data, splits and draws", "a run of about a minute", workers=True)
    return parser


if __name__ == "__main__":
    main()
