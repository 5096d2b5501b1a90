"""The study of clocks at a small size: what is noticed, what is not, and that one session can go on."""

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from experiments.clocks.__main__ import figure, main, row
from experiments.clocks.cases import Case, Scene, cases, samples
from experiments.clocks.sessions import Outcome
from tests.conftest import interactions
from torch_ebip import learn

SENSORS = ("hand", "gaze")
SCENE = Scene(SENSORS, 0.5, 1 / 30)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clocks")
    interactions(20).save(folder / "made.npz")
    learn(interactions(12), steps=0, scan=4).save(folder / "model.safetensors")
    line = ["--data", str(folder / "made.npz"), "--model", str(folder / "model.safetensors"), "--interactions", "1"]
    with suppress(SystemExit):  # where something goes unnoticed: so little was learned from twelve
        main([*line, "--minutes", "0.2", "--out", str(folder / "run")])
    return folder / "run"


def test_the_command_at_a_small_size(finished: Path) -> None:
    results = json.loads((finished / "results.json").read_text())
    rows = {of["case"]: of for of in results["rows"]}
    assert set(rows) == {case.what for case in cases(*SENSORS[:1], SENSORS)}
    plain = rows["undisturbed"]
    assert plain["ratio"] == 1
    assert rows["undisturbed, now not said"]["ratio"] == pytest.approx(1, abs=0.02)
    for same in ("stamps before 1970", "a second interaction, restart", "a ninth interaction, restarts"):
        assert rows[same]["error"] == pytest.approx(plain["error"], rel=1e-3)
    for corrected in (of for name, of in rows.items() if name.endswith("corrected, now right")):
        assert corrected["ratio"] == pytest.approx(1, abs=0.05)
        assert "taken out of its stamps" in corrected["note"]
    assert rows["stamps in milliseconds"]["verdict"] == "reported"
    assert "milliseconds" in rows["stamps in milliseconds"]["note"]
    assert rows["hand's clock jumps by +2 s"]["said"] == 1
    assert (finished / "clocks.png").stat().st_size > 10_000


def test_one_session_goes_on_as_it_began(finished: Path) -> None:
    long = json.loads((finished / "results.json").read_text())["long"]
    assert long["interactions"] >= 6
    assert max(of["drift"] for of in long["track"]) == 0
    assert long["track"][-1]["minutes"] > 0.1


def _outcome(error: float, *notes: str) -> Outcome:
    return Outcome(np.full(4, error), np.full(4, 0.1), np.zeros(4), notes)


def test_verdicts() -> None:
    usual = {"head is suspect"}
    assert row(Case("a"), [_outcome(0.1)], None, usual)["verdict"] == "handled"
    assert row(Case("a"), [_outcome(0.2, "a clock jumped")], 0.1, usual)["verdict"] == "reported"
    silent = row(Case("a"), [_outcome(0.2, "head is suspect")], 0.1, usual)
    assert (silent["verdict"], silent["note"]) == ("neither", "")
    ended = "the interaction ended at 1 s: what comes after needs `restart`"
    assert row(Case("a"), [_outcome(0.2, ended)], 0.1, usual)["verdict"] == "neither"
    assert row(Case("a", first=1), [_outcome(0.2, ended)], 0.1, usual)["verdict"] == "reported"
    assert row(Case("a", knowable=False), [_outcome(0.2)], 0.1, usual)["verdict"] == "nothing can tell"
    nothing = row(
        Case("a"), [_outcome(0.2)._replace(error=np.empty(0), deviation=np.empty(0), far=np.empty(0))], 0.1, usual
    )
    assert nothing["ratio"] is None
    assert figure([silent, nothing], None).axes


def test_changes_are_what_they_say() -> None:
    shown = interactions(1, seed=3)
    before = list(samples(shown, 0, SENSORS))
    by_what = {case.what: [case.change(sample, SCENE) for sample in before] for case in cases("hand", SENSORS)}
    offsets = {
        what: {name: {round(a.stamp - b.stamp, 6) for a, b in zip(after, before, strict=True) if a.sensor == name}
               for name in SENSORS} for what, after in by_what.items()
    }  # fmt: skip
    assert offsets["all clocks jump by +2 s, now right"] == {"hand": {0.0, 2.0}, "gaze": {0.0, 2.0}}
    assert offsets["hand's clock jumps by -0.5 s"] == {"hand": {0.0, -0.5}, "gaze": {0.0}}
    assert offsets["all stamped on arrival, 0.3 s late"] == {"hand": {0.3}, "gaze": {0.3}}
    arrivals = [
        a.arrives - a.stamp for a in by_what["hand arrives 0.2 s late, stamped as taken"] if a.sensor == "hand"
    ]
    np.testing.assert_allclose(arrivals, 0.2)
    one = by_what["one sample of each sensor 2 s ahead, now not said"]
    assert [sum(a.stamp > a.taken + 1 for a in one if a.sensor == name) for name in SENSORS] == [1, 1]
    shaken = [a.stamp - a.taken for a in by_what["all stamps shaken by 10 ms"]]
    assert 0.008 < max(np.abs(shaken)) <= 0.01
    assert min(shaken) < 0 < max(shaken)
