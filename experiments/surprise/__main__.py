"""What filters say of interactions that nobody showed them, and of sensors that lie.

Without --data: reaches, simulated; learned from those that are familiar, asked about others of them, with every fault
of a sensor, and about strange ones: slower and faster than any, from elsewhere, by a detour, to another place. With
--data the recordings are cut into two clusters by k-means: the larger one is learned, the other is strange.
`ebip_cautious` is what `learn` gives; `ebip_sure` is the same filter without surprise, doubt and bounds; `mean` the
training mean of the end. Then sessions, sample by sample, of what was learned and of a filter that was made by hand.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from experiments.bars import learning_bar
from experiments.command_line import add_run_options, command, experiment_parser
from experiments.faults.faults import suffer
from experiments.results import Values, summarise
from experiments.run_folder import RunFolder, save_figure
from experiments.surprise.figure import surprise_figure
from experiments.surprise.lies import TRUTHLESS, lies
from experiments.surprise.measure import ALARM, HALF, SHARES, Noticed, auc, measure, scores, undisturbed, unit_of
from experiments.surprise.reaches import STRANGE, reaches
from experiments.surprise.sessions import as_plain, heard, table_of
from experiments.surprise.sure import sure
from torch_ebip import Demonstrations, Forecast, InteractionModel, InteractionPrimitive, learn
from torch_ebip.interaction import DemonstrationTable

CONSOLE = Console(width=140)
TRAINING = 120
"""Simulated interactions that are learned from."""
SESSIONS = 12
"""Of each kind of lies."""


def sets_of(options: argparse.Namespace) -> tuple[Demonstrations, Demonstrations, dict[str, Demonstrations]]:
    """What is learned from, familiar ones to be asked about, and strange ones by kind."""
    tests, seed = options.tests, options.seed
    if options.data is None:
        count = max(20, tests // 5)
        strange = {name: reaches(count, 10 * seed + 3, change) for name, change in STRANGE.items()}
        return reaches(40 if options.quick else TRAINING, 10 * seed + 1), reaches(tests, 10 * seed + 2), strange
    everything = Demonstrations.load(options.data)
    known, other = clusters(everything, seed)
    order = torch.randperm(len(known), generator=torch.Generator().manual_seed(seed)).numpy()
    held = max(1, len(known) // 4)
    return (
        everything.subset(known[order[held:]].tolist()),
        everything.subset(known[order[:held]].tolist()),
        {"other cluster": everything.subset(other.tolist())},
    )


def clusters(demonstrations: Demonstrations, seed: int) -> tuple[Any, Any]:
    """Numbers of the larger and of the smaller of two clusters: k-means of the paths over phase, each DoF in its own
    deviation and at most two of them away, so that a single odd recording is no cluster.

    Args:
        demonstrations: to be cut.
        seed: of k-means.
    """
    try:
        from sklearn.cluster import KMeans
    except ImportError as error:
        raise SystemExit("clusters need scikit-learn: pip install 'torch-ebip[methods]'") from error
    primitive = InteractionPrimitive.fit(demonstrations)
    paths = DemonstrationTable.of(primitive, 11).cells[:, :, 0]
    apart = (paths - paths.median(0).values) / primitive.value_variance.clamp(min=1e-12).sqrt()
    label = KMeans(2, n_init=10, random_state=seed).fit_predict(apart.clamp(-2, 2).flatten(1).numpy())
    sizes = np.bincount(label)
    return np.flatnonzero(label == sizes.argmax()), np.flatnonzero(label != sizes.argmax())


def mean_of(model: InteractionModel, count: int) -> Forecast:
    """What the demonstrations' mean and spread say of the end, [count, K, 1, D]."""
    mean, variance = model.filter.demonstrated(torch.ones(count, len(SHARES), 1))
    arm = model.layout.controlled
    return Forecast(mean[..., arm], variance[..., arm], torch.ones(count, len(SHARES), 1))


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    steps, scan = (min(options.steps, 5), 8) if options.quick else (options.steps, 48)
    options.tests = min(options.tests, 60) if options.quick else options.tests
    known, familiar, strange = sets_of(options)
    sensors = [m.name for m in known.layout.modalities if not m.controlled]
    liar = options.sensor or sensors[0]
    if liar not in sensors or len(known.layout[liar].dofs) < 2:
        raise SystemExit(f"--sensor must be one of several DoFs among {', '.join(sensors)}, got {liar!r}")
    settings = {"data": options.data, "tests": len(familiar), "steps": steps, "sensor": liar, "size": options.size,
                "seed": options.seed}  # fmt: skip
    run = RunFolder("surprise", settings, options.out, options.force, arguments)
    print(known)
    with learning_bar() as show:
        model = learn(known, steps=steps, seed=options.seed, folder=run.path, progress=show, scan=scan)
    methods = {"ebip_cautious": model, "ebip_sure": sure(model)}
    # In the units and the spread of what is shown, over all samples.
    deviation = model.primitive.value_variance.sqrt()
    faults = lies(known.layout, liar, options.size)
    some = familiar.subset(range(min(len(familiar), options.faulty)))
    asked: list[tuple[str, Demonstrations, Demonstrations, bool]] = [("familiar", familiar, familiar, True)]
    asked += [
        (f.name, some, suffer(f, some, sensors, deviation, range(len(some)), options.seed), f.name not in TRUTHLESS)
        for f in faults[1:]
    ]
    asked += [(name, them, them, True) for name, them in strange.items()]
    lying = [fault.name for fault in faults if fault.group in ("offset", "unit", "axes", "frozen", "drift")]
    values: Values = {}
    noticed: dict[str, Noticed] = {}
    for name, truth, said, true in tqdm(asked, desc="sets", unit="set", dynamic_ncols=True):
        for method, its in methods.items():
            found, seen = measure(method, its, truth, said, name, options.seed)
            for cell, arrays in found.items() if true else ():
                values.setdefault(cell, {}).update(arrays)
            if seen is not None:
                noticed[name] = seen
        if true:
            end = torch.stack([trajectory[-1] for trajectory in truth])[:, known.layout.controlled]
            for cell, arrays in scores("mean", mean_of(model, len(end)), end, name, unit_of(known.layout)).items():
                values[cell].update(arrays)
    few = range(min(len(some), SESSIONS))
    streams = {name: said.subset(few) for name, _, said, _ in asked if name in (*lying, *TRUTHLESS)}
    sessions = heard(model, some.subset(few), streams, options.seed)
    usual = noticed["familiar"]
    names = [*known.layout.names, "the whole"]
    detection = {name: _detected(seen, usual, names) for name, seen in noticed.items()}
    results = {
        "experiment": "surprise",
        "dataset": {
            "source": options.data or "simulated reaches",
            "demonstrations": len(known),
            "tests": len(familiar),
        },
        **summarise(values, "ebip_sure"),
        "detection": detection,
        "alarm": ALARM,
        "undisturbed": undisturbed(values, "familiar"),
        "sessions": as_plain(sessions),
        "seconds": round(time.monotonic() - began, 1),
    }
    save_figure(surprise_figure(results), run.path / "surprise.png")
    run.finish(results)
    for metric in ("mae", "mse", "crps", "coverage_95", "beyond_4", "deviation"):
        _print_scores(results["rows"], metric, list(methods))
    _print_detection(detection, names)
    _print_undisturbed(results["undisturbed"])
    CONSOLE.print(table_of(sessions, unit_of(known.layout)))
    print(f"{results['seconds']:.0f} s; written to {run.path}")


def _detected(seen: Noticed, usual: Noticed, names: list[str]) -> dict[str, Any]:
    """Share of alarms and median delay of each sensor and of the whole, and how well familiarity tells them apart."""
    found = np.isfinite(seen.delay)
    return {
        "auc_by_half": auc(seen.largest, usual.largest),
        "unfamiliar_by_half": float((seen.familiarity[:, HALF] < ALARM).mean()),
        "rate": dict(zip(names, found.mean(0).tolist(), strict=True)),
        "delay": {
            name: float(np.median(seen.delay[found[:, k], k])) if found[:, k].any() else None
            for k, name in enumerate(names)
        },
        "n": len(seen.largest),
    }


def _print_scores(rows: list[dict[str, Any]], metric: str, methods: list[str]) -> None:
    """As a table: sets down; methods and shares across."""
    mine = {(r["subset"], r["method"], r["observed"]): r for r in rows if r["metric"] == metric}
    unit = next(iter(mine.values()))["unit"]
    table = Table(title=f"{metric} [{unit}] of the end", title_justify="left")
    table.add_column("set")
    columns = [(method, share) for share in (0.43, 0.82) for method in (*methods, "mean")]
    for method, share in columns:
        table.add_column(f"{method.removeprefix('ebip_')}\n{share:.0%}", justify="right")
    for name in dict.fromkeys(subset for subset, _, _ in mine):
        table.add_row(name, *(f"{mine[name, method, share]['mean']:.3f}" for method, share in columns))
    CONSOLE.print(table)


def _print_detection(detection: dict[str, dict[str, Any]], names: list[str]) -> None:
    """As a table: who was rejected, how often and how soon."""
    shown = [name for name in names if any(d["rate"][name] > 0 for d in detection.values()) or name == names[-1]]
    table = Table(title=f"rejected sensors, and familiarity below {ALARM:g}: share of interactions, median delay")
    table.add_column("set")
    for name in (*shown, "AUC by half"):
        table.add_column(name, justify="right")
    for name, found in detection.items():
        cells = [
            f"{found['rate'][s]:.3f}" + ("" if found["delay"][s] is None else f", {found['delay'][s]:.2f} s")
            for s in shown
        ]
        table.add_row(name, *cells, f"{found['auc_by_half']:.3f}")
    CONSOLE.print(table)


def _print_undisturbed(ratios: dict[str, dict[str, float]]) -> None:
    """As a table: what caution costs where nothing is wrong."""
    table = Table(title="familiar interactions: cautious as a multiple of sure", title_justify="left")
    table.add_column("")
    for share in ratios:
        table.add_column(f"{float(share):.0%}", justify="right")
    for name in next(iter(ratios.values())):
        table.add_row(name, *(f"{found[name]:.3f}" for found in ratios.values()))
    CONSOLE.print(table)


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("surprise", __doc__)
    parser.add_argument("--data", metavar="PATH", help="recordings, an .npz (default: simulated reaches)")
    parser.add_argument("--tests", type=int, default=1000, metavar="N", help="simulated ones (default: 1000)")
    parser.add_argument("--faulty", type=int, default=300, metavar="N", help="of them with faults (default: 300)")
    parser.add_argument("--sensor", metavar="NAME", help="that lies (default: the first)")
    parser.add_argument("--size", type=float, default=0.5, help="of its offset, in its unit (default: 0.5)")
    parser.add_argument("--steps", type=int, default=100, help="gradient steps at most (default: 100)")
    add_run_options(parser, "surprise", "data and draws", "a run of a quarter of a minute")
    return parser


if __name__ == "__main__":
    main()
