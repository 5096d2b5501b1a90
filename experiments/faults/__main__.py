"""What filters say when sensors misbehave: lost, back again, frozen, spiked, drifting, late, swapped.

Held-out interactions with one fault each, all sensors shown, every second sample, 82 % of the interaction; error and
coverage of the forecast of the end. `ebip_tuned` is tuned by gradient first, on clean interactions; `tuned_student`,
`tuned_huber` and `tuned_gate` are the same filter with robust updates switched on, nothing tuned again; `ebip`, `bip`
and `particle_filter` are the paper's; `ebip_student` is the paper's with robust updates. Spikes and drifts are in
standard deviations of each degree of freedom over the demonstrations. Without --data the recordings are the
simulated ball catching.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from statistics import median

from experiments.bars import learning_bar
from experiments.command_line import add_data_options, add_run_options, command, experiment_parser
from experiments.faults.faults import GROUPS
from experiments.faults.jobs import ASKED, METHODS, PORTION, Job, Plan, Study, run_portion
from experiments.faults.picture import faults_figure
from experiments.faults.table import markdown, print_table, summarise
from experiments.folds import run_folds, share_cores
from experiments.results import Values
from experiments.run_folder import RunFolder, save_figure
from torch_ebip.common.files import atomic_write

DEFAULT = ("ebip_tuned", "tuned_student", "ebip", "ebip_student", "particle_filter", "bip")
STARTS = (0.2, 0.43, 0.6)
"""Shares of an interaction at which sensors are lost: before, in and after the wind-up."""


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    count, tests, steps, scan, starts = options.demonstrations, options.tests, options.steps, 24, STARTS
    if options.quick:
        count, tests, steps, scan, starts = min(count, 60), min(tests, 2), min(steps, 5), 8, STARTS[1:2]
    if tests < 1 or options.members < 2:
        raise SystemExit("needs --tests of at least 1 and --members of at least 2")
    needed = ["clean", *(["without"] if "lost" in (options.faults or ()) else [])]  # what costs are measured by
    groups = None if options.faults is None else tuple(dict.fromkeys([*needed, *options.faults]))
    plan = Plan("", options.data, count, tests, tuple(options.methods), groups, starts, options.members, options.seed)
    study = Study(plan)
    run = RunFolder("faults", {**plan.settings(), "steps": steps}, options.out, options.force, arguments)
    study.plan = plan = replace(plan, folder=str(run.path))
    print(study.known)
    if any("tuned" in name for name in plan.methods):
        with learning_bar() as show:
            study.learn(steps, scan, show)
    total, target = len(study.tests), study.task.targets[0]
    jobs = [Job(plan, first, min(first + PORTION, total)) for first in range(0, total, PORTION)]
    workers, _ = share_cores(len(jobs), options.workers)

    def headline(values: Values) -> str:
        """Error of the first method on clean recordings, and with half of the faults."""
        errors = {
            c.subset: m[plan.methods[0]].mean()
            for c, m in values.items()
            if (c.metric, c.modality) == ("mse", target)
        }
        return f"{plan.methods[0]}: clean {errors['clean']:.3f}, median of the faults {median(errors.values()):.3f}"

    results = {
        "experiment": "faults",
        "dataset": {
            "source": options.data or "simulated ball catching",
            "demonstrations": len(study.known) + len(study.tests),
            "tests": total,
        },
        **summarise(run_folds(run_portion, jobs, workers, headline), study.faults, target, plan.seed),
        "seconds": round(time.monotonic() - began, 1),
    }
    save_figure(faults_figure(results, plan.methods[0]), run.path / "faults.png")
    with atomic_write(run.path / "results.md") as file:
        file.write(markdown(results).encode())
    run.finish(results)
    print_table(results)
    print(f"{results['seconds']:.0f} s; written to {run.path}")


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("faults", __doc__)
    add_data_options(parser)
    parser.add_argument("--tests", type=int, default=44, metavar="N", help="held-out interactions (default: 44)")
    parser.add_argument(
        "--methods", nargs="+", choices=list(METHODS), default=list(DEFAULT), metavar="METHOD",
        help=f"of {', '.join(METHODS)} (default: {', '.join(DEFAULT)}); bip, the slowest, filters "
        f"{ASKED} interactions of {PORTION}",
    )  # fmt: skip
    parser.add_argument(
        "--faults", nargs="+", choices=GROUPS, metavar="GROUP", help=f"of {', '.join(GROUPS)} (default: all)"
    )
    parser.add_argument("--members", type=int, default=80, metavar="E", help="of ensembles (default: 80)")
    parser.add_argument("--steps", type=int, default=100, help="gradient steps at most (default: 100)")
    add_run_options(parser, "faults", "data, faults and draws", "a run of a minute", workers=True)
    return parser


if __name__ == "__main__":
    main()
