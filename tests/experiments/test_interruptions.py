"""The study of interruptions, end to end, and at which moments it asks."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from experiments.interruptions.__main__ import main
from experiments.interruptions.animation import film, tell
from experiments.interruptions.kinds import KINDS, moments
from experiments.interruptions.table import summarise
from tests.conftest import interactions, small_primitive
from torch_ebip import InteractionModel, PhaseBank, ebip
from torch_ebip.common.draws import seeded


def test_the_command_at_a_small_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    interactions(20).save(tmp_path / "made.npz")
    run = ["--data", str(tmp_path / "made.npz"), "--quick", "--methods", "ebip_tuned", "ebip", "--workers", "1"]
    main([*run, "--out", str(tmp_path / "run")])
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    rows = {(row["method"], row["kind"], row["moment"]): row for row in results["rows"]}
    assert {kind for _, kind, _ in rows} == set(KINDS)
    assert rows["ebip_tuned", "undisturbed", "late"]["ratio"] == pytest.approx(1.0)
    for row in rows.values():
        assert row["low"] <= row["ratio"] <= row["high"]
        assert 0 <= row["far"] <= 1
        assert math.isfinite(row["error"])
    assert rows["ebip", "pause of 3 to 5 s", "late"]["ratio"] > 1.5  # the paper's filter is misled
    assert (tmp_path / "run" / "interruptions.png").stat().st_size > 20_000
    assert "started over" in (tmp_path / "run" / "results.md").read_text()
    assert "pause of 1 to 3 s" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="finished run"):
        main([*run, "--out", str(tmp_path / "run")])


def test_a_pause_is_filmed(tmp_path: Path) -> None:
    primitive = small_primitive()
    model = InteractionModel(ebip(primitive, square_root=True, pace=PhaseBank.of(primitive)), primitive)
    values = interactions(3, seed=5)[1].nan_to_num(0.5)
    story, sensor, target = tell(model, values, 1.0, 0)
    assert (sensor, target) == ("hand.x [m]", "arm.1 [rad]")
    assert len(story.time) == len(values) + 30
    np.testing.assert_allclose(story.bank.sum(1), 1, atol=1e-5)
    standing = (np.diff(story.truth) == 0).nonzero()[0]
    assert story.standing[standing[-1]] > 0.8 > story.standing[standing[0]]
    film(model, interactions(3, seed=5).subset([1]), tmp_path / "pause.gif", 0.5)
    assert (tmp_path / "pause.gif").read_bytes()[:4] == b"GIF8"


def test_filters_are_asked_during_after_and_late() -> None:
    values, rate = torch.zeros(200, 5), 60.0
    made = KINDS["pause of 1 to 3 s"](values, rate, torch.zeros(5), seeded(3))
    during, after, late = moments(made, 200, rate)
    assert (during.name, after.name, late.name) == ("during", "after", "late")
    assert made.source[during.sample] == made.source[made.over - 1]
    assert after.sample == made.over + 30
    assert late.source == int(0.82 * 199)
    assert [m.name for m in moments(KINDS["undisturbed"](values, rate, torch.zeros(5), seeded(3)), 200, rate)] == [
        "after",
        "late",
    ]


def test_ratios_are_of_the_same_people() -> None:
    answers = [
        {"method": "m", "kind": "k", "moment": "late", "interaction": i, "error": e, "usual": u, "far": 0.5,
         "deviation": 0.1, "phase_error": 0.02, "source": 3, "squared": 1.0}
        for i, (e, u) in enumerate([(2.0, 1.0), (6.0, 3.0), (4.0, 4.0)])
    ]  # fmt: skip
    (row,) = summarise(answers, "m", 0)
    assert row["ratio"] == pytest.approx(1.5)
    assert row["n"] == 3
    assert row["low"] < 1.5 < row["high"] <= 2.0
