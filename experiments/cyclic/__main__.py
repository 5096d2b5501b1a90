"""What a phase on a circle is worth where people wave: two to six times, faster and slower, larger and smaller.

Recordings are made up: of each set of people, with a movement of its own, `learn` gets some, and others are asked
for: after every sample of the hand, where the partner's will be a tenth, a quarter and half a second later. Once all
recordings begin where a wave does, once anywhere in it. `ebip_tuned` is what `learn` returns, which finds out itself
that people wave; `tuned_once` the same with a phase that goes on once; `ebip_circle` and `ebip_once` are the paper's
filter with either phase and the best factor on its R.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from experiments.command_line import add_run_options, command, experiment_parser
from experiments.cyclic.jobs import BEGINNINGS, METHODS, Answers, Job, run_set
from experiments.cyclic.picture import cyclic_figure
from experiments.cyclic.table import markdown, print_table, summarise
from experiments.folds import in_processes, share_cores
from experiments.run_folder import RunFolder, save_figure
from torch_ebip.common.files import atomic_write


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    sets, known, tests, steps, scan = options.sets, options.demonstrations, options.tests, options.steps, 48
    beginnings = BEGINNINGS
    if options.quick:
        sets, known, tests, steps, scan = 1, min(known, 14), min(tests, 4), 0, 4
        beginnings = BEGINNINGS[-1:]
    if sets < 1 or known < 3 or tests < 2:
        raise SystemExit("needs --sets of at least 1, --demonstrations of at least 3 and --tests of at least 2")
    first = Job("", options.seed, BEGINNINGS[0], known, tests, steps, scan, options.seed)
    run = RunFolder("cyclic", {**first.settings(), "sets": sets}, options.out, options.force, arguments)
    jobs = [
        replace(first, folder=str(run.path), movement=options.seed + s, beginning=beginning)
        for beginning in beginnings
        for s in range(sets)
    ]
    for job in jobs:
        job.place.mkdir(exist_ok=True)
    parts: list[Answers] = [[] for _ in jobs]
    workers, _ = share_cores(len(jobs), options.workers)
    with tqdm(total=len(jobs), desc="sets of people", unit="set", dynamic_ncols=True) as bar:
        for i, part in in_processes(run_set, jobs, workers):
            parts[i] = part
            bar.set_postfix_str(_headline(parts), refresh=False)
            bar.update()
    rows = summarise([answer for part in parts for answer in part], options.seed)
    results = {
        "experiment": "cyclic",
        "dataset": {"source": "waves", "sets": sets, "known": known, "tests": tests},
        "rows": rows,
        "seconds": round(time.monotonic() - began, 1),
    }
    save_figure(cyclic_figure(rows, jobs[0]), run.path / "cyclic.png")
    with atomic_write(run.path / "results.md") as file:
        file.write(markdown(rows).encode())
    run.finish(results)
    print_table(rows)
    print(f"{results['seconds']:.0f} s; written to {run.path}")


def _headline(parts: list[Answers]) -> str:
    """Errors of both tuned filters half a second ahead."""
    last = [answer for part in parts for answer in part if answer["ahead"] == 0.5]
    errors = [
        100 * np.sqrt(np.mean([answer["squared"] for answer in last if answer["method"] == method]))
        for method in METHODS[:2]
    ]
    return f"0.5 s ahead: circle {errors[0]:.2f} cm, once {errors[1]:.2f} cm"


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("cyclic", __doc__)
    parser.add_argument("--sets", type=int, default=3, help="of people, each with a movement of its own (default: 3)")
    parser.add_argument("--demonstrations", type=int, default=60, metavar="N", help="to learn from (default: 60)")
    parser.add_argument("--tests", type=int, default=30, metavar="N", help="others who are asked for (default: 30)")
    parser.add_argument("--steps", type=int, default=100, help="gradient steps at most (default: 100)")
    add_run_options(parser, "cyclic", "people and draws", "a run of a minute", workers=True)
    return parser


if __name__ == "__main__":
    main()
