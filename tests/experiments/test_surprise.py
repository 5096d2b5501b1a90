"""The study of lies and strangers: its sets, what it says of them, and its command."""

import json
import math

import numpy as np
import pytest
import torch

from experiments.faults.faults import suffer
from experiments.surprise.__main__ import main
from experiments.surprise.lies import lies
from experiments.surprise.measure import auc, scores
from experiments.surprise.reaches import LAYOUT, RATE, STRANGE, reaches
from torch_ebip import Forecast


def test_reaches_are_their_own_and_strange_ones_are_strange() -> None:
    """The same for the same seed, however many; and each kind is other in what it is called after."""
    few, many = reaches(3, 5), reaches(12, 5)
    assert all(torch.equal(few[i], many[i]) for i in range(3))
    assert not torch.equal(few[0], reaches(3, 6)[0])
    known = {name: reaches(60, 1, change) for name, change in STRANGE.items()} | {"familiar": reaches(60, 1)}
    length = {name: made.lengths.double() for name, made in known.items()}
    assert length["slower"].min() > 2 * length["familiar"].max() - 1
    assert length["faster"].max() < length["familiar"].min() / 2 + 1
    hand = LAYOUT.slice("hand")
    starts, ends = ({n: torch.stack([t[k, hand] for t in d]) for n, d in known.items()} for k in (0, -1))
    for name, place in (("other start", starts), ("other goal", ends)):
        off = (place[name] - place["familiar"].mean(0)).norm(dim=-1).median()
        assert float(off) > 2 * float((place["familiar"] - place["familiar"].mean(0)).norm(dim=-1).median())
    middle = {n: torch.stack([t[len(t) // 2, hand] for t in d]) for n, d in known.items()}
    spread = [float((middle[n] - middle["familiar"].mean(0)).norm(dim=-1).median()) for n in ("detour", "familiar")]
    assert spread[0] > 2 * spread[1]


def test_lies_are_what_they_are_called() -> None:
    tests = reaches(2, 3)
    deviation = torch.full((LAYOUT.n_dofs,), 0.1)
    shown = ["hand", "elbow", "head"]
    said = {f.group: suffer(f, tests, shown, deviation, [0, 1], 0)[1] for f in lies(LAYOUT, "hand", 0.5)}
    true = tests[1]
    np.testing.assert_allclose((said["offset"] - true)[:, :3].norm(dim=-1), 0.5, rtol=1e-5)
    assert torch.equal(said["axes"][:, 0], true[:, 1])
    first = round(0.15 * len(true))
    torch.testing.assert_close(said["unit"][:first, :3], 1000 * true[:first, :3])
    assert torch.equal(said["unit"][first:], true[first:])
    assert torch.equal(said["backwards"][:, :8], true.flip(0)[:, :8])
    assert torch.equal(said["walk"][:, 8:], true[:, 8:])
    assert all(torch.equal(part[:, 8:], true[:, 8:]) for part in said.values())


def test_scores_are_the_formulas() -> None:
    mean, variance = torch.zeros(2, 4, 1, 1), torch.ones(2, 4, 1, 1)
    values = scores("a", Forecast(mean, variance, mean[..., 0]), torch.tensor([[1.0], [5.0]]), "all", "rad")
    by_metric = {cell.metric: arrays["a"].tolist() for cell, arrays in values.items() if cell.observed == 0.5}
    assert by_metric["mae"] == [1.0, 5.0]
    assert by_metric["coverage_95"] == [1.0, 0.0]
    assert by_metric["beyond_4"] == [0.0, 1.0]
    assert by_metric["deviation"] == [1.0, 1.0]
    assert auc(np.array([1.0, 3.0]), np.array([0.0, 2.0])) == 0.75


def test_the_command_finds_who_lies(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["--quick", "--tests", "20", "--faulty", "8", "--steps", "0", "--out", str(tmp_path / "run")])
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    found = results["detection"]["hand off by 0.5"]
    assert found["rate"]["hand"] == 1.0
    assert found["rate"]["elbow"] < 0.2
    assert found["delay"]["hand"] <= 2 / RATE
    assert results["detection"]["backwards"]["auc_by_half"] > 0.95
    assert {row["method"] for row in results["rows"]} == {"ebip_cautious", "ebip_sure", "mean"}
    assert not [row for row in results["rows"] if row["subset"] == "random walk"]
    assert all(math.isfinite(row["mean"]) for row in results["rows"])
    assert set(results["undisturbed"]) == {"0.2", "0.43", "0.5", "0.82"}
    sessions = results["sessions"]
    assert all(0 <= row["outside"] <= 0.25 for rows in sessions.values() for row in rows.values())
    learned = sessions["learned"]
    assert sessions["ebip by hand"]["backwards"]["familiarity"] is None
    assert learned["familiar"]["familiarity"] > 0.01 > learned["backwards"]["familiarity"]
    assert learned["a second interaction"]["familiarity"] < 0.01
    assert learned["hand off by 0.5"]["states"] == {"hand": "rejected", "elbow": "ok", "head": "ok"}
    assert (tmp_path / "run" / "surprise.png").stat().st_size > 10_000
    assert "AUC by half" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="finished run"):
        main(["--quick", "--tests", "20", "--faulty", "8", "--steps", "0", "--out", str(tmp_path / "run")])
    with pytest.raises(SystemExit, match="--sensor must be one of several DoFs"):
        main(["--quick", "--sensor", "arm", "--out", str(tmp_path / "other")])
