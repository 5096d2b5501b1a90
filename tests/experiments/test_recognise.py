"""The studies of recognition and of MoVEInt's protocol, on small sets."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from experiments import compare, moveint, recognise
from experiments.baselines.classifier import RecurrentClassifier, probabilities_of
from experiments.baselines.mixture import MixtureNetwork, next_samples
from torch_ebip import Demonstrations
from torch_ebip.recordings import actions


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> str:
    made = actions(24, 3)
    columns = {
        "kind": np.arange(24.0) % 4,
        "split": (np.arange(24) >= 16).astype(float),
        "action": np.arange(24.0) % 4,
    }
    path = tmp_path_factory.mktemp("data") / "actions.npz"
    Demonstrations(made.layout, list(made), made.rate, columns).save(path)
    return str(path)


def test_recognition_on_generated_actions(tmp_path: Path) -> None:
    recognise.main(["--quick", "--tests", "40", "--workers", "1", "--out", str(tmp_path)])
    results = json.loads((tmp_path / "results.json").read_text())
    at = {(row["method"], row["observed"]): row["mean"] for row in results["rows"] if row["metric"] == "accuracy"}
    assert at["ebip_tuned", 0.4] > 0.9
    assert at["gru", 0.4] > 0.9
    assert 0 <= results["calibration"]["ebip_tuned"]["expected_calibration_error"] < 0.2
    assert (tmp_path / "recognition.png").stat().st_size > 10_000
    with pytest.raises(SystemExit, match="finished run"):
        recognise.main(["--quick", "--tests", "40", "--out", str(tmp_path)])


def test_recordings_of_ones_own_are_labelled_by_a_column(recordings: str, tmp_path: Path) -> None:
    assert set(recognise.labelled(recordings, "kind").labels or ()) == {"0.0", "1.0", "2.0", "3.0"}
    with pytest.raises(SystemExit, match="no column 'who'; it has"):
        recognise.main(["--data", recordings, "--labels", "who", "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()


def test_the_protocol_of_moveint(recordings: str, tmp_path: Path) -> None:
    compare.main(
        ["--protocol", "moveint", "--data", recordings, "--quick", "--workers", "1", "--out", str(tmp_path / "run")]
    )
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    rows = {(row["method"], row["subset"]): row for row in results["rows"]}
    assert {method for method, _ in rows} == set(moveint.METHODS)
    assert all(row["n"] == 2 for row in rows.values())
    for method, value in results["geometric_mean"].items():
        mine = [row["mean"] for (name, _), row in rows.items() if name == method]
        assert value == pytest.approx(np.exp(np.mean(np.log(mine))))
    assert results["geometric_mean"]["ebip_tuned"] < results["geometric_mean"]["mean"]
    plain = str(tmp_path / "plain.npz")
    actions(4).save(plain)
    with pytest.raises(SystemExit, match="needs the columns split and action"):
        compare.main(["--protocol", "moveint", "--data", plain, "--out", str(tmp_path / "other")])
    with pytest.raises(SystemExit, match="needs --data"):
        compare.main(["--protocol", "moveint"])


def test_the_metric_by_hand() -> None:
    """Squared distance summed over x, y, z, averaged over joints and five samples, times 100."""
    made = actions(2, 1)
    tests = Demonstrations(made.layout, list(made), made.rate, {"action": np.array([0.0, 1.0])})
    y, _ = tests.pad()
    said = torch.zeros(2, y.shape[1], 5, 3)
    found = {cell.subset: float(array[0]) for cell, array in moveint.by_action(said, tests).items()}
    for b, name in enumerate(("action 0", "action 1")):
        path, total, count = made[b][:, 3:].double().numpy(), 0.0, 0
        for t in range(len(path)):
            for later in range(t + 1, min(t + 6, len(path))):
                total, count = total + (path[later] ** 2).sum(), count + 1
        assert found[name] == pytest.approx(100 * total / count, rel=1e-5)


def test_networks_look_at_what_is_shown_only_and_a_seed_reproduces() -> None:
    known, tests = actions(20, 1), actions(3, 2)
    y, measured = tests.pad()
    spoiled = y.clone()
    spoiled[..., 3:] = 99.0
    network = MixtureNetwork(known, 5, seed=1, epochs=20)
    assert torch.equal(network(y), MixtureNetwork(known, 5, seed=1, epochs=20)(y))
    assert torch.equal(network(y), network(spoiled))
    future = network(y)[:, 20]
    spoiled[:, 21:] = -5.0
    assert torch.equal(network(spoiled)[:, 20], future)
    inputs = ~known.layout.controlled
    classifier = RecurrentClassifier(known, inputs, seed=1, rounds=40)
    keep = torch.tensor([[20, 50]] * 3)
    said = classifier(y, measured & inputs, keep)
    assert torch.equal(said[:, 0], classifier(spoiled, measured & inputs, keep)[:, 0])
    assert torch.allclose(said.sum(-1), torch.ones(3, 2))
    other = probabilities_of(said, classifier.labels, ("nod", "never", "lift"))
    assert torch.equal(other[..., 1], torch.zeros(3, 2))


def test_the_next_samples_are_those_that_were_recorded() -> None:
    made = actions(2, 1)
    future = next_samples(made, 3)
    for b, path in enumerate(made):
        for t in (0, 20, len(path) - 3, len(path) - 1):
            for k in range(3):
                there = t + 1 + k < len(path)
                wanted = path[t + 1 + k, 3:] if there else torch.full((3,), torch.nan)
                torch.testing.assert_close(future[b, t, k], wanted, equal_nan=True)
