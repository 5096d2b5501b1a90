"""Feed everything that reads a file with damaged and hostile ones, and count what becomes of them.

Recordings, tables, descriptions, robots, checkpoints, recorded sessions and what experiments keep are cut off, their
bits flipped, their pieces moved; types and shapes are wrong, pickles are planted, archives swell, entities multiply,
and links, pipes and devices stand where files should. A case is read, or refused by an error that names the file;
anything else is a failure: another exception, a signal, too much time or memory (crashed), a planted file
that appeared (executed), a file that changed (overwritten). With any of these the exit status is 1.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from experiments.command_line import add_run_options, command, experiment_parser
from experiments.fuzz.campaign import VERDICTS, Tally, run_kind
from experiments.fuzz.kinds import KINDS
from experiments.fuzz.worker import MEMORY
from experiments.run_folder import RunFolder


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the campaign from the command line."""
    options = _parser().parse_args(arguments)
    names = list(dict.fromkeys(options.kinds.split(",")))
    unknown = [name for name in names if name not in KINDS]
    if unknown:
        raise SystemExit(f"--kinds: {', '.join(unknown)} unknown; there are {', '.join(KINDS)}")
    rounds = min(options.rounds, 5) if options.quick else options.rounds
    if rounds < 0 or options.limit <= 0:
        raise SystemExit("needs --rounds of at least 0 and a positive --limit")
    torch.set_num_threads(1)  # a worker is forked, and threads are not
    began = time.monotonic()
    settings = {
        "kinds": names,
        "seed": options.seed,
        "rounds": rounds,
        "quick": options.quick,
        "limit": options.limit,
    }
    run = RunFolder("fuzz", settings, options.out, options.force, arguments)
    tallies: dict[str, Tally] = {}
    with tempfile.TemporaryDirectory() as folder, tqdm(desc="cases", unit="case", dynamic_ncols=True) as bar:
        for name in names:
            bar.set_description(name)
            tallies[name] = run_kind(
                KINDS[name], Path(folder) / name, options.seed, rounds, options.quick, options.limit, bar.update
            )
            bad = sum(len(tally.failures) for tally in tallies.values())
            bar.set_postfix_str(f"failures {bad}")
    results = {**summarise(tallies), "seconds": round(time.monotonic() - began, 1)}
    run.finish(results)
    _print(results)
    print(f"{results['seconds']:.0f} s; written to {run.path}")
    if results["failures"]:
        raise SystemExit(1)


def summarise(tallies: Mapping[str, Tally]) -> dict[str, Any]:
    """Counts by kind and of all kinds, and every failure."""
    rows = [
        {
            "kind": name,
            "cases": tally.cases,
            **{verdict: tally.counts[verdict] for verdict in VERDICTS},
            "slowest_seconds": round(tally.seconds, 3),
            "slowest": tally.slowest,
            "peak_megabytes": round(tally.megabytes, 1),
        }
        for name, tally in tallies.items()
    ]
    total = {
        "kind": "all",
        **{name: sum(row[name] for row in rows) for name in ("cases", *VERDICTS)},
        **{name: max(row[name] for row in rows) for name in ("slowest_seconds", "peak_megabytes")},
    }
    return {
        "experiment": "fuzz",
        "memory_limit_megabytes": MEMORY >> 20,
        "kinds": rows,
        "total": total,
        "failures": [failure for tally in tallies.values() for failure in tally.failures],
    }


def _print(results: Mapping[str, Any]) -> None:
    table = Table(title="what became of damaged and hostile files", title_justify="left")
    table.add_column("kind")
    for head in ("cases", *VERDICTS, "slowest s", "peak MB"):
        table.add_column(head, justify="right")
    for row in [*results["kinds"], results["total"]]:
        counts = [str(row[name]) for name in ("cases", *VERDICTS)]
        table.add_row(row["kind"], *counts, f"{row['slowest_seconds']:.2f}", f"{row['peak_megabytes']:.0f}")
    console = Console()
    console.width = max(console.width, 120)
    console.print(table)
    for failure in results["failures"]:
        where = f"{failure['kind']}, {failure['mutation']}, seed {failure['seed']}"
        console.print(f"{failure['verdict']}: {where}: {failure['message']}", markup=False)


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("fuzz", __doc__)
    parser.add_argument(
        "--kinds", default=",".join(KINDS), metavar="A,B", help=f"kinds of files (default: {','.join(KINDS)})"
    )
    parser.add_argument("--rounds", type=int, default=100, help="of each sort of random damage (default: 100)")
    parser.add_argument("--limit", type=float, default=20.0, metavar="S", help="seconds a case (default: 20)")
    add_run_options(parser, "fuzz", "random damage", "a small campaign", resumes=False)
    return parser


if __name__ == "__main__":
    main()
