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

from experiments.baselines.mixture import EPOCHS, MixtureNetwork
from experiments.folds import mean_of_cells, read_values, run_folds, share_cores, write_values
from experiments.results import Cell, Values, print_tables, summarise
from experiments.run_folder import RunFolder
from torch_ebip import Demonstrations, InteractionModel, InteractionPrimitive, learn
from torch_ebip.common.draws import seeded
from torch_ebip.filtering.states import map_state
from torch_ebip.interaction import DemonstrationTable, InteractionFilter
from torch_ebip.learning.references import nearest
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
    values: Values = {}
    for name in job.methods:
        if name == "mixture_gru":
            y, _ = tests.pad()
            said = MixtureNetwork(known, AHEAD, job.seed, job.epochs)(y)
        elif name in ("mean", "nearest"):
            said = _reference(name, known, tests)
        else:
            assert model is not None
            filter = model.filter if name == "ebip_tuned" else scaled(model.primitive, model.report["factor"])
            said = filtered(filter, tests, job.seed)
        for cell, array in by_action(said, tests).items():
            values.setdefault(cell, {})[name] = array
    write_values(finished, values)
    return values


@torch.no_grad()
def filtered(filter: InteractionFilter, tests: Demonstrations, seed: int) -> Tensor:
    """[B, T, AHEAD, M]: what a filter expects of the next samples, after each one."""
    y, measured = tests.pad()
    targets = tests.layout.controlled
    observed = measured & ~targets
    every = torch.arange(y.shape[1]).expand(len(y), -1)
    draws = [seeded(seed, number) for number in range(len(y))]
    trace = filter(torch.where(observed, y, torch.nan), observed, generator=draws, keep=every, project=False)
    ahead = torch.arange(1, AHEAD + 1) / tests.rate
    return torch.cat(
        [filter.forecast(part, ahead=ahead).mean[..., targets].unsqueeze(0) for part in _entries(trace.kept, len(y))]
    )


def _entries(state: object, count: int) -> list[object]:
    """The entries of a batch of states one by one: all horizons of all of them would fill the memory."""

    def entry(b: int) -> Callable[[Tensor], Tensor]:
        return lambda part: part[b]

    return [map_state(entry(b), state) for b in range(count)]


def _reference(name: str, known: Demonstrations, tests: Demonstrations) -> Tensor:
    """[B, T, AHEAD, M]: the mean of all at the time that will have passed, or the one that was nearest so far."""
    primitive = InteractionPrimitive.fit(known)
    table, targets = DemonstrationTable.of(primitive), tests.layout.controlled.nonzero().squeeze(-1)
    y, measured = tests.pad()
    every = torch.arange(y.shape[1]).expand(len(y), -1)
    time = (every.unsqueeze(-1) + torch.arange(1, AHEAD + 1)) / primitive.rate
    if name == "mean":
        all_of_them = torch.arange(len(known)).expand(y.shape[1], AHEAD, -1)
        phase = (time[0].unsqueeze(-1) * primitive.phase_velocity).clamp(max=1)
        said = table.at(all_of_them, phase.unsqueeze(-1), targets).squeeze(-2).mean(-2)
        return said.expand(len(y), -1, -1, -1)
    chosen = nearest(primitive, y, measured & ~tests.layout.controlled, every, 1 / primitive.rate)
    one = chosen.unsqueeze(-1).expand(time.shape)
    phase = (time * primitive.phase_velocity[one]).clamp(max=1)
    return table.at(one, phase.unsqueeze(-1), targets).squeeze(-2)


def by_action(said: Tensor, tests: Demonstrations) -> dict[Cell, NDArray[np.float64]]:
    """Values by action, one a test interaction; of forecasts [B, T, AHEAD, M]."""
    y, _ = tests.pad()
    lengths, targets = tests.lengths, tests.layout.controlled
    length = y.shape[1]
    steps = torch.arange(length).unsqueeze(-1) + torch.arange(1, AHEAD + 1)
    truth = y[:, steps.clamp(max=length - 1)][..., targets]
    counted = (steps < lengths.view(-1, 1, 1)).to(y)
    joints = truth.shape[-1] / 3
    squares = (said - truth).square().nan_to_num().sum(-1) / joints
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
