"""Table I: every method of the paper, tuned ones and baselines, by cross-validation.

Methods: `bip`, `particle_filter`, `ebip_minus` and `ebip` are the paper's; `ebip_scaled` is eBIP with R times the
best single factor; `ebip_tuned` and `particle_filter_tuned` are tuned by gradient; all of that happens inside each
fold, never on its test part. `mean`, `nearest`, `ridge`, `trees`, `trees_untold` (not told which share they see),
`gru` and, for the simulated ball, `ballistic` are what one would try without a filter. Without --data the recordings
are the simulated ball catching.

`torchrun --nproc-per-node K -m experiments.compare` shares the folds among K processes; the result is the same.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from experiments import moveint
from experiments.command_line import add_data_options, add_run_options, command, experiment_parser
from experiments.data import choose_subsets, load, thinning
from experiments.entries import METHODS, WITHOUT, Fold, without
from experiments.evaluate import evaluate
from experiments.figures import horizons_figure, results_figure
from experiments.folds import LOST, mean_of_cells, read_values, run_folds, share_cores, split, write_values
from experiments.paper_table import paper_rows
from experiments.readouts import READOUTS
from experiments.results import Values, markdown, print_tables, summarise
from experiments.run_folder import RunFolder, save_figure
from torch_ebip import TuningSettings
from torch_ebip.common.files import atomic_write, read_json, write_json
from torch_ebip.learning.ranks import RankLostError, Ranks

ALL = METHODS | {name: without(name) for name in WITHOUT} | READOUTS
"""All that can be asked for."""


@dataclass(frozen=True)
class Job:
    """One fold: everything a worker needs."""

    fold: int
    folds: int
    data: str | None
    demonstrations: int
    subsets: tuple[str, ...]
    methods: tuple[str, ...]
    members: int | None
    seed: int
    scan: int
    threads: int
    device: str
    folder: str
    tuning: TuningSettings


def run_fold(job: Job) -> Values:
    """Build and evaluate every method of one fold; what is finished is read from the fold's folder."""
    torch.set_num_threads(job.threads)
    device = torch.device(job.device)
    folder = Path(job.folder)
    demonstrations, task = load(job.data, job.demonstrations, job.seed)
    task = choose_subsets(task, demonstrations.layout, job.subsets, alone=job.data is not None)
    training, testing = split(len(demonstrations), job.folds, job.fold, job.seed)
    known, tests = demonstrations.subset(training), demonstrations.subset(testing)
    fold: Fold | None = None
    merged: Values = {}
    for name in job.methods:
        finished = folder / f"{name}.json"
        if not finished.exists():
            began = time.monotonic()
            if fold is None:
                fold = Fold.of(known, task, job.seed, job.tuning, folder, job.members, job.scan, device)
            method = ALL[name](fold)
            built = time.monotonic()
            values = {} if method is None else evaluate(task, {name: method}, tests)
            seconds = {"building": round(built - began, 2), "answering": round(time.monotonic() - built, 2)}
            write_json(folder / f"{name}-seconds.json", seconds)
            write_values(finished, values)
        for cell, methods in read_values(finished).items():
            merged.setdefault(cell, {}).update(methods)
    return merged


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    if options.protocol == "moveint":
        moveint.run(options, arguments)
        return
    if options.reference is not None and options.reference not in options.methods:
        raise SystemExit(f"--reference {options.reference} must be one of --methods, got {' '.join(options.methods)}")
    began = time.monotonic()
    ranks = Ranks.start()
    tuning = TuningSettings(seed=options.seed, steps=options.steps)
    count, scan = options.demonstrations, 24
    if options.quick:
        tuning = replace(tuning, steps=min(options.steps, 10), batch_size=8, validate_every=5)
        count, scan = min(count, 60), 8
    ranks.from_first(lambda: load(options.data, count, options.seed) and None)  # simulated once, then kept
    demonstrations, task = load(options.data, count, options.seed)
    task = choose_subsets(task, demonstrations.layout, options.subsets, alone=options.data is not None)
    tuning = replace(tuning, thinning=thinning(demonstrations))
    folds = min(options.folds, 3) if options.quick else options.folds
    if not 2 <= folds <= len(demonstrations):
        raise SystemExit(f"--folds must be between 2 and the {len(demonstrations)} demonstrations, got {folds}")
    if len(demonstrations) - -(-len(demonstrations) // folds) < 2 * tuning.folds:
        raise SystemExit(
            f"{len(demonstrations)} demonstrations in {folds} folds are too few: tuning filters the training part "
            f"in {tuning.folds} folds of its own, and needs {2 * tuning.folds} of them"
        )
    if options.members is not None and options.members < 2:
        raise SystemExit(f"--members must be at least 2, an ensemble needs a spread; got {options.members}")
    settings = {
        "data": options.data,
        "demonstrations": None if options.data else count,
        "folds": folds,
        "methods": options.methods,
        "subsets": {name: list(names) for name, names in task.subsets.items()},
        "members": options.members,
        "seed": options.seed,
        "scan": scan,
        "tuning": asdict(tuning),
    }
    run = ranks.from_first(lambda: RunFolder("compare", settings, options.out, options.force, arguments))
    ranks.explain_on_termination(LOST.format(run.path))
    workers, threads = share_cores(folds, options.workers)
    threads = threads if ranks.size == 1 else torch.get_num_threads()
    jobs = [
        Job(fold, folds, options.data, count, tuple(options.subsets), tuple(options.methods), options.members,
            options.seed, scan, threads, str(ranks.device), str(run.path / f"fold-{fold:02d}"), tuning)
        for fold in range(folds)
    ]  # fmt: skip
    if ranks.first:
        print(demonstrations)
    shown = [name for name in ("ebip_tuned", "ebip_scaled", "trees") if name in options.methods][:2]

    def headline(values: Values) -> str:
        """Mean absolute error of a few methods over all cells so far."""
        return ", ".join(f"{name} mae {mean_of_cells(values, name, 'mae'):.4f}" for name in shown)

    try:
        values = run_folds(run_fold, jobs, workers, headline, ranks)
    except (ValueError, ImportError) as error:
        raise SystemExit(f"{run.path}: {error}") from error
    except RankLostError as error:
        raise SystemExit(f"{error}\n{LOST.format(run.path)}") from error
    ranks.stop()
    if not ranks.first:
        return
    seconds: dict[str, float] = {}
    for path in sorted(run.path.glob("fold-*/*-seconds.json")):
        spent = sum(read_json(path).values())
        name = path.name.removesuffix("-seconds.json")
        seconds[name] = round(seconds.get(name, 0.0) + spent, 1)
    results = {
        "experiment": "compare",
        "dataset": {
            "source": options.data or "simulated ball catching",
            "demonstrations": len(demonstrations),
            "dofs": demonstrations.layout.n_dofs,
            "rate": demonstrations.rate,
            "folds": folds,
        },
        **summarise(values, options.reference),
        **({} if options.data else {"paper": paper_rows()}),
        "seconds_by_method": seconds,
        "seconds": round(time.monotonic() - began, 1),
    }
    panels: list[tuple[str, str | None]] = [(metric, m) for m in task.targets for metric in ("mae",)]
    if task.arm is not None:
        panels = [("mse", "robot"), ("mae", "ball"), ("tool_error", None)]
    panels.append(("coverage_95", task.targets[0]))
    with atomic_write(run.path / "results.md") as file:
        file.write(markdown(results).encode())
    save_figure(results_figure(results, panels), run.path / "results.png")
    save_figure(horizons_figure(results, panels), run.path / "horizons.png")
    run.finish(results)
    print_tables(results, only=panels)
    print(f"all tables: {run.path / 'results.md'}")
    print(f"{results['seconds']:.0f} s; written to {run.path}")


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("compare", __doc__)
    add_data_options(parser)
    parser.add_argument("--folds", type=int, default=10, help="of the cross-validation (default: 10)")
    parser.add_argument(
        "--methods", nargs="+", choices=list(ALL), default=list(METHODS), metavar="METHOD",
        help=f"which to compare (default: {', '.join(METHODS)}; what each part of the tuned filter gives: "
        f"{', '.join(WITHOUT)}; of its read-out: {', '.join(READOUTS)})",
    )  # fmt: skip
    parser.add_argument(
        "--subsets", nargs="+", default=[], metavar="SUBSET",
        help="sensors shown together, modality names joined by +, or `all` "
        "(default: those of the paper; with --data each modality alone, and all)",
    )  # fmt: skip
    parser.add_argument(
        "--protocol", choices=("folds", "moveint"), default="folds",
        help="how: cross-validation, or the protocol of MoVEInt, see experiments/moveint.py (default: folds)",
    )  # fmt: skip
    parser.add_argument(
        "--reference", choices=list(ALL), metavar="METHOD",
        help="compare all others with this one of the methods (default: with the best of each cell)",
    )  # fmt: skip
    parser.add_argument("--members", type=int, metavar="E", help="of ensembles (default: N of the training part)")
    parser.add_argument(
        "--steps", type=int, default=100, help="gradient steps of a tuned filter at most (default: 100)"
    )
    add_run_options(parser, "compare", "data, splits and draws", "a small run of a few minutes", workers=True)
    return parser


if __name__ == "__main__":
    main()
