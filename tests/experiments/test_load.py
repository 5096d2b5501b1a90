"""The load test pushes and asks as often as it says, and counts what came too late."""

import json
from pathlib import Path

import pytest

from experiments.load.__main__ import main
from tests.conftest import interactions


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    interactions(20).save(tmp_path / "made.npz")
    out = tmp_path / "run"
    main(
        ["--data", str(tmp_path / "made.npz"), "--seconds", "4", "--threads", "2", "--rate", "200", "--out", str(out)]
    )
    results = json.loads((out / "results.json").read_text())
    assert results["asked"] == pytest.approx(240, abs=5)
    assert 400 < results["pushed"] <= 2 * 801
    assert results["refused"] == 0
    assert results["times"]["push"]["50.0"] > results["times"]["bare"]["50.0"] > 0
    assert (out / "load.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "push p99.9 over that of a bare queue" in printed
