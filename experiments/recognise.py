"""Recognition: which of several interactions is going on, over the share that was seen, and how sure one may be.

`ebip_tuned` is what `torch_ebip.learn` returns and its `recognise` says; `gru` a recurrent classifier whose
temperature was fitted on interactions left out; `nearest` the label of the demonstration that is nearest so far.
Without --data the recordings are simulated, four actions whose ends look alike (`torch_ebip.recordings.actions`):
there the error of the end must not grow with what is seen.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.baselines.classifier import RecurrentClassifier, probabilities_of
from experiments.command_line import add_run_options, command, experiment_parser
from experiments.evaluate import FilterMethod, MeanMethod, NearestMethod, Task, evaluate
from experiments.folds import mean_of_cells, read_values, run_folds, share_cores, split, write_values
from experiments.recognition_figure import recognition_figure
from experiments.results import Cell, Values, print_tables, summarise
from experiments.run_folder import RunFolder, save_figure
from torch_ebip import Demonstrations, learn
from torch_ebip.common.draws import seeded
from torch_ebip.learning.recognising import calibration_error, reliability
from torch_ebip.learning.references import nearest
from torch_ebip.recordings import actions

SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
TRAINING = 120
"""Simulated interactions that are learned from."""


@dataclass(frozen=True)
class Job:
    """One fold, or the simulated set: everything a worker needs."""

    fold: int
    folds: int
    data: str | None
    labels: str
    training: int
    tests: int
    steps: int
    memories: int
    seed: int
    threads: int
    folder: str

    def parts(self) -> tuple[Demonstrations, Demonstrations]:
        """What is learned from, and what is asked about."""
        if self.data is None:
            return actions(self.training, 2 * self.seed + 1), actions(self.tests, 2 * self.seed + 2)
        demonstrations = labelled(self.data, self.labels)
        training, testing = split(len(demonstrations), self.folds, self.fold, self.seed)
        return demonstrations.subset(training), demonstrations.subset(testing)


def labelled(path: str, column: str) -> Demonstrations:
    """Recordings whose labels are one of their columns.

    Raises:
        SystemExit: they cannot be read, or have no such column.
    """
    try:
        demonstrations = Demonstrations.load(path)
    except (OSError, ValueError) as error:
        raise SystemExit(str(error)) from error
    if column not in demonstrations.columns or demonstrations.columns[column].ndim != 1:
        raise SystemExit(f"{path}: no column {column!r}; it has {', '.join(demonstrations.columns) or 'none'}")
    return demonstrations.labelled([str(value) for value in demonstrations.columns[column].tolist()])


def run_fold(job: Job) -> Values:
    """Learn from one part, and ask about the other; what is finished is read from its file."""
    torch.set_num_threads(job.threads)
    finished = Path(job.folder) / "values.json"
    if finished.exists():
        return read_values(finished)
    known, tests = job.parts()
    model = learn(known, steps=job.steps, seed=job.seed, memories=job.memories, progress=lambda _: None)
    layout, primitive, order = known.layout, model.primitive, tuple(dict.fromkeys(known.labels or ()))
    inputs = ~layout.controlled
    y, measured = tests.pad()
    observed = measured & inputs
    steps = torch.stack([(tests.lengths * share).round().long() - 1 for share in SHARES], -1).clamp(min=0)
    chosen = nearest(primitive, y, observed, steps, 1 / primitive.rate)
    which = torch.tensor([order.index(label) for label in primitive.labels or ()])[chosen]
    classifier = RecurrentClassifier(known, inputs, job.seed)
    said = {
        "ebip_tuned": _recognised(model.filter, y, observed, steps, order, job.seed),
        "gru": probabilities_of(classifier(y, observed, steps), classifier.labels, order),
        "nearest": torch.nn.functional.one_hot(which, len(order)).to(y),
    }
    wanted = torch.tensor([order.index(label) if label in order else -1 for label in tests.labels or ()])
    values: Values = {}
    for name, probability in said.items():
        right = (probability.argmax(-1) == wanted.unsqueeze(-1)).double()
        chance = probability.gather(-1, wanted.clamp(min=0).view(-1, 1, 1).expand(*steps.shape, 1)).squeeze(-1)
        for k, share in enumerate(SHARES):
            per = {"accuracy": right[:, k], "confidence": probability[:, k].amax(-1).double()}
            if name != "nearest":
                per["log_loss"] = -chance[:, k].double().clamp(min=1e-9).log()
            for metric, array in per.items():
                values.setdefault(Cell("all", share, metric, None, "1"), {})[name] = array.numpy()
    targets = [m.name for m in layout.modalities if m.controlled]
    task = Task({"all": [m.name for m in layout.modalities if not m.controlled]}, SHARES, [], targets, {}, None)
    methods = {
        "ebip_tuned": FilterMethod(model.filter, job.seed, dtype=torch.float32),
        "nearest": NearestMethod(primitive),
        "mean": MeanMethod(primitive),
    }
    for cell, arrays in evaluate(task, methods, tests).items():
        if cell.metric in ("mae", "coverage_95"):
            values[cell] = arrays
    write_values(finished, values)
    return values


@torch.no_grad()
def _recognised(filter: Any, y: Tensor, observed: Tensor, steps: Tensor, order: tuple[str, ...], seed: int) -> Tensor:
    """[B, K, L]: what a filter says of interactions y [B, T, D] after samples steps [B, K]."""
    draws = [seeded(seed, number) for number in range(len(y))]
    trace = filter(torch.where(observed, y, torch.nan), observed, generator=draws, keep=steps, project=False)
    said = filter.recognise(trace.kept)
    return torch.stack([said[label] for label in order], -1)


def calibration(values: Values, method: str) -> dict[str, Any]:
    """Expected calibration error over all shares, and of each; the reliability in ten bins."""
    sure, right = (
        torch.tensor(np.stack([values[Cell("all", s, metric, None, "1")][method] for s in SHARES], -1))
        for metric in ("confidence", "accuracy")
    )
    return {
        "expected_calibration_error": calibration_error(sure.flatten(), right.flatten().bool()),
        "by_share": {str(s): calibration_error(sure[:, k], right[:, k].bool()) for k, s in enumerate(SHARES)},
        "reliability": [b._asdict() for b in reliability(sure.flatten(), right.flatten().bool())],
    }


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    training, tests, steps, folds = TRAINING, options.tests, options.steps, options.folds if options.data else 1
    if options.quick:
        training, tests, steps, folds = 40, min(tests, 100), min(steps, 5), min(folds, 2)
    settings = {
        "data": options.data,
        "labels": options.labels if options.data else None,
        "training": None if options.data else training,
        "tests": None if options.data else tests,
        "folds": folds,
        "steps": steps,
        "memories": options.memories,
        "seed": options.seed,
    }
    if options.data is not None:
        print(labelled(options.data, options.labels))
    run = RunFolder("recognise", settings, options.out, options.force, arguments)
    workers, threads = share_cores(folds, options.workers)
    jobs = [
        Job(fold, folds, options.data, options.labels, training, tests, steps, options.memories, options.seed,
            threads, str(run.path / f"fold-{fold:02d}"))
        for fold in range(folds)
    ]  # fmt: skip
    for job in jobs:
        Path(job.folder).mkdir(exist_ok=True)
    values = run_folds(
        run_fold, jobs, workers, lambda v: f"accuracy {mean_of_cells(v, 'ebip_tuned', 'accuracy'):.3f}"
    )
    said = {name: calibration(values, name) for name in ("ebip_tuned", "gru")}
    shown = {cell: arrays for cell, arrays in values.items() if cell.metric != "confidence"}
    results = {
        "experiment": "recognise",
        "dataset": {
            "source": options.data or "simulated actions",
            "tests": len(next(iter(values.values()))["nearest"]),
        },
        **summarise(shown, "ebip_tuned"),
        "calibration": said,
        "seconds": round(time.monotonic() - began, 1),
    }
    save_figure(recognition_figure(results), run.path / "recognition.png")
    run.finish(results)
    target = next(row["modality"] for row in results["rows"] if row["metric"] == "mae")
    few = [row for row in results["rows"] if row["observed"] in (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)]
    print_tables({**results, "rows": few}, only=[("accuracy", None), ("log_loss", None), ("mae", target)])
    for name, report in said.items():
        print(f"{name}: expected calibration error {report['expected_calibration_error']:.3f}")
    print(f"{results['seconds']:.0f} s; written to {run.path}")


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("recognise", __doc__)
    parser.add_argument("--data", metavar="PATH", help="recordings, an .npz (default: simulated actions)")
    parser.add_argument("--labels", default="labels", metavar="COLUMN", help="of the recordings (default: labels)")
    parser.add_argument("--tests", type=int, default=1000, metavar="N", help="simulated ones (default: 1000)")
    parser.add_argument("--folds", type=int, default=10, help="with --data: of the cross-validation (default: 10)")
    parser.add_argument("--steps", type=int, default=100, help="gradient steps at most (default: 100)")
    parser.add_argument("--memories", type=int, default=2, choices=(1, 2), help="of the evidence (default: 2)")
    add_run_options(parser, "recognise", "data, splits and draws", "a run of about a minute", workers=True)
    return parser


if __name__ == "__main__":
    main()
