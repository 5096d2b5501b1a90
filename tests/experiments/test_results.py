import io

import numpy as np
import pytest
from rich.console import Console
from scipy.stats import mannwhitneyu

from experiments.results import Cell, print_tables, summarise

GENERATOR = np.random.default_rng(0)
CELLS = [Cell("ball", 0.82, "mae", "robot", "rad"), Cell("all", 0.43, "mae", "robot", "rad")]
VALUES = {
    cell: {name: GENERATOR.normal(mean, 1, 40) for name, mean in (("mean", 5.0), ("ebip_tuned", 0.0))}
    for cell in CELLS
}


def test_rows_follow_the_contract() -> None:
    results = summarise(VALUES, "ebip_tuned")
    row = next(r for r in results["rows"] if r["method"] == "mean" and r["subset"] == "ball")
    expected = {"method", "subset", "observed", "metric", "modality", "unit", "mean", "standard_error", "n"}
    assert set(row) == expected
    sample = VALUES[CELLS[0]]["mean"]
    assert row["mean"] == pytest.approx(sample.mean())
    assert row["standard_error"] == pytest.approx(sample.std(ddof=1) / np.sqrt(40))
    comparison = results["comparisons"][0]
    assert set(comparison) == {"subset", "observed", "metric", "modality", "a", "b", "p_value"}
    assert comparison["p_value"] == pytest.approx(mannwhitneyu(VALUES[CELLS[0]]["ebip_tuned"], sample).pvalue)
    means = [r["mean"] for r in results["rows"] if r["method"] == "mean"]
    summary = next(s for s in results["summary"] if s["method"] == "mean")
    assert summary["mean"] == pytest.approx(np.mean(means))
    assert summary["cells"] == 2


def test_missing_values_are_left_out() -> None:
    values = {CELLS[0]: {"ebip_tuned": np.array([1.0, np.nan, 3.0]), "nearest": np.array([np.nan] * 3)}}
    results = summarise(values, "ebip_tuned")
    assert [(r["method"], r["mean"], r["n"]) for r in results["rows"]] == [("ebip_tuned", 2.0, 2)]
    assert results["comparisons"] == []


def test_the_table_shows_what_the_results_say() -> None:
    console = Console(width=120, record=True, file=io.StringIO())
    print_tables(summarise(VALUES, "ebip_tuned"), console)
    text = console.export_text()
    assert "mae robot" in text
    assert "82%" in text
    assert "*" in text
