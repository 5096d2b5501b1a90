import io

import numpy as np
import pytest
from rich.console import Console
from scipy.stats import mannwhitneyu, wilcoxon

from experiments.comparisons import holm, verdicts
from experiments.results import Cell, markdown, print_tables, summarise

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
    tests = {"p_value", "p_holm", "p_paired", "p_paired_holm", "lead", "lead_paired"}
    assert set(comparison) == {"subset", "observed", "metric", "modality", "a", "b"} | tests
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


def test_holms_correction() -> None:
    """A worked example (Holm 1979 has none; Aickin & Gensler 1996, Table 1), and what it promises."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    false_alarms = [min(holm(p)) < 0.05 for p in np.random.default_rng(1).random((4000, 27)).tolist()]
    assert np.mean(false_alarms) == pytest.approx(0.05, abs=0.012)


def test_a_reference_is_told_where_it_is_worse() -> None:
    """Better in one cell, worse in another, and in a third, where chance alone speaks, neither."""
    generator = np.random.default_rng(3)
    cells = [Cell(subset, 0.82, "mae", "ball", "m") for subset in ("better", "worse", "same")]
    values = {}
    for cell, step in zip(cells, (0.3, -0.3, 0.0), strict=True):
        hard = generator.normal(5, 3, 60)  # what is hard for one is hard for all: only pairs tell
        values[cell] = {"a": hard, "b": hard + step + generator.normal(0, 0.3, 60)}
    results = summarise(values, "a")
    (verdict,) = verdicts(results)
    assert (verdict["method"], verdict["cells"], verdict["better"], verdict["worse"]) == ("b", 3, 1, 1)
    paired = [wilcoxon(values[cell]["a"] - values[cell]["b"]).pvalue for cell in cells]
    assert [c["p_paired"] for c in results["comparisons"]] == pytest.approx(paired)
    assert verdict["p_worse"] == pytest.approx(3 * paired[1]) or verdict["p_worse"] == pytest.approx(2 * paired[1])
    text = markdown(results)
    assert "1 / 1 of 3, p " in text
    (line,) = (line for line in text.splitlines() if line.startswith("| `b`") and "±" in line)
    assert ["†" in cell for cell in line.split("|")[2:5]] == [True, True, False]
    assert verdicts(summarise(values)) == []


def test_a_verdict_goes_by_the_test_not_by_a_few_outliers() -> None:
    """Of 60 pairs the reference wins 55; the five it loses, it loses by far, so that its mean is larger."""
    ours = np.random.default_rng(0).uniform(1, 2, 60)
    theirs = ours + 0.1
    ours[:5] += 5
    cell = Cell("all", 0.82, "mae", "ball", "m")
    (verdict,) = verdicts(summarise({cell: {"a": ours, "b": theirs}}, "a"))
    assert ours.mean() > theirs.mean()
    assert (verdict["better"], verdict["worse"]) == (1, 0)
    (verdict,) = verdicts(summarise({cell._replace(metric="accuracy"): {"a": ours, "b": theirs}}, "a"))
    assert (verdict["better"], verdict["worse"]) == (0, 1)
    assert verdicts(summarise({cell._replace(metric="coverage_95"): {"a": ours, "b": theirs}}, "a")) == []
