"""Let the arm catch: a filter that forecasts against others, and against a catcher that only reacts.

Throws under two conditions, aimed and blindfolded, in a MuJoCo scene with the UR5, its delays and limits. Filters
work with ensembles of 80 demonstrations; `ebip_tuned` is tuned by gradient first, `ebip_tuned_all` is the same with
all demonstrations, `ebip` the paper's closed form, `ebip_scaled` its R times the best factor, `mean` plays the mean
demonstration, `reactive` sees the ball only, but knows its physics and the arm's kinematics.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from pathlib import Path

from experiments.ball_catching.scene.model import load_mujoco
from experiments.bars import learning_bar
from experiments.catch.controllers import LEAD
from experiments.catch.jobs import METHODS, Plan, as_settings, run_all
from experiments.catch.learning import learn
from experiments.catch.table import markdown, print_table, summarise
from experiments.catch.throws import DISTURBANCES, LATENCY
from experiments.command_line import add_run_options, command, experiment_parser
from experiments.run_folder import RunFolder
from torch_ebip.common.files import atomic_write, read_json
from torch_ebip.learning.interaction_model import NAME

GROUPS = {"imu": ("imu_acceleration", "imu_gyro"), "shoes": ("shoe_left", "shoe_right")}
"""Names of sensors that are one object, beside the single ones."""


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    load_mujoco()
    began = time.monotonic()
    throws, demonstrations, steps = options.throws, options.demonstrations, options.steps
    if options.quick:
        throws, demonstrations, steps = min(throws, 6), min(demonstrations, 60), min(steps, 5)
    if throws < 1 or demonstrations < 30 or not 0 < options.arm <= 1:
        raise SystemExit("needs --throws of at least 1, --demonstrations of at least 30 and --arm between 0 and 1")
    methods = _methods(options.methods)
    sensors, share = _drop(options.drop)
    lead = _lead(options.lead)
    plan = Plan("", throws, demonstrations, options.seed, lead, options.arm, sensors, share, options.disturb)
    settings = {**as_settings(plan, methods), "steps": steps, "filter": options.filter}
    taken = {} if options.filter is None else _take(Path(options.filter), plan)
    run = RunFolder("catch", settings, options.out, options.force, arguments)
    plan = Plan(
        str(run.path), throws, demonstrations, options.seed, lead, options.arm, sensors, share, options.disturb
    )
    if options.filter is None:
        with learning_bar() as show:
            learn(run.path, demonstrations, options.seed, steps, show)
    for name, content in taken.items():
        with atomic_write(run.path / name) as file:
            file.write(content)
    results = run_all(plan, methods, options.workers or os.cpu_count() or 1)
    summary = {
        "experiment": "catch",
        "dataset": {"source": "simulated ball catching", "demonstrations": demonstrations, "throws": throws},
        **summarise(results, methods[0]),
    }
    if not options.no_pictures:
        from experiments.catch.pictures import draw_pictures

        draw_pictures(plan, methods[0], results, run.path)
    with atomic_write(run.path / "results.md") as file:
        file.write(markdown(summary).encode())
    summary["seconds"] = round(time.monotonic() - began, 1)
    run.finish(summary)
    print_table(summary)
    print(f"{summary['seconds']:.0f} s; written to {run.path}")


def _methods(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(text.split(",")))
    unknown = [name for name in names if name not in METHODS]
    if unknown:
        raise SystemExit(f"--methods: {', '.join(unknown)} unknown; there are {', '.join(METHODS)}")
    return names


def _drop(text: str | None) -> tuple[tuple[str, ...], float]:
    """Names of the sensors to cut off, and the share of the throw from which on."""
    if text is None:
        return (), 0.0
    name, _, when = text.partition("@")
    try:
        share = float(when)
    except ValueError:
        share = -1.0
    sensors = GROUPS.get(name, (name,))
    if not 0 <= share <= 1 or not set(sensors) <= set(LATENCY):
        known = ", ".join([*GROUPS, *LATENCY])
        raise SystemExit(f"--drop expects SENSOR@SHARE, a share between 0 and 1 and one of {known}; got {text!r}")
    return sensors, share


def _lead(text: str) -> float | None:
    try:
        seconds = None if text == "end" else float(text)
    except ValueError:
        seconds = math.nan
    if seconds is not None and not 0 <= seconds < math.inf:
        raise SystemExit(f"--lead expects seconds or 'end', got {text!r}")
    return seconds


def _take(source: Path, plan: Plan) -> dict[str, bytes]:
    """The files of another run's tuned filter, which must have been tuned on the same demonstrations."""
    try:
        theirs = read_json(source / "config.json")["settings"]
        content = {name: (source / name).read_bytes() for name in (NAME, "report.json")}
        there = theirs["demonstrations"], theirs["seed"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SystemExit(f"--filter {source}: no finished tuning of experiments.catch ({error})") from error
    if there != (plan.demonstrations, plan.seed):
        raise SystemExit(
            f"--filter {source}: tuned on {there[0]} demonstrations of seed {there[1]}, "
            f"not on {plan.demonstrations} of seed {plan.seed}"
        )
    return content


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("catch", __doc__)
    parser.add_argument("--throws", type=int, default=200, metavar="N", help="for each condition (default: 200)")
    parser.add_argument(
        "--methods",
        default=",".join(METHODS),
        metavar="A,B",
        help=f"default: {','.join(METHODS)}; tests are against the first",
    )
    parser.add_argument(
        "--drop", metavar="SENSOR@SHARE", help="a sensor that falls silent at that share of each throw, as in imu@0.3"
    )
    parser.add_argument(
        "--disturb",
        choices=DISTURBANCES,
        help="every second thrower hesitates for 0.3 to 1 s in the wind-up, or the sensors of every second throw "
        "start when it is under way, a fifth to a half of the way to the release",
    )
    parser.add_argument(
        "--arm",
        type=float,
        default=1.0,
        metavar="SHARE",
        help="an arm of that share of the UR5's speed and acceleration (default: 1)",
    )
    parser.add_argument(
        "--lead",
        default=str(LEAD),
        metavar="S",
        help=f"how far ahead, in seconds, the arm is led; 'end': to the expected end (default: {LEAD})",
    )
    parser.add_argument("--demonstrations", type=int, default=221, metavar="N", help="to learn from (default: 221)")
    parser.add_argument("--steps", type=int, default=100, help="gradient steps at most (default: 100)")
    parser.add_argument("--filter", metavar="RUN", help="take the tuned filter of another run of this experiment")
    parser.add_argument("--no-pictures", action="store_true", help="neither the strip nor the animation")
    add_run_options(parser, "catch", "demonstrations, throws and draws", "a run of a minute or two", workers=True)
    return parser


if __name__ == "__main__":
    main()
