"""What the commands of all experiments have in common: how they end, where a run goes, what it starts from."""

from __future__ import annotations

import argparse
import io
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from functools import wraps

from experiments.interrupts import interruptible

GOES_ON = "what is finished is kept: a run that resumes goes on with the same --out"


def command(main: Callable[[list[str] | None], None]) -> Callable[[list[str] | None], None]:
    """A main function that says in a line what ends it without being its fault: Ctrl-C, a disk, a process that died.

    What a terminal cannot show it shows as it can.

    Raises:
        SystemExit: then.
    """

    @wraps(main)
    def run(arguments: list[str] | None = None) -> None:
        """See the function itself."""
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="replace")
        threading.excepthook = _in_a_line
        alone = arguments is None and "TORCHELASTIC_RUN_ID" not in os.environ  # torchrun ends its processes itself
        try:
            with interruptible() if alone else nullcontext():
                main(arguments)
        except BrokenProcessPool as error:
            raise SystemExit(
                f"one of the processes of this run died, perhaps for lack of memory; {GOES_ON}"
            ) from error
        except OSError as error:
            raise SystemExit(f"{error}; {GOES_ON}") from error
        finally:
            threading.excepthook = threading.__excepthook__

    return run


def _in_a_line(failure: threading.ExceptHookArgs) -> None:
    """What a thread died of: of a disk, as TensorBoard's writer may, without its stack."""
    if issubclass(failure.exc_type, OSError):
        print(failure.exc_value, file=sys.stderr)
    else:
        threading.__excepthook__(failure)


def experiment_parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """The parser of ``python -m experiments.NAME``, without options of its own."""
    return argparse.ArgumentParser(
        prog=f"python -m experiments.{name}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_data_options(parser: argparse.ArgumentParser) -> None:
    """``--data`` and ``--demonstrations``."""
    parser.add_argument(
        "--data", metavar="PATH", help="recordings: an .npz, or a folder of CSV files (default: simulated)"
    )
    parser.add_argument("--demonstrations", type=int, default=221, metavar="N", help="simulated ones (default: 221)")


def add_role_options(parser: argparse.ArgumentParser) -> None:
    """``--sensors``, ``--targets``, ``--subsets``, ``--arm`` and ``--tip``."""
    parser.add_argument(
        "--sensors", nargs="+", metavar="NAME", help="with --data: modalities that are shown (default: all others)"
    )
    parser.add_argument(
        "--targets", nargs="+", metavar="NAME", help="with --data: those to forecast (default: what is controlled)"
    )
    parser.add_argument(
        "--subsets", nargs="+", default=[], metavar="SUBSET",
        help="sensors shown together, modality names joined by +, or `all` (default: those of the paper, or all)",
    )  # fmt: skip
    parser.add_argument(
        "--arm", metavar="URDF", help="with --data: arm whose joints are a target, for the tool's loss"
    )
    parser.add_argument("--tip", metavar="LINK", help="link of the arm that carries the tool")


def add_run_options(
    parser: argparse.ArgumentParser, name: str, seed: str, quick: str, workers: bool = False, resumes: bool = True
) -> None:
    """``--seed``, ``--quick``, ``--workers``, ``--out`` and ``--force``.

    Args:
        parser: to add them to.
        name: of the experiment.
        seed: what is drawn from it.
        quick: how long a quick run takes.
        workers: whether it works in several processes.
        resumes: whether an unfinished run goes on.
    """
    parser.add_argument("--seed", type=int, default=0, help=f"of {seed} (default: 0)")
    parser.add_argument("--quick", action="store_true", help=f"{quick}, to see that all works")
    if workers:
        parser.add_argument("--workers", type=int, help="processes, without torchrun (default: one a core)")
    goes_on = "; resumes an unfinished run" if resumes else ""
    parser.add_argument("--out", metavar="DIR", help=f"run folder (default: runs/{name}/STAMP){goes_on}")
    parser.add_argument("--force", action="store_true", help="start over, also where --out holds a finished run")
