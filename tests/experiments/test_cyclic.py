"""The study of waves, end to end, and the people in it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from experiments.cyclic.__main__ import main
from experiments.cyclic.jobs import AHEAD, BEGINNINGS, METHODS
from experiments.cyclic.table import summarise
from experiments.cyclic.waves import RATE, waves


def test_people_share_a_movement_and_each_has_a_manner() -> None:
    made, again, others = waves(6, 1), waves(6, 1), waves(6, 2)
    for a, b in zip(made.recordings, again.recordings, strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(made.recordings[0][:20], others.recordings[0][:20])
    for values, phase in zip(waves(40, 3).recordings, waves(40, 3).phases, strict=True):
        assert len(values) == len(phase)
        assert (phase.diff() > 0).all()
        assert float(phase[0]) == 0
        assert 1.5 < float(phase[-1]) < 7
        assert 0.6 < len(values) / RATE / float(phase[-1]) < 3
    first = torch.stack([phase[0] for phase in waves(40, 3, anywhere=True).phases])
    assert 0.2 < float(first.std()) < 0.4


def test_the_command_at_a_small_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = ["--quick", "--workers", "1", "--out", str(tmp_path / "run")]
    main(run)
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    rows = {(row["beginning"], row["method"], row["ahead"]): row for row in results["rows"]}
    assert len(rows) == len(METHODS) * len(AHEAD)
    for row in rows.values():
        assert 0 < row["error"] < 0.5
        assert 0 < row["inside"] <= 1
    assert rows[BEGINNINGS[-1], "ebip_tuned", 0.1]["ratio"] < 1  # the circle was found, and pays, of 14 recordings
    assert rows[BEGINNINGS[-1], "ebip_tuned", 0.1]["phase_error"] < 0.15
    assert (tmp_path / "run" / "cyclic.png").stat().st_size > 20_000
    assert "ebip_circle" in (tmp_path / "run" / "results.md").read_text()
    assert "anywhere" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="finished run"):
        main(run)
    with pytest.raises(SystemExit, match="--sets of at least 1"):
        main(["--sets", "0", "--out", str(tmp_path / "other")])


def test_ratios_are_of_the_same_people() -> None:
    usual = {"beginning": "anywhere", "inside": 0.9, "phase": 0.01}
    answers = [
        {**usual, "method": method, "number": n, "ahead": ahead, "squared": square * (n + 1)}
        for method, square in zip(METHODS, (1.0, 4.0, 1.0, 2.0), strict=True)
        for n in range(5)
        for ahead in AHEAD
    ]
    rows = {(row["method"], row["ahead"]): row for row in summarise(answers, 0)}
    assert rows["ebip_tuned", 0.5]["ratio"] == pytest.approx(0.5)
    assert rows["ebip_tuned", 0.5]["low"] == pytest.approx(0.5)
    assert rows["ebip_circle", 0.5]["ratio"] == pytest.approx(0.5**0.5)
    assert rows["ebip_tuned", 0.5]["phase_error"] == pytest.approx(0.1)
    assert "ratio" not in rows["ebip_once", 0.5]
