"""Cross-validation: splits, one process a fold, finished folds kept on disk, values of all folds put together."""

from __future__ import annotations

import math
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from experiments.interrupts import deaf_children, end_children
from experiments.results import Cell, Values
from torch_ebip.common.files import read_json, write_json
from torch_ebip.learning.ranks import Ranks

Job = TypeVar("Job")
Result = TypeVar("Result")
LOST = "this run was ended, probably because one of its processes died; --out {} goes on, with any number of them"
"""What a process says that cannot go on alone."""


def split(count: int, folds: int, fold: int, seed: int, test: float = 0.2) -> tuple[torch.Tensor, torch.Tensor]:
    """Training and test indices of a fold; with one fold, a share ``test`` of the shuffled demonstrations."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    if folds == 1:
        held = round(test * count)
        return order[held:], order[:held]
    parts = order.tensor_split(folds)
    return torch.cat([part for i, part in enumerate(parts) if i != fold]), parts[fold]


def share_cores(folds: int, workers: int | None) -> tuple[int, int]:
    """Processes for the folds, one a core unless told otherwise, and threads for each.

    Threads are those that torch has, which OMP_NUM_THREADS says: with 1, a run gives the same bits again.
    """
    processes = max(1, min(workers or os.cpu_count() or 1, folds))
    return processes, max(1, torch.get_num_threads() // processes)


def end_with_parent() -> None:
    """Have this process end when the one that started it does, however that ends.

    Nobody would take its results, and a run that goes on must not find it still writing to its folder.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait_for_it() -> None:
        """Then end, without a word."""
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=wait_for_it, daemon=True).start()


def run_folds(
    run: Callable[[Job], Values],
    jobs: Sequence[Job],
    workers: int,
    headline: Callable[[Values], str],
    ranks: Ranks | None = None,
) -> Values:
    """Folds in processes of their own; what is finished is kept if the run is interrupted.

    Several ranks each do their share of the folds, one after the other.

    Args:
        run: one fold; a function of a module, so that a new process can import it.
        jobs: one a fold.
        workers: processes.
        headline: what the progress bar says of the values so far.
        ranks: of a run of several processes that `torchrun` started.
    """
    if ranks is not None and ranks.size > 1:
        with tqdm(total=len(jobs), desc="folds", unit="fold", dynamic_ncols=True, disable=not ranks.first) as bar:
            mine: list[Values] = []
            for job in ranks.shard(jobs):
                mine.append(run(job))
                bar.set_postfix_str(headline(merge(mine)), refresh=False)
                bar.update(min(ranks.size, len(jobs) - bar.n))
        shares = ranks.gather(mine)
        return merge([shares[i % ranks.size][i // ranks.size] for i in range(len(jobs))])
    parts: list[Values] = [{} for _ in jobs]
    with (
        tqdm(total=len(jobs), desc="folds", unit="fold", dynamic_ncols=True) as bar,
        closing(in_processes(run, jobs, workers)) as finished,
    ):
        for i, part in finished:
            parts[i] = part
            bar.set_postfix_str(headline(merge([part for part in parts if part])), refresh=False)
            bar.update()
    return merge(parts)


def in_processes(run: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[tuple[int, Result]]:
    """The number and the result of each job as it is finished, in processes that end with this one.

    Args:
        run: one job; a function of a module, so that a new process can import it.
        jobs: what can be sent to a process.
        workers: processes.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=end_with_parent) as pool:
        with deaf_children():
            futures = {pool.submit(run, job): i for i, job in enumerate(jobs)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except Exception:
            pool.shutdown(cancel_futures=True)
            raise
        except BaseException:  # an interrupt waits for none of them
            pool.shutdown(wait=False, cancel_futures=True)
            end_children()
            raise


def merge(parts: Sequence[Values]) -> Values:
    """Values of all interactions, in the order of the parts."""
    return {
        cell: {name: np.concatenate([part[cell][name] for part in parts]) for name in methods}
        for cell, methods in parts[0].items()
    }


def interleave(parts: Sequence[Values]) -> Values:
    """Values of all interactions, of which the r-th part has every len(parts)-th from number r on."""
    merged: Values = {}
    for cell, methods in parts[0].items():
        merged[cell] = {}
        for name in methods:
            whole = np.empty(sum(len(part[cell][name]) for part in parts))
            for rank, part in enumerate(parts):
                whole[rank :: len(parts)] = part[cell][name]
            merged[cell][name] = whole
    return merged


def mean_of_cells(values: Values, method: str, metric: str) -> float:
    """Mean over cells and interactions of one metric of one method, of the end."""
    asked = [methods for cell, methods in values.items() if cell.metric == metric and cell.ahead is None]
    cells = [methods[method] for methods in asked if method in methods]
    return float(np.mean([np.nanmean(array) for array in cells])) if cells else float("nan")


def write_values(path: Path, values: Values) -> None:
    """Values of a finished fold as JSON, atomically; what is infinite is a word there, NaN is null."""

    def plain(array: NDArray[np.float64]) -> list[float | str]:
        """Numbers, and words for what JSON has no numbers for."""
        return [str(value) if math.isinf(value) else value for value in array.tolist()]

    content: list[Mapping[str, Any]] = [
        {**cell._asdict(), "values": {name: plain(array) for name, array in methods.items()}}
        for cell, methods in values.items()
    ]
    write_json(path, content)


def read_values(path: Path) -> Values:
    """What `write_values` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, or something else.
    """
    content = read_json(path)
    values: Values = {}
    try:
        for entry in content:
            arrays = {name: _numbers(listed) for name, listed in entry.pop("values").items()}
            if len({array.shape for array in arrays.values()}) != 1 or any(a.ndim != 1 for a in arrays.values()):
                raise ValueError("expected as many numbers for every method")
            values[Cell(**entry)] = arrays
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: not the values of a fold: {error}") from error
    return values


def _numbers(listed: Sequence[float | str | None]) -> NDArray[np.float64]:
    """What `write_values` made of an array."""
    words = {"inf": math.inf, "-inf": -math.inf, None: math.nan}
    return np.array([words.get(value, value) for value in listed], dtype=np.float64)
