"""Clocks that are wrong: what becomes of forecasts, and what sessions say about it. Exit status 1 if one is neither
handled (error at most half as large again as undisturbed) nor reported by name.

Held-out interactions are shown with clocks that jump, stamps on arrival, one bad stamp, a second interaction in the
same session. Then one session goes on for an hour of interaction time, with `restart` between interactions.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence, Set
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from experiments import figures  # chooses a backend without a screen
from experiments.bars import learning_bar
from experiments.clocks.cases import Case, cases
from experiments.clocks.sessions import FAR, HORIZON, Outcome, long_session, outcome
from experiments.command_line import add_run_options, command, experiment_parser
from experiments.data import load
from experiments.folds import split
from experiments.run_folder import RunFolder, save_figure
from torch_ebip import Demonstrations, InteractionModel, learn

HANDLED = 1.5
"""Times the undisturbed error."""
VERDICTS = {"handled": "#2a7f3f", "reported": "#d99000", "nothing can tell": "#808080", "neither": "#c22f2f"}
CONSOLE = Console(width=150)


def row(case: Case, outcomes: Sequence[Outcome], undisturbed: float | None, usual: Set[str]) -> dict[str, Any]:
    """A line of the table.

    Args:
        case: what was wrong.
        outcomes: of every interaction.
        undisturbed: error, units of the DoFs; None for this one.
        usual: what sessions say undisturbed, too.
    """
    error, deviation = (
        float(np.sqrt(np.mean(np.square(np.concatenate([getattr(of, name) for of in outcomes])))))
        if any(len(of.error) for of in outcomes) else None
        for name in ("error", "deviation")
    )  # fmt: skip
    ratio = None if error is None else error / (undisturbed or error)
    told = [[note for note in of.notes if _speaks(note, case) and note not in usual] for of in outcomes]
    share = float(np.mean([bool(notes) for notes in told]))
    handled = ratio is not None and ratio <= HANDLED
    verdict = (
        "handled" if handled else "reported" if share == 1 else "neither" if case.knowable else list(VERDICTS)[2]
    )
    far = [of.far for of in outcomes if len(of.far)]
    return {
        "case": case.what, "error": error, "ratio": ratio, "deviation": deviation,
        "far": float(np.mean(np.concatenate(far))) if far else None,
        "verdict": verdict, "said": share, "note": next((notes[0] for notes in told if notes), ""),
    }  # fmt: skip


def _speaks(note: str, case: Case) -> bool:
    """Whether a note says what is wrong: that the interaction ended is wrong only if another one goes on."""
    return case.first > 0 and not case.restarts if note.startswith("the interaction ended") else True


def figure(rows: Sequence[Mapping[str, Any]], long: Mapping[str, Any] | None) -> Figure:
    """Error of each case over the undisturbed one; memory and drift of the long session."""
    made, axes = plt.subplots(
        1, 1 if long is None else 2, figsize=(8 if long is None else 12, 7.5), layout="constrained", squeeze=False,
        width_ratios=None if long is None else [1.7, 1],
    )  # fmt: skip
    left = axes[0, 0]
    heights = np.arange(len(rows))[::-1]
    ratios = [of["ratio"] if of["ratio"] is not None else np.nan for of in rows]
    left.barh(heights, ratios, color=[VERDICTS[of["verdict"]] for of in rows], height=0.7)
    left.axvline(HANDLED, c="0.4", ls=":", lw=1)
    for height, ratio in zip(heights, ratios, strict=True):
        if np.isnan(ratio):
            left.text(0.02, height, "refused, with a reason", va="center", fontsize=7)
    left.set_xlim(0, max(2.0, 1.1 * np.nanmax(ratios)))
    left.set_yticks(heights, [of["case"] for of in rows], fontsize=7)
    left.set_xlabel(f"error {HORIZON:g} s ahead over that of the undisturbed [1]; dotted: {HANDLED:g}")
    used = [name for name in VERDICTS if any(of["verdict"] == name for of in rows)]
    left.legend([plt.Rectangle((0, 0), 1, 1, color=VERDICTS[name]) for name in used], used, fontsize=8)
    left.grid(alpha=0.3, axis="x")
    if long is not None:
        right = axes[0, 1]
        minutes = [of["minutes"] for of in long["track"]]
        right.plot(minutes, [of["memory"] for of in long["track"]], c=figures.colour("ebip_tuned"), lw=1.2)
        right.set_xlabel("interaction time in one session [min]")
        right.set_ylabel("resident memory [MiB]")
        right.set_ylim(0)
        right.grid(alpha=0.3)
    return made


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the experiment from the command line; exit status 1 if anything goes unnoticed."""
    options = _parser().parse_args(arguments)
    torch.set_num_threads(1)
    if options.quick:
        options.minutes, options.interactions = min(options.minutes, 0.5), min(options.interactions, 3)
    demonstrations, _ = load(options.data, 40 if options.quick else 100, options.seed)
    settings = {key: getattr(options, key) for key in ("data", "model", "minutes", "interactions", "seed")}
    run = RunFolder("clocks", settings, options.out, options.force, arguments)
    training, testing = split(len(demonstrations), 1, 0, options.seed)
    if options.model is None:
        with learning_bar() as progress:
            model = learn(demonstrations.subset(training), steps=0, seed=options.seed, progress=progress)
    else:
        model = InteractionModel.load(options.model)
    shown = demonstrations.subset(testing[: options.interactions])
    rows = measured(model, shown)
    long = None
    if options.minutes > 0:
        with tqdm(total=round(60 * options.minutes), desc="one session", unit="s", dynamic_ncols=True) as bar:
            long = long_session(model, shown, options.minutes, bar.update)
    results = {"experiment": "clocks", "horizon": HORIZON, "shown": len(shown), "rows": rows, "long": long}
    save_figure(figure(rows, long), run.path / "clocks.png")
    run.finish(results)
    _print(results)
    print(f"written to {run.path}")
    if any(of["verdict"] == "neither" for of in rows):
        raise SystemExit(1)


def measured(model: InteractionModel, shown: Demonstrations) -> list[dict[str, Any]]:
    """All lines of the table."""
    sensors = tuple(modality.name for modality in shown.layout.modalities if not modality.controlled)
    rows: list[dict[str, Any]] = []
    usual: set[str] = set()
    found = cases(sensors[0], sensors)
    with tqdm(total=len(found) * len(shown), unit="interaction", dynamic_ncols=True) as bar:
        for case in found:
            outcomes = []
            for number in range(len(shown)):
                outcomes.append(outcome(model, shown, number, case))
                bar.update()
            rows.append(row(case, outcomes, rows[0]["error"] if rows else None, usual))
            usual = usual or {note for of in outcomes for note in of.notes}
            ratio = rows[-1]["ratio"]
            bar.set_postfix_str(f"error {'-' if ratio is None else f'{ratio:.2f}'} x undisturbed")
    return rows


def _print(results: Mapping[str, Any]) -> None:
    title = f"{results['shown']} interactions, forecasts {results['horizon']:g} s ahead, second half"
    table = Table(title=title, title_justify="left")
    table.add_column("what is wrong", overflow="fold", max_width=44)
    for head in ("error", "times\nundisturbed", "its own\ndeviation", f"beyond {FAR:g}\nof them [%]"):
        table.add_column(head, justify="right")
    table.add_column("verdict")
    table.add_column("said, for one", overflow="fold")
    for of in results["rows"]:
        numbers = [("error", ".3f"), ("ratio", ".2f"), ("deviation", ".3f")]
        cells = ["-" if of[key] is None else format(of[key], form) for key, form in numbers]
        far = "-" if of["far"] is None else f"{100 * of['far']:.1f}"
        table.add_row(of["case"], *cells, far, of["verdict"], of["note"])
    CONSOLE.print(table)
    if long := results["long"]:
        track = long["track"]
        early, late = track[len(track) // 10], track[-1]
        drift = max(of["drift"] for of in track)
        print(
            f"one session: {long['interactions']} interactions, {long['forecasts']:,} forecasts, "
            f"{late['minutes']:.0f} min; memory {late['memory']:.0f} MiB, {late['memory'] - early['memory']:+.1f} "
            f"since a tenth; errors differ from those of the same interaction shown first by at most {drift:.2g}"
        )


def _parser() -> argparse.ArgumentParser:
    parser = experiment_parser("clocks", __doc__)
    parser.add_argument("--data", metavar="FILE.npz", help="recordings in the project's format (default: simulated)")
    parser.add_argument("--model", metavar="FILE", help="that was learned (default: learn one, without tuning)")
    parser.add_argument("--interactions", type=int, default=20, help="held-out ones to show (default: 20)")
    parser.add_argument(
        "--minutes", type=float, default=60.0, help="of interaction time in one session; 0: none (default: 60)"
    )
    add_run_options(parser, "clocks", "data, split and draws", "three interactions, half a minute")
    return parser


if __name__ == "__main__":
    main()
