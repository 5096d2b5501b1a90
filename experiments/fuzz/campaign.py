"""All cases of a kind: made, read in a worker, and looked after: what was executed, what was overwritten."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from random import Random
from typing import Any

from experiments.fuzz.kinds import Kind
from experiments.fuzz.mutations import CUTS, Mutation, cuts, flips, places, splices
from experiments.fuzz.worker import Outcome, Worker

VERDICTS = ("read", "refused", "crashed", "executed", "overwritten")
LARGE = 1 << 26
"""Bytes of a file of which not the content but the dates are compared."""


@dataclass
class Tally:
    """What became of the cases of a kind.

    Attributes:
        counts: of cases by verdict; one may have been executed and crashed.
        cases: how many there were.
        seconds, megabytes: most that any case took.
        slowest: which it was.
        failures: kind, mutation, seed and message of every case that was not read or refused.
    """

    counts: Counter[str] = field(default_factory=Counter)
    cases: int = 0
    seconds: float = 0.0
    megabytes: float = 0.0
    slowest: str = ""
    failures: list[dict[str, Any]] = field(default_factory=list)


def mutations(kind: Kind, folder: Path, size: int, seed: int, rounds: int, quick: bool) -> Iterator[Mutation]:
    """All changes of a file of that size; ``canary`` in the folder is what planted code would make."""
    yield from places(os.geteuid() == 0)
    yield from cuts(size, 8 if quick else CUTS)
    yield from flips(rounds, seed)
    yield from splices(rounds, seed)
    for i in range(rounds):  # every other one is valid, and must be read
        random, valid = Random(f"{kind.name} {seed} {i}"), i % 2 == 0
        change = partial(_generated, kind, random, valid)
        yield Mutation(f"generated {i}, {'valid' if valid else 'with one thing wrong'}", change, valid=valid)
    # In a quick campaign every fifth, which ones the seed says.
    yield from islice(kind.planted(folder, seed, rounds, quick), seed % 5 if quick else 0, None, 5 if quick else 1)


def _generated(kind: Kind, random: Random, valid: bool, path: Path) -> None:
    kind.generate(random, path, valid)


def run_kind(
    kind: Kind, folder: Path, seed: int, rounds: int, quick: bool, limit: float, step: Callable[[], object]
) -> Tally:
    """Every case of a kind.

    Args:
        kind: of file.
        folder: empty, to work in.
        seed: of all random damage.
        rounds: how often each sort of random damage is done.
        quick: leave out what takes long.
        limit: seconds a case.
        step: called after each case.
    """
    corpus, case, canary = folder / "corpus", folder / "case", folder / "canary"
    corpus.mkdir(parents=True)
    kind.make(corpus)
    (folder / "neighbour").write_text("not to be touched\n")
    tally = Tally()
    worker = Worker(kind.read, kind.word, limit)
    original: Any = None
    try:
        size = (corpus / kind.target).stat().st_size
        for mutation in mutations(kind, folder, size, seed, rounds, quick):
            shutil.copytree(corpus, case)
            mutation.change(case / kind.target)
            before = digests(folder)
            outcome = worker.run(case)
            after = digests(folder)
            found = _verdicts(kind, mutation, outcome, original)
            original = outcome.result if mutation.name == "untouched" else original
            if canary.exists():
                found["executed"] = "planted code was executed"
                canary.unlink()
                del after[str(canary.relative_to(folder))]
            if before != after:
                found["overwritten"] = f"changed: {', '.join(sorted(dict(before.items() ^ after.items())))}"
            _count(tally, kind, mutation, seed, outcome, found)
            _remove(case)
            step()
    finally:
        worker.close()
        shutil.rmtree(folder, ignore_errors=True)
    return tally


def _verdicts(kind: Kind, mutation: Mutation, outcome: Outcome, original: Any) -> dict[str, str]:
    """Verdicts of a case, with what to say of them."""
    if mutation.valid and outcome.verdict == "refused":
        return {"crashed": f"a valid file was refused: {outcome.message[:300]}"}
    if kind.exact and mutation.damage and outcome.verdict == "read" and outcome.result != original:
        return {"crashed": "damage went unnoticed"}
    return {outcome.verdict: outcome.message}


def _count(tally: Tally, kind: Kind, mutation: Mutation, seed: int, outcome: Outcome, found: dict[str, str]) -> None:
    tally.cases += 1
    tally.counts.update(list(found))
    tally.megabytes = max(tally.megabytes, outcome.megabytes)
    if outcome.seconds > tally.seconds:
        tally.seconds, tally.slowest = outcome.seconds, mutation.name
    for verdict in ("crashed", "executed", "overwritten"):
        if verdict in found:
            tally.failures.append(
                {
                    "kind": kind.name,
                    "mutation": mutation.name,
                    "seed": seed,
                    "verdict": verdict,
                    "message": found[verdict],
                }
            )


def digests(folder: Path) -> dict[str, str]:
    """Of everything in a folder; links and special files are not followed."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in [*folders, *files]:
            path = Path(root) / name
            status = path.lstat()
            mark = f"{stat.S_IFMT(status.st_mode)} {status.st_size if not path.is_dir() else ''}"
            if stat.S_ISLNK(status.st_mode):
                mark += os.readlink(path)
            elif stat.S_ISREG(status.st_mode) and status.st_size > LARGE:
                mark += str(status.st_mtime_ns)
            elif stat.S_ISREG(status.st_mode) and os.access(path, os.R_OK):
                mark += hashlib.blake2b(path.read_bytes()).hexdigest()
            found[str(path.relative_to(folder))] = mark
    return found


def _remove(case: Path) -> None:
    for path in case.rglob("*"):
        if not path.is_symlink():
            path.chmod(0o700)
    shutil.rmtree(case)
