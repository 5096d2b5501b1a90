"""`python -m experiments.ball_catching`: make the data set, say what is in it, draw one demonstration."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence

from experiments.ball_catching.dataset import load_or_generate


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.ball_catching", description=__doc__)
    parser.add_argument("--n", type=int, default=221, help="number of demonstrations (default: 221, as in the paper)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", metavar="FILE.npz", help="also write the demonstrations here")
    parser.add_argument("--figure", metavar="FILE.png", help="draw one demonstration with all its sensors")
    parser.add_argument("--index", type=int, default=0, help="which demonstration the figure shows (default: 0)")
    options = parser.parse_args(arguments)
    if options.n < 1:
        parser.error(f"--n must be at least 1, got {options.n}")
    if not 0 <= options.index < options.n:
        parser.error(f"--index must be between 0 and {options.n - 1}, got {options.index}")

    demonstrations = load_or_generate(options.n, options.seed)
    columns, durations = demonstrations.columns, demonstrations.durations
    print(demonstrations)
    print(f"durations {durations.min():.2f} to {durations.max():.2f} s, mean {durations.mean():.2f} s")
    print(f"release at {columns['release_phase'].mean():.1%} of the interaction on average")
    print(
        "styles:",
        ", ".join(f"{style} {count}" for style, count in Counter(columns["style"].tolist()).most_common()),
    )
    if options.out:
        demonstrations.save(options.out)
        print(f"written: {options.out}")
    if options.figure:
        from experiments.ball_catching.figure import draw

        draw(demonstrations, options.index).savefig(options.figure, dpi=110)
        print(f"drawn: {options.figure}")


if __name__ == "__main__":
    main()
