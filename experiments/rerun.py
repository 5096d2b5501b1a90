"""Run an experiment again, from what its results say of it, and compare every number.

RUN is the folder of a finished run. Its command is run with as many threads and in the working folder that it had,
into a new folder, and the two ``results.json`` are compared number by number, times and sizes of memory excepted. On
the same machine, software and commit a run gives the same bits again. Another number of threads makes sums in
another order.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from experiments.command_line import command, experiment_parser
from torch_ebip.common.files import read_json

MEASURED = re.compile(r"seconds|_per_second|_over_|megabytes|gigabytes|exponent|time_relative|^run$")
"""Names of what a clock or the machine says, and of the run itself."""
ADDED = 1e-12
"""To the size of numbers that are compared, so that two that are nearly 0 are alike."""


class Difference(NamedTuple):
    """Two values that are not the same.

    Attributes:
        place: in the results.
        before, after: the values.
        size: relative to the larger one; infinite for what are not two numbers.
    """

    place: str
    before: Any
    after: Any
    size: float


class Comparison(NamedTuple):
    """All values of two results.

    Attributes:
        compared: how many.
        left_out: how many are times and sizes of memory.
        differing: those that are not the same, the largest difference first.
    """

    compared: int
    left_out: int
    differing: list[Difference]

    @property
    def largest(self) -> float:
        """Relative difference; 0 if all are the same."""
        return self.differing[0].size if self.differing else 0.0


def compare(before: Any, after: Any) -> Comparison:
    """Every value of two results, by its place."""
    ours, theirs = dict(_leaves(before)), dict(_leaves(after))
    kept = {place for place in {**ours, **theirs} if not any(map(MEASURED.search, place.split("/")))}
    differing = []
    for place in kept:
        a, b = ours.get(place, "nothing"), theirs.get(place, "nothing")
        if a != b:
            differing.append(Difference(place, a, b, _size(a, b)))
    differing.sort(key=lambda difference: (-difference.size, difference.place))
    return Comparison(len(kept), len({*ours, *theirs}) - len(kept), differing)


def _leaves(content: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Values that hold no others, by their place."""
    if isinstance(content, dict):
        for name, value in content.items():
            yield from _leaves(value, f"{place}/{name}" if place else name)
    elif isinstance(content, list):
        yield f"{place}/length", len(content)
        for i, value in enumerate(content):
            yield from _leaves(value, f"{place}/{i}")
    else:
        yield place, content


def _size(a: Any, b: Any) -> float:
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in (a, b))
    return abs(a - b) / (max(abs(a), abs(b)) + ADDED) if numbers else math.inf


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment again from the command line."""
    options = _parser().parse_args(arguments)
    folder = Path(options.run)
    try:
        before = read_json(folder / "results.json")
        run = before["run"]
        name, given, threads, home = (run[key] for key in ("experiment", "arguments", "threads", "working_folder"))
        line = [sys.executable, "-m", f"experiments.{name}", *map(str, given)]
        if not re.fullmatch(r"[a-z_]+", name):
            raise ValueError(f"no experiment is called {name[:80]!r}")
    except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
        raise SystemExit(f"{folder}: not a finished run that says how to run it again ({error})") from error
    out = Path(options.out) if options.out else Path("runs") / "rerun" / time.strftime("%Y%m%d-%H%M%S")
    out = out.absolute()
    if out.exists():
        raise SystemExit(f"{out} exists; choose another --out")
    if run.get("processes", 1) > 1 or run.get("resumed_with"):
        print(
            "it ran in several processes, or was resumed with other versions; now it is one process and one version"
        )
    print("+", " ".join(line[1:]), f"--out {out}")
    place = home if Path(home).is_dir() else None
    if place is None:
        print(f"its working folder {home} is not there any more; it runs in this one")
    environment = {**os.environ, "OMP_NUM_THREADS": str(int(threads))}
    done = subprocess.run([*line, "--out", str(out)], cwd=place, env=environment, check=False)
    if done.returncode != 0:
        raise SystemExit(f"the run ended with {done.returncode}")
    after = read_json(out / "results.json")
    for key in ("commit", "changed_since_commit", "versions", "machine", "threads"):
        if run.get(key) != after["run"][key]:
            print(f"{key} then: {run.get(key)}, now: {after['run'][key]}")
    comparison = compare(before, after)
    _print(comparison, options.tolerance)
    if comparison.largest > options.tolerance:
        raise SystemExit(1)


def _print(comparison: Comparison, tolerance: float) -> None:
    console = Console()
    if comparison.differing:
        table = Table(title="what differs most", title_justify="left")
        for head in ("where", "before", "after", "relative"):
            table.add_column(head, justify="left" if head == "where" else "right")
        for difference in comparison.differing[:10]:
            table.add_row(*(str(value)[:60] for value in difference[:3]), f"{difference.size:.1g}")
        console.print(table)
    same = comparison.compared - len(comparison.differing)
    print(
        f"{same} of {comparison.compared} values are the same, {comparison.left_out} of clocks and memory left out; "
        f"largest relative difference {comparison.largest:.1g}, tolerated {tolerance:g}"
    )


def _parser() -> Any:
    parser = experiment_parser("rerun", __doc__)
    parser.add_argument("run", metavar="RUN", help="folder of a finished run")
    parser.add_argument("--tolerance", type=float, default=0.0, help="relative (default: 0, the same bits)")
    parser.add_argument("--out", metavar="DIR", help="folder of the new run (default: runs/rerun/STAMP)")
    return parser


if __name__ == "__main__":
    main()
