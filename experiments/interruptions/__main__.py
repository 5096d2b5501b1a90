"""What filters say of people who pause, idle, start late, start over, or are far slower or faster than any recorded.

A filter is learned of each fold's training part; what is left out is interrupted, and the end of the interaction is
asked for during the interruption, half a second after it, and when 82 % of the interaction were seen, with all
sensors. `ebip_tuned` is what `learn` returns; `tuned_unpaced` the same without its bank of phase hypotheses; `ebip`
and `particle_filter` are the paper's. Without --data the recordings are the simulated ball catching.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from experiments.command_line import add_data_options, add_run_options, command, experiment_parser
from experiments.data import load
from experiments.folds import in_processes, share_cores, split
from experiments.interruptions.animation import film
from experiments.interruptions.jobs import METHODS, Answers, Job, Plan, all_of, run_fold
from experiments.interruptions.picture import interruptions_figure
from experiments.interruptions.table import markdown, print_table, summarise
from experiments.run_folder import RunFolder, save_figure
from torch_ebip import Demonstrations, load_model
from torch_ebip.common.files import atomic_write


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    count, folds, steps, scan = options.demonstrations, options.folds, options.steps, 48
    if options.quick:
        count, folds, steps, scan = min(count, 40), 1, min(steps, 5), 8
    if folds < 1:
        raise SystemExit("needs --folds of at least 1")
    methods = tuple(options.methods)
    plan = Plan("", options.data, count, folds, methods, steps, scan, options.members, options.seed)
    demonstrations, task = load(plan.data, plan.demonstrations, plan.seed)
    print(demonstrations)
    run = RunFolder("interruptions", plan.settings(), options.out, options.force, arguments)
    plan = replace(plan, folder=str(run.path))
    jobs = [Job(plan, fold) for fold in range(folds)]
    parts: list[Answers] = [[] for _ in jobs]
    workers, _ = share_cores(len(jobs), options.workers)
    with tqdm(total=len(jobs), desc="folds", unit="fold", dynamic_ncols=True) as bar:
        for i, part in in_processes(run_fold, jobs, workers):
            parts[i] = part
            bar.set_postfix_str(_headline(all_of(parts), methods[0]), refresh=False)
            bar.update()
    rows = summarise(all_of(parts), demonstrations.layout[task.targets[0]].unit, plan.seed)
    results = {
        "experiment": "interruptions",
        "dataset": {
            "source": options.data or "simulated ball catching",
            "demonstrations": len(demonstrations),
            "target": task.targets[0],
        },
        "rows": rows,
        "seconds": round(time.monotonic() - began, 1),
    }
    save_figure(interruptions_figure(rows), run.path / "interruptions.png")
    with atomic_write(run.path / "results.md") as file:
        file.write(markdown(rows).encode())
    if options.film:
        _film(plan, demonstrations)
    run.finish(results)
    print_table(rows)
    print(f"{results['seconds']:.0f} s; written to {run.path}")


def _film(plan: Plan, demonstrations: Demonstrations) -> None:
    """Of the first fold's model and the first of its test interactions."""
    _, testing = split(len(demonstrations), plan.folds, 0, plan.seed)
    model = load_model(Path(plan.folder) / "fold-00" / "learned")
    if model.filter.pace is None:
        print("no film: the model of the first fold has no bank of phase hypotheses, see its report")
        return
    film(model, model.prepare(demonstrations.subset(testing[:1])), Path(plan.folder) / "pause.gif", seed=plan.seed)


def _headline(answers: Answers, method: str) -> str:
    """The error of one method, undisturbed and interrupted."""
    late = [a for a in answers if a["method"] == method and a["moment"] == "late"]
    errors = [
        np.nanmean([a["error"] for a in late if (a["kind"] == "undisturbed") is calm]) for calm in (True, False)
    ]
    return f"{method}: {errors[0]:.3g}, interrupted {errors[1]:.3g}"


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("interruptions", __doc__)
    add_data_options(parser)
    parser.add_argument("--folds", type=int, default=5, help="of the cross-validation (default: 5)")
    parser.add_argument(
        "--methods", nargs="+", choices=list(METHODS), default=list(METHODS), metavar="METHOD",
        help=f"of {', '.join(METHODS)} (default: all)",
    )  # fmt: skip
    parser.add_argument("--members", type=int, default=None, metavar="E", help="of ensembles (default: all)")
    parser.add_argument("--film", action="store_true", help="draw a film of a pause, pause.gif")
    parser.add_argument("--steps", type=int, default=100, help="gradient steps at most (default: 100)")
    add_run_options(parser, "interruptions", "data, interruptions and draws", "a run of a minute", workers=True)
    return parser


if __name__ == "__main__":
    main()
