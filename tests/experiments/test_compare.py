"""The comparison at a small size, through its command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments import compare, computation_time, uncertainty
from experiments.data import choose_subsets, load
from experiments.entries import METHODS, WITHOUT
from experiments.paper_table import paper_rows
from experiments.results import Cell, grids, markdown, summarise
from tests.conftest import interactions

FEW = ["--methods", "mean", "nearest", "ridge", "bip", "ebip", "ebip_tuned", "particle_filter"]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("data") / "made.npz"
    interactions(30).save(path)
    return str(path)


@pytest.fixture(scope="module")
def finished(recordings: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    compare.main(["--data", recordings, "--quick", "--steps", "2", *FEW, "--out", str(out)])
    return out


def test_the_table_has_every_cell(finished: Path) -> None:
    results = json.loads((finished / "results.json").read_text())
    rows = [row for row in results["rows"] if "ahead" not in row]
    later = [row for row in results["rows"] if "ahead" in row]
    assert {(row["ahead"], row["method"]) for row in later} >= {
        (ahead, method) for ahead in (0.1, 0.25, 0.5) for method in FEW[1:]
    }
    assert {row["method"] for row in rows} == set(FEW[1:])
    assert {(row["subset"], row["observed"]) for row in rows} == {
        (subset, fraction) for subset in ("hand", "gaze", "all") for fraction in (0.43, 0.82)
    }
    assert all(row["n"] == 30 for row in rows)
    assert set(results["seconds_by_method"]) == set(FEW[1:])
    ends = [c for c in results["comparisons"] if "ahead" not in c]
    best = {(c["subset"], c["observed"], c["metric"], c["modality"]): c["a"] for c in ends}
    for key, name in best.items():
        means = {
            r["method"]: r["mean"] for r in rows if (r["subset"], r["observed"], r["metric"], r["modality"]) == key
        }
        score = {m: abs(v - 0.95) if key[2] == "coverage_95" else v for m, v in means.items()}
        assert score[name] == min(score.values())
    assert (finished / "results.png").stat().st_size > 10_000
    text = (finished / "results.md").read_text()
    assert "**mae arm [" in text
    assert "by seconds ahead**" in text
    assert (finished / "horizons.png").stat().st_size > 10_000
    assert "| `ebip_tuned` |" in text


def test_the_tuned_filter_without_its_parts_is_another(recordings: str, tmp_path: Path) -> None:
    names = list(WITHOUT)
    few = ["--folds", "2", "--subsets", "hand", "--methods", *names]
    compare.main(["--data", recordings, "--quick", "--steps", "2", *few, "--out", str(tmp_path / "run")])
    reports = {name: json.loads((tmp_path / f"run/fold-00/{name}/report.json").read_text()) for name in names}
    settings = {name: report["settings"] for name, report in reports.items()}
    assert [settings[name]["memories"] for name in names] == [2, 1, 2, 2, 2]
    assert [settings[name]["ahead"] == ["end"] for name in names] == [True, False, False, False, False]
    assert ["shrinkage" in reports[name] for name in names] == [True, True, False, True, True]
    assert ["gradient" in reports[name]["stages"] for name in names] == [True, True, True, False, True]
    assert [settings[name]["analogues"] for name in names] == [True, True, True, True, False]
    results = json.loads((tmp_path / "run/results.json").read_text())
    means = [
        tuple(row["mean"] for row in results["rows"] if row["method"] == name and row["metric"] == "mae")
        for name in names
    ]
    # So few demonstrations have no analogues, with or without the option.
    assert len(set(means[:-1])) == len(names) - 1


def test_an_interrupted_study_loses_no_finished_method(
    finished: Path, recordings: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without its results and one method of one fold the run resumes: only that method is computed again."""
    before = json.loads((finished / "results.json").read_text())
    (finished / "results.json").unlink()
    (finished / "fold-01" / "ebip.json").unlink()
    others = {path: path.stat().st_mtime_ns for path in finished.glob("fold-*/*.json") if "seconds" not in path.name}
    compare.main(["--data", recordings, "--quick", "--steps", "2", *FEW, "--out", str(finished)])
    assert {path: path.stat().st_mtime_ns for path in others} == others
    after = json.loads((finished / "results.json").read_text())
    for a, b in zip(before["rows"], after["rows"], strict=True):
        assert a["mean"] == pytest.approx(b["mean"], rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--folds", "31"], "--folds must be between 2 and the 30 demonstrations, got 31"),
        (["--folds", "1"], "--folds must be between 2"),
        (["--subsets", "hand+foot"], r"--subsets hand\+foot: 'foot' is no sensor; known: hand, gaze, all"),
        (["--subsets", "arm"], "'arm' is no sensor"),
        (["--members", "1"], "--members must be at least 2, an ensemble needs a spread; got 1"),
    ],
)
def test_bad_arguments_are_named(recordings: str, tmp_path: Path, arguments: list[str], message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        compare.main(["--data", recordings, *arguments, "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()


def test_the_papers_cells_are_ours() -> None:
    """Every row of the paper's table has a cell and a method here."""
    _, task = load(None, 2, 0)
    table = paper_rows()
    assert "authors" in table["note"]
    assert len(table["rows"]) == 36 + 20
    for row in table["rows"]:
        assert row["method"] in METHODS
        assert row["subset"] in task.subsets
        assert row["observed"] in task.fractions
        assert (row["subset"], row["observed"]) not in task.skipped


def test_subsets_by_modality() -> None:
    made = interactions(4)
    _, task = load(None, 2, 0)
    task = task._replace(subsets={"all": ["hand", "gaze"]}, skipped=[])
    assert list(choose_subsets(task, made.layout, [], True).subsets) == ["hand", "gaze", "all"]
    assert dict(choose_subsets(task, made.layout, ["hand+gaze", "all"], True).subsets) == {
        "hand+gaze": ("hand", "gaze"),
        "all": ["hand", "gaze"],
    }


def test_marks_follow_the_tests() -> None:
    generator = np.random.default_rng(0)
    cells = [Cell(s, 0.82, "mae", "ball", "m") for s in ("ball", "all")]
    values = {
        cell: {
            "a": generator.normal(0.02, 0.005, 60),
            "b": generator.normal(0.02, 0.005, 60) + 0.0005,
            "c": generator.normal(0.04, 0.005, 60),
        }
        for cell in cells
    }
    del values[cells[1]]["b"]
    results = summarise(values)
    grid = grids(results)[0]
    assert grid.title == "mae ball [mm]"
    first, second, third = (grid.lines[name] for name in "abc")
    assert first[0][1]
    assert second[0][0].endswith("°")
    assert not third[0][0].endswith("°")
    assert second[1][0] == second[-1][0] == "-"
    assert first[0][0].startswith(f"{1e3 * values[cells[0]]['a'].mean():.3g}")
    assert "**" in markdown(results)


def test_uncertainty_writes_its_pictures(recordings: str, tmp_path: Path) -> None:
    out = tmp_path / "run"
    uncertainty.main(["--data", recordings, "--quick", "--steps", "2", "--out", str(out)])
    results = json.loads((out / "results.json").read_text())
    names = {"error", "calibration", "attribution", "frames-ebip", "frames-ebip_tuned", "frames-particle_filter"}
    assert {path.stem for path in out.glob("*.png")} == names
    for name in ("ebip", "ebip_tuned", "particle_filter"):
        report = results["calibration"][name]
        assert sum(report["rank_histogram"]) == pytest.approx(1)
        assert report["empirical"] == sorted(report["empirical"])
        assert report["n"] == 6 * 4 * 2
    assert {row["observed"] for row in results["rows"]} == {round(0.05 * i, 2) for i in range(1, 20)}
    with pytest.raises(SystemExit, match="--interaction must be between 0 and 5"):
        uncertainty.main(["--data", recordings, "--interaction", "6", "--out", str(tmp_path / "other")])
    with pytest.raises(SystemExit, match="--dof nose is not forecast"):
        uncertainty.main(["--data", recordings, "--dof", "nose", "--out", str(tmp_path / "other")])


def test_computation_time_writes_its_figure(recordings: str, tmp_path: Path) -> None:
    out = tmp_path / "run"
    computation_time.main(["--data", recordings, "--quick", "--out", str(out)])
    results = json.loads((out / "results.json").read_text())
    assert {row["method"] for row in results["by_length"]} == {"bip", "particle_filter", "ebip"}
    assert all(row["seconds"] > 0 for row in results["by_length"])
    assert [row["members"] for row in results["by_members"] if row["method"] == "ebip"] == [10, 20, 24]
    assert results["time_relative_to_ebip"]["ebip"] == 1
    assert (out / "computation_time.png").exists()
