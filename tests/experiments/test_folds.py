"""Folds and interactions shared among processes come back in their order."""

from pathlib import Path

import numpy as np
import pytest

from experiments.folds import interleave, mean_of_cells, merge, read_values, run_folds, write_values
from experiments.results import Cell
from torch_ebip.learning.ranks import Ranks

CELL = Cell("all", 0.5, "mae", "robot", "rad")


def values(*numbers: float) -> dict:
    return {CELL: {"a": np.array(numbers), "b": -np.array(numbers)}}


class Together(Ranks):
    """A rank that knows what the others will have gathered."""

    def gather(self, item):
        return [[fold(i) for i in range(rank, 5, self.size)] for rank in range(self.size)]


def fold(number: int) -> dict:
    """The values of one fold."""
    return values(10.0 * number, 10.0 * number + 1)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_interactions_shared_by_rank_come_back_in_order(size: int) -> None:
    parts = [values(*range(rank, 7, size)) for rank in range(size)]
    whole = interleave(parts)
    assert whole[CELL]["a"].tolist() == list(range(7))
    assert whole[CELL]["b"].tolist() == [-i for i in range(7)]


@pytest.mark.parametrize("rank", [0, 1])
def test_folds_shared_by_rank_come_back_in_order(rank: int) -> None:
    ran = []

    def run(number: int) -> dict:
        """Remember who did it."""
        ran.append(number)
        return fold(number)

    whole = run_folds(run, range(5), 1, lambda values: "", Together(rank, 2))
    assert ran == list(range(rank, 5, 2))
    assert whole[CELL]["a"].tolist() == merge([fold(i) for i in range(5)])[CELL]["a"].tolist()


def test_values_come_back_from_their_file_as_they_were(tmp_path: Path) -> None:
    """Infinite is where a method gave up, NaN where it was not asked."""
    written = {CELL: {"a": np.array([0.1, np.nan, np.inf]), "b": np.array([-np.inf, 1e-300, 3.0])}}
    write_values(tmp_path / "values.json", written)
    read = read_values(tmp_path / "values.json")
    assert list(read) == [CELL]
    for name, array in written[CELL].items():
        np.testing.assert_array_equal(read[CELL][name], array)


def test_the_headline_is_of_the_end() -> None:
    near = CELL._replace(ahead=0.1)
    asked = {**values(1.0, 3.0), near: {"a": np.array([100.0, 100.0])}}
    assert mean_of_cells(asked, "a", "mae") == 2.0
    assert np.isnan(mean_of_cells(asked, "c", "mae"))
