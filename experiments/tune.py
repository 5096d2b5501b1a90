"""Learn an interaction, tune the filter's noise by gradient, and compare it on interactions it has never seen.

Methods: `ebip` is the paper's closed form, `ebip_scaled` the closed-form R times the best single factor,
`ebip_tuned` what `torch_ebip.learn` returns; `mean` and `nearest` are what can be said without a filter. Without
--data the recordings are the simulated ball catching. Every run (or fold) leaves its model, which `load_model` reads;
--final makes one more, of all recordings.

`torchrun --nproc-per-node K -m experiments.tune` shares the interactions of each step among K processes, or the
folds if there are several; the result is the same.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from experiments.bars import learning_bar
from experiments.command_line import (
    add_data_options,
    add_role_options,
    add_run_options,
    command,
    experiment_parser,
)
from experiments.data import FRACTIONS, Roles, choose_subsets, load, thinning
from experiments.evaluate import FilterMethod, MeanMethod, NearestMethod, Task, evaluate
from experiments.figures import forecast_figure, horizons_figure, noise_figure, results_figure
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
from experiments.results import Values, print_tables, summarise
from experiments.run_folder import RunFolder, save_figure
from torch_ebip import Demonstrations, InteractionModel, learn
from torch_ebip.common.files import read_json
from torch_ebip.learning import Progress
from torch_ebip.learning.monitor import Monitor
from torch_ebip.learning.ranks import RankLostError, Ranks
from torch_ebip.learning.starts import scaled


@dataclass(frozen=True)
class Job:
    """One fold: everything a worker needs. Fold None learns from all recordings and tests nothing."""

    fold: int | None
    folds: int
    data: str | None
    demonstrations: int
    roles: Roles
    subsets: tuple[str, ...]
    seed: int
    test: float
    threads: int
    device: str
    folder: str
    learning: Mapping[str, Any]

    def problem(self) -> tuple[Demonstrations, Task]:
        """The recordings, and what is asked of them."""
        demonstrations, task = load(self.data, self.demonstrations, self.seed, self.roles)
        return demonstrations, choose_subsets(task, demonstrations.layout, self.subsets, alone=False)


def learned(
    job: Job,
    known: Demonstrations,
    task: Task,
    folder: Path,
    ranks: Ranks,
    progress: Callable[[Progress], None] | None,
) -> InteractionModel:
    """What the library makes of the training part of a job.

    Raises:
        KeyboardInterrupt: it was interrupted; the folder goes on.
    """
    model = learn(
        known,
        targets=task.targets,
        sensors=[name for name in known.layout.names if any(name in names for names in task.subsets.values())],
        subsets=task.subsets,
        seed=job.seed,
        folder=folder,
        progress=(lambda _: None) if progress is None else progress,
        arm=None if task.arm is None else task.arm[0],
        joints=None if task.arm is None else task.arm[1],
        ranks=ranks,
        **job.learning,
    )
    if model.report["interrupted"]:
        raise KeyboardInterrupt
    return model


def run_fold(job: Job, progress: Callable[[Progress], None] | None = None, ranks: Ranks | None = None) -> Values:
    """Learn from one fold and evaluate it; a finished one is read from its folder.

    Several ranks share the interactions of the fold; the first one writes and reports.
    """
    torch.set_num_threads(job.threads)
    ranks = Ranks(device=torch.device(job.device)) if ranks is None else ranks
    folder = Path(job.folder)
    finished = folder / "values.json"
    if finished.exists():
        return read_values(finished)
    demonstrations, task = job.problem()
    if job.fold is None:
        learned(job, demonstrations, task, folder, ranks, progress)
        return {}
    training, testing = split(len(demonstrations), job.folds, job.fold, job.seed, job.test)
    known, tests = demonstrations.subset(training), demonstrations.subset(testing)
    model = learned(job, known, task, folder, ranks, progress)
    primitive, layout, report = model.primitive, model.layout, model.report
    # The model may have fewer columns: of modalities that are neither shown nor asked for.
    tests = tests.assign(task.targets, model.sensors)
    members = job.learning["members"]
    filters = {
        "ebip": scaled(primitive, 1.0, members),
        "ebip_scaled": scaled(primitive, report["factor"], members),
        "ebip_tuned": model.filter,
    }
    methods = {"mean": MeanMethod(primitive), "nearest": NearestMethod(primitive)}
    mine = ranks.shard(range(len(tests)))
    answering = {name: FilterMethod(f.to(ranks.device), job.seed, mine) for name, f in filters.items()}
    shares = ranks.gather(evaluate(task, methods | answering, tests.subset(mine)))
    answers = interleave(shares)
    if not ranks.first:
        return answers
    for filter in filters.values():
        filter.cpu()
    with Monitor(folder / "tensorboard") as monitor:
        sensors = layout.mask(next(reversed(task.subsets.values())))
        shown = [dof for name in task.targets for dof in layout[name].dofs[:3]]
        for step, name in ((0, "ebip"), (report.get("best_step", 0), "ebip_tuned")):
            figure = forecast_figure({name: filters[name]}, tests, 0, sensors, shown, FRACTIONS)
            monitor.figure("forecast", figure, step)
        pair = {name: filters[name] for name in ("ebip", "ebip_tuned")}
        save_figure(forecast_figure(pair, tests, 0, sensors, shown, FRACTIONS), folder / "forecasts.png")
        seen = [name for name in layout.names if not layout[name].controlled]
        save_figure(noise_figure(model.filter, primitive.residual_variance.cpu(), layout, seen), folder / "noise.png")
        final = {
            f"final/{row['metric']}/{row['modality'] or 'all'}": row["mean"]
            for row in summarise(answers, "ebip_tuned")["summary"]
            if row["method"] == "ebip_tuned"
        }
        choices = {**report["settings"]["settings"], **report["start"], "seed": job.seed, "fold": job.fold}
        monitor.hyperparameters(choices, final)
    write_values(finished, answers)
    return answers


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    ranks = Ranks.start()
    count, test = options.demonstrations, 0.2
    learning: dict[str, Any] = {"steps": options.steps, "members": options.members, "shrink": options.shrinkage}
    if options.quick:
        learning |= {"steps": min(options.steps, 20), "scan": 12, "batch_size": 8, "validate_every": 5}
        count = min(count, 100)
    sensors, targets = (None if names is None else tuple(names) for names in (options.sensors, options.targets))
    roles = Roles(sensors, targets, options.arm, options.tip)
    ranks.from_first(lambda: load(options.data, count, options.seed, roles) and None)  # simulated once, then kept
    demonstrations, task = load(options.data, count, options.seed, roles)
    task = choose_subsets(task, demonstrations.layout, options.subsets, alone=False)
    learning["thinning"] = thinning(demonstrations)
    if options.members is not None and options.members < 2:
        raise SystemExit(f"--members must be at least 2, an ensemble needs a spread; got {options.members}")
    if options.steps < 0:
        raise SystemExit(f"--steps must be at least 0, got {options.steps}")
    settings = {
        "data": options.data,
        "demonstrations": None if options.data else count,
        "folds": options.folds,
        "test": test if options.folds == 1 else None,
        "seed": options.seed,
        **asdict(roles),
        "subsets": {name: list(names) for name, names in task.subsets.items()},
        "final": options.final,
        "learning": learning,
    }
    if not 1 <= options.folds <= len(demonstrations):
        raise SystemExit(
            f"--folds must be between 1 and the {len(demonstrations)} demonstrations, got {options.folds}"
        )
    held = round(test * len(demonstrations)) if options.folds == 1 else -(-len(demonstrations) // options.folds)
    if held < 1 or len(demonstrations) - held < 3:
        raise SystemExit(
            f"{len(demonstrations)} demonstrations with {held} held out are too few: learning needs 3 of them"
        )
    run = ranks.from_first(lambda: RunFolder("tune", settings, options.out, options.force, arguments))
    ranks.explain_on_termination(LOST.format(run.path))
    workers, threads = share_cores(options.folds, options.workers)
    threads = threads if ranks.size == 1 else torch.get_num_threads()
    first = Job(0, options.folds, options.data, count, roles, tuple(options.subsets), options.seed, test, threads,
                str(ranks.device), str(run.path), learning)  # fmt: skip
    jobs = [
        replace(first, fold=fold, folder=str(run.path / f"fold-{fold:02d}" if options.folds > 1 else run.path))
        for fold in range(options.folds)
    ]
    if ranks.first:
        print(demonstrations)
    try:
        single = len(jobs) == 1
        values = _single(jobs[0], ranks) if single else run_folds(run_fold, jobs, workers, _headline, ranks)
        if options.final:
            _single(replace(first, fold=None, folder=str(run.path / "final")), ranks)
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
    save_figure(horizons_figure(results, panels), run.path / "horizons.png")
    run.finish(results)
    print_tables(results)
    for report in results["reports"][:1]:
        print(f"state: {report['n_weights']} weights; factor on R: {report['factor']:.3g} (ebip_scaled)")
        print(report["verdict"])
    model = run.path / "final" if options.final else Path(jobs[0].folder)
    print(f"use it: torch_ebip.load_model({str(model)!r})")
    print(f"{results['seconds']:.0f} s; written to {run.path}")
    print(f"watch it: tensorboard --logdir {run.path}")


def _single(job: Job, ranks: Ranks) -> Values:
    with learning_bar(disable=not ranks.first) as show:
        return run_fold(job, show, ranks)


def _headline(values: Values) -> str:
    pairs = ((name, mean_of_cells(values, name, "mae")) for name in ("ebip_scaled", "ebip_tuned"))
    return ", ".join(f"{name} mae {mean:.4f}" for name, mean in pairs)


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("tune", __doc__)
    add_data_options(parser)
    add_role_options(parser)
    parser.add_argument(
        "--folds", type=int, default=1, help="cross-validation; 1 holds out a fifth once (default: 1)"
    )
    parser.add_argument("--steps", type=int, default=100, help="gradient steps at most (default: 100)")
    parser.add_argument(
        "--members", type=int, metavar="E", help="of ensembles (default: all demonstrations of the training part)"
    )
    parser.add_argument(
        "--no-shrinkage", dest="shrinkage", action="store_false", help="draw no forecast towards the training mean"
    )
    parser.add_argument("--final", action="store_true", help="after the study learn from all recordings, in final/")
    add_run_options(parser, "tune", "data, splits and draws", "a run of about a minute", workers=True)
    return parser


if __name__ == "__main__":
    main()
