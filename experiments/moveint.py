"""The protocol of MoVEInt (Prasad et al., RA-L 2024): at every sample, from what was seen, the partner's next five.

One model for all actions, which is not told which one it sees; squared distance summed over x, y and z, averaged over
joints and the five samples, times 100, by action. The split is the recordings' own (their column ``split``, 1 for a
test). `experiments.compare --protocol moveint` runs it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from experiments.baselines.mixture import EPOCHS, MixtureNetwork, next_samples
from experiments.evaluate import FilterMethod, MeanMethod, Method, NearestMethod
from experiments.folds import mean_of_cells, read_values, run_folds, share_cores, write_values
from experiments.results import Cell, Values, print_tables, summarise
from experiments.run_folder import RunFolder
from torch_ebip import Demonstrations, InteractionModel, InteractionPrimitive, learn
from torch_ebip.learning.starts import scaled

AHEAD = 5
"""Samples."""
PUBLISHED = {"0": 0.99, "1": 0.43, "2": 2.14, "3": 1.27}
"""MoVEInt's network on its Nuisi set, trained from its public code (seed 0, 400 epochs, positions), by action."""
METHODS = ("mean", "nearest", "mixture_gru", "ebip_scaled", "ebip_tuned")


@dataclass(frozen=True)
class Job:
    """One seed: everything a worker needs."""

    data: str
    seed: int
    steps: int
    epochs: int
    methods: tuple[str, ...]
    threads: int
    folder: str


def parts(path: str) -> tuple[Demonstrations, Demonstrations]:
    """Training and test part.

    Raises:
        SystemExit: recordings that cannot be read, or without the columns ``split`` and ``action``.
    """
    try:
        demonstrations = Demonstrations.load(path)
    except (OSError, ValueError) as error:
        raise SystemExit(str(error)) from error
    missing = [name for name in ("split", "action") if name not in demonstrations.columns]
    if missing:
        raise SystemExit(f"{path}: the protocol needs the columns split and action, without {', '.join(missing)}")
    test = torch.as_tensor(demonstrations.columns["split"]) > 0.5
    return demonstrations.subset(~test), demonstrations.subset(test)


def run_seed(job: Job) -> Values:
    """Every method of one seed; what is finished is read from its file."""
    torch.set_num_threads(job.threads)
    finished = Path(job.folder) / "values.json"
    if finished.exists():
        return read_values(finished)
    known, tests = parts(job.data)
    model: InteractionModel | None = None
    if {"ebip_scaled", "ebip_tuned"} & set(job.methods):
        model = learn(known, steps=job.steps, seed=job.seed, progress=lambda _: None)
    primitive = model.primitive if model is not None else InteractionPrimitive.fit(known)
    values: Values = {}
    for name in job.methods:
        if name == "mixture_gru":
            said = MixtureNetwork(known, AHEAD, job.seed, job.epochs)(tests.pad()[0])
        elif name in ("mean", "nearest"):
            method: Method = MeanMethod(primitive) if name == "mean" else NearestMethod(primitive)
            said = answered(lambda _, method=method: method, tests)
        else:
            assert model is not None
            filter = model.filter if name == "ebip_tuned" else scaled(primitive, model.report["factor"])
            said = answered(lambda number, filter=filter: FilterMethod(filter, job.seed, [number]), tests)
        for cell, array in by_action(said, tests).items():
            values.setdefault(cell, {})[name] = array
    write_values(finished, values)
    return values


def answered(method_of: Callable[[int], Method], tests: Demonstrations) -> Tensor:
    """[B, T, AHEAD, M]: what a method expects of the next samples, after each one.

    Args:
        method_of: the method for a test by its number: one at a time, all moments of all would fill the memory.
        tests: B interactions.
    """
    y, measured = tests.pad()
    targets = tests.layout.controlled
    every = torch.arange(y.shape[1]).unsqueeze(0)
    ahead = [k / tests.rate for k in range(1, AHEAD + 1)]
    parts = []
    for b in range(len(y)):
        one = slice(b, b + 1)
        parts.append(method_of(b)(y[one], measured[one] & ~targets, every, targets, ahead).forecast.mean)
    return torch.cat(parts)


def by_action(said: Tensor, tests: Demonstrations) -> dict[Cell, NDArray[np.float64]]:
    """Values by action, one a test interaction; of forecasts [B, T, AHEAD, M]."""
    truth = next_samples(tests, AHEAD)
    counted = ~truth.isnan().any(-1)
    squares = (said - truth).square().nan_to_num().sum(-1) / (truth.shape[-1] / 3)
    each = 100 * (squares * counted).sum((1, 2)) / counted.sum((1, 2))
    actions = tests.columns["action"]
    return {
        Cell(f"action {action:g}", 1.0, "moveint", None, "100 m^2"): each[torch.as_tensor(actions == action)]
        .double()
        .numpy()
        for action in sorted(set(actions.tolist()))
    }


def run(options: argparse.Namespace, arguments: list[str] | None) -> None:
    """`experiments.compare --protocol moveint`."""
    began = time.monotonic()
    if options.data is None:
        raise SystemExit("--protocol moveint needs --data: recordings with the columns split and action")
    known, tests = parts(options.data)
    methods = tuple(name for name in METHODS if name in options.methods or name == "mixture_gru")
    seeds, steps, epochs = (1, min(options.steps, 5), 40) if options.quick else (3, options.steps, EPOCHS)
    settings = {"data": options.data, "protocol": "moveint", "seeds": seeds, "seed": options.seed, "steps": steps,
                "epochs": epochs, "methods": list(methods)}  # fmt: skip
    run = RunFolder("compare", settings, options.out, options.force, arguments)
    print(f"{known}\ntests: {len(tests)}")
    workers, threads = share_cores(seeds, options.workers)
    jobs = [
        Job(
            options.data,
            options.seed + s,
            steps,
            epochs,
            methods,
            threads,
            str(run.path / f"seed-{options.seed + s}"),
        )
        for s in range(seeds)
    ]
    for job in jobs:
        Path(job.folder).mkdir(exist_ok=True)
    values = run_folds(
        run_seed, jobs, workers, lambda v: f"ebip_tuned {mean_of_cells(v, 'ebip_tuned', 'moveint'):.2f}"
    )
    # Seeds are no interactions: an interaction's value is the mean over them.
    values = {
        cell: {name: array.reshape(seeds, -1).mean(0) for name, array in arrays.items()}
        for cell, arrays in values.items()
    }
    results = {
        "experiment": "compare",
        "dataset": {"source": options.data, "protocol": "moveint", "tests": len(tests), "seeds": seeds},
        **summarise(values, "ebip_tuned"),
        "published": PUBLISHED,
        "geometric_mean": {
            name: float(np.exp(np.mean([np.log(arrays[name].mean()) for arrays in values.values()])))
            for name in methods
        },
        "seconds": round(time.monotonic() - began, 1),
    }
    run.finish(results)
    print_tables(results)
    print("MoVEInt's network, trained from its public code: " + ", ".join(f"{v:g}" for v in PUBLISHED.values()))
    published = float(np.exp(np.mean(np.log(list(PUBLISHED.values())))))
    means = {**results["geometric_mean"], "published": published}
    print("geometric means: " + ", ".join(f"{name} {value:.3g}" for name, value in means.items()))
    print(f"{results['seconds']:.0f} s; written to {run.path}")
