"""The soak runs, and its verdict catches what it is there for."""

import itertools
import json
import mmap
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from experiments.soak.__main__ import main
from experiments.soak.stream import Sample, stream
from experiments.soak.subjects import SUBJECTS, Health
from experiments.soak.watch import Window, verdict, watch
from tests.conftest import interactions, small_primitive

SENSORS = torch.tensor([True, True, True, False, False])


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("data") / "made.npz"
    interactions(20).save(path)
    return str(path)


def exit_status(arguments: list[str]) -> int:
    """What the command ends with."""
    try:
        main(arguments)
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def test_the_command_line(recordings: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = [
        "--data",
        recordings,
        "--steps",
        "1500",
        "--filters",
        "closed_form",
        "sessions",
        "--out",
        str(tmp_path / "r"),
    ]
    status = exit_status(run)
    results = json.loads((tmp_path / "r" / "results.json").read_text())
    assert status == (1 if results["wrong"] else 0)
    assert {row["name"]: row["steps"] for row in results["filters"]} == {"closed_form": 1500, "sessions": 1000}
    # Times are the machine's affair; all else must hold.
    assert all("times as long" in text for wrong in results["wrong"].values() for text in wrong)
    assert len(results["filters"][0]["windows"]) == 15
    assert (tmp_path / "r" / "soak.png").stat().st_size > 10_000
    assert "1,500" in capsys.readouterr().out
    (tmp_path / "r" / "results.json").unlink()
    record = tmp_path / "r" / "soak_closed_form.json"
    before = record.stat().st_mtime_ns
    spoiled = json.loads(record.read_text()) | {"wrong": ["spoiled"]}
    record.write_text(json.dumps(spoiled))
    assert exit_status(run) == 1  # and what is finished is not run again
    assert json.loads(record.read_text())["wrong"] == ["spoiled"]
    assert before <= record.stat().st_mtime_ns


@pytest.mark.parametrize("name", SUBJECTS)
def test_every_subject_takes_a_thousand_steps(name: str) -> None:
    samples = stream(interactions(4, seed=9), SENSORS, 0)
    windows = list(watch(lambda: SUBJECTS[name](small_primitive(), SENSORS, 0), samples, 1000, 4))
    assert [window.step for window in windows] == [250, 500, 750, 1000]
    assert all(window.finite and not window.error for window in windows)
    assert all(0 < window.median <= window.p99 for window in windows)
    assert all(window.memory > 10 for window in windows)


def test_the_stream_has_all_that_goes_wrong() -> None:
    shown = interactions(3, seed=9)
    samples = list(itertools.islice(stream(shown, SENSORS, 1), 4000))
    again = list(itertools.islice(stream(shown, SENSORS, 1), 4000))
    assert all(torch.equal(a.observed, b.observed) and a.dt == b.dt for a, b in zip(samples, again, strict=True))
    observed = torch.stack([sample.observed for sample in samples])
    assert not observed[:, 3:].any()
    assert torch.equal(observed, torch.stack([sample.y for sample in samples]).isfinite())
    assert 0.65 < observed[:, 2].double().mean() < 0.8  # alone in its modality, without gaps of its own
    gaze = "".join("x" if seen else "." for seen in observed[:, 2].tolist())
    assert "." * 12 in gaze  # 0.2 ** 12 is no accident: silence
    steps = torch.tensor([sample.dt for sample in samples]) * 30
    assert 0.5 <= steps.min() < 0.55
    assert 1.45 < steps.max() <= 1.5
    assert samples[0].first
    assert 4000 / 50 <= sum(sample.first for sample in samples) <= 4000 / 29


class Stand:
    """A subject that misbehaves as it is told to."""

    def __init__(self, leak: int = 0, slow: int = 0, bad: int | None = None, error: int | None = None) -> None:
        self.leak, self.slow, self.bad, self.error = leak, slow, bad, error
        self.kept: list[mmap.mmap] = []
        self.steps = 0

    def begin(self) -> None:
        pass

    def step(self, sample: Sample) -> None:
        self.steps += 1
        if self.leak:  # pages of its own: free ones of the heap would hide the leak
            self.kept.append(mmap.mmap(-1, self.leak))
            self.kept[-1].write(b"x" * self.leak)
        for _ in range(500 + self.slow * self.steps):
            pass
        if self.steps == self.error:
            raise ValueError("members were lost")

    def health(self) -> Health:
        return Health(self.bad is None or self.steps < self.bad, 0.5, 0.1, 1.0)


def run(**faults: int) -> list[Window]:
    return list(watch(lambda: Stand(**faults), endless(), 1000, 20))


def endless() -> Iterator[Sample]:
    while True:
        yield Sample(False, 0.1, torch.zeros(1), torch.ones(1, dtype=torch.bool))


@pytest.mark.parametrize(
    ("faults", "expected"),
    [
        ({"leak": 60_000}, "memory grew from"),
        ({"slow": 40}, "times as long at the end"),
        ({"bad": 960}, "NaN or infinite at step 1000"),
        ({"error": 734}, "step 734 could not be taken: members were lost"),
    ],
)
def test_what_goes_wrong_is_caught(faults: dict[str, int], expected: str) -> None:
    assert any(expected in text for text in verdict(run(**faults)))


def test_what_goes_well_is_not() -> None:
    assert not [text for text in verdict(run()) if "times as long" not in text]
    assert verdict([Window(i, 1e-3, 2e-3, 1e-4, 300 + 0.1 * i, True, 0.5, 0.1, 1.0) for i in range(100)]) == []
    # A machine that slows down slows the twin as well.
    assert verdict([Window(i, i * 1e-3, 1, i * 1e-4, 300, True, 0.5, 0.1, 1.0) for i in range(1, 101)]) == []
    assert "too few" in verdict([Window(1, 1, 1, 1, 300, True, 0.5, 0.1, 1.0)])[0]


def test_too_few_steps_are_named() -> None:
    with pytest.raises(SystemExit, match="--steps must be at least 1000, got 10"):
        main(["--steps", "10"])
