"""The same seed gives the same table; a run can be run again from what it says of itself."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from experiments.rerun import compare, main
from torch_ebip.common.files import read_json, write_json

THREADS_TOLERANCE = 1e-4
"""Relative; sums are made in another order. Measured: 8e-6 for `experiments.tune --quick` on 40 demonstrations."""
RUN = [
    "--quick",
    "--demonstrations",
    "30",
    "--folds",
    "2",
    "--methods",
    "ebip",
    "ridge",
    "--subsets",
    "shoe+imu",
]


def run(out: Path, threads: int) -> Any:
    """Results of a small comparison in one process with some threads."""
    line = [sys.executable, "-m", "experiments.compare", *RUN, "--workers", "1", "--out", str(out)]
    subprocess.run(line, check=True, capture_output=True, env={**os.environ, "OMP_NUM_THREADS": str(threads)})
    return read_json(out / "results.json")


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "first"
    run(out, 1)
    return out


def test_results_say_how_they_came_about(first: Path) -> None:
    said = read_json(first / "results.json")["run"]
    assert said["experiment"] == "compare"
    assert said["arguments"] == [*RUN, "--workers", "1"]
    assert said["threads"] == said["processes"] == 1
    assert said["settings"]["seed"] == 0
    assert {"torch", "numpy", "python"} <= set(said["versions"])
    assert {"commit", "changed_since_commit", "machine", "working_folder"} <= set(said)


def test_one_thread_gives_the_same_bits(first: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    main([str(first), "--out", str(tmp_path / "again")])
    said = capfd.readouterr().out
    assert "largest relative difference 0, tolerated 0" in said
    assert "0 of 0" not in said
    rows = read_json(first / "results.json")["rows"]
    assert len(rows) > 10
    assert rows == read_json(tmp_path / "again" / "results.json")["rows"]


def test_two_threads_differ_by_rounding(first: Path, tmp_path: Path) -> None:
    other = run(tmp_path / "two", 2)
    assert other["run"]["threads"] == 2
    comparison = compare(read_json(first / "results.json"), other)
    assert comparison.compared > 200
    assert comparison.largest < THREADS_TOLERANCE


def test_what_differs_is_found() -> None:
    before = {"rows": [{"mean": 1.0, "n": 3, "seconds": 4.0}, {"mean": None}], "run": {"threads": 1}, "seconds": 9}
    after = json.loads(json.dumps(before))
    after["rows"][0] |= {"mean": 1.1, "seconds": 5.0}
    after["run"]["threads"] = 2
    comparison = compare(before, after)
    assert (comparison.compared, comparison.left_out) == (4, 3)
    assert [(d.place, d.before, d.after) for d in comparison.differing] == [("rows/0/mean", 1.0, 1.1)]
    assert comparison.largest == pytest.approx(0.1 / 1.1)
    after["rows"].append({})
    after["rows"][1]["mean"] = 1.0
    assert {d.place for d in compare(before, after).differing} == {"rows/length", "rows/0/mean", "rows/1/mean"}
    assert compare(before, after).largest == float("inf")


def test_a_difference_ends_with_an_error(first: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    spoiled = read_json(first / "results.json")
    spoiled["rows"][0]["mean"] *= 1.01
    write_json(tmp_path / "spoiled" / "results.json", spoiled)
    with pytest.raises(SystemExit, match="1"):
        main([str(tmp_path / "spoiled"), "--out", str(tmp_path / "again")])
    assert "rows/0/mean" in capfd.readouterr().out


@pytest.mark.parametrize(
    "content", [None, "{}", "[]", '{"run": 3}', '{"run": {"experiment": "../x", "arguments": []}}']
)
def test_what_is_no_run_is_named(content: str | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "results.json").write_text(content)
    with pytest.raises(SystemExit, match="not a finished run that says how to run it again"):
        main([str(tmp_path)])
