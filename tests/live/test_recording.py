"""A recording replays to the bit; what is no recording, or is damaged, is refused and named."""

from __future__ import annotations

import json
import math
import os
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.live.test_session import filters, live, primitive, samples
from torch_ebip import InteractionSession, ebip, replay
from torch_ebip.live.log import fingerprint


def record(path: Path, name: str = "ebip with options") -> None:
    """An interaction with late, missing, broken and malformed samples, recorded."""
    recording(path, name).close()


def recording(path: Path, name: str = "ebip with options") -> InteractionSession:
    """The same, still open."""
    session = live(name, seed=11, record=path)
    for k, (sensor, value, moment) in enumerate(samples()):
        session.push(sensor, value, moment - (0.1 if k % 7 == 0 else 0.0))
        if k % 5 == 0:
            session.push(sensor, [math.nan, math.inf][: len(value)], moment)
            session.push(sensor, {"not": "numbers"}, moment)
            session.push(sensor, value, "yesterday")
        if k % 3 == 0:
            session.forecast([0.1, 0.3], moment)
        if k % 4 == 0:
            session.advance(moment)
    session.forecast(0.1)
    session.forecast()
    return session


@pytest.mark.parametrize("name", filters())
def test_a_recording_replays_to_the_bit(name: str, tmp_path: Path) -> None:
    session = recording(tmp_path / "log.jsonl", name)
    again = replay(tmp_path / "log.jsonl", filters()[name], primitive())
    assert len(again.forecasts) > 15
    assert again.identical
    assert again.session.report() == session.report()
    now, then = session.forecast([0.0, 0.2]), again.session.forecast([0.0, 0.2])
    assert torch.equal(now.mean, then.mean)
    assert torch.equal(now.deviation, then.deviation)


def test_a_replay_that_differs_says_so(tmp_path: Path) -> None:
    record(tmp_path / "log.jsonl")
    lines = (tmp_path / "log.jsonl").read_text().splitlines(keepends=True)
    entries = [json.loads(line) for line in lines[1:]]
    at = next(i for i, entry in enumerate(entries) if entry[:2] == ["push", "hand"] and entry[2] > 0.2)
    entries[at][3][0] += 1e-3
    lines[1 + at] = json.dumps(entries[at]) + "\n"
    (tmp_path / "other.jsonl").write_text("".join(lines))
    assert not replay(tmp_path / "other.jsonl", filters()["ebip with options"], primitive()).identical
    at = next(i for i, entry in enumerate(entries) if entry[0] == "forecast")
    entries[at][3] = [[1.0, 2.0, 3.0]]  # of another shape
    lines[1 + at] = json.dumps(entries[at]) + "\n"
    (tmp_path / "third.jsonl").write_text("".join(lines))
    assert not replay(tmp_path / "third.jsonl", filters()["ebip with options"], primitive()).identical


def test_a_recording_belongs_to_its_filter(tmp_path: Path) -> None:
    record(tmp_path / "log.jsonl", "ebip")
    with pytest.raises(ValueError, match="recorded with another filter"):
        replay(
            tmp_path / "log.jsonl",
            ebip(primitive(), residual_variance=2 * primitive().residual_variance),
            primitive(),
        )
    with pytest.raises(ValueError, match="recorded with another primitive"):
        replay(tmp_path / "log.jsonl", filters()["ebip"], primitive().subset(torch.arange(24).flip(0)))


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "log.jsonl").write_text("mine")
    with pytest.raises(FileExistsError):
        live(record=tmp_path / "log.jsonl")
    assert (tmp_path / "log.jsonl").read_text() == "mine"


def test_a_crash_loses_the_last_line_only(tmp_path: Path) -> None:
    record(tmp_path / "log.jsonl")
    whole = (tmp_path / "log.jsonl").read_bytes()
    (tmp_path / "cut.jsonl").write_bytes(whole[:-10])
    with pytest.warns(UserWarning, match="cut off"):
        cut = replay(tmp_path / "cut.jsonl", filters()["ebip with options"], primitive())
    assert cut.identical


HEADER = '{"kind": "torch_ebip session", "format": 1}\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a recording"),
        ("hello\n", "damaged"),
        ('["push"]\n', "not a recording"),
        ('{"kind": "torch_ebip session", "format": 7}\n', "format 7, this version reads 1"),
        ("[" * 100_000 + "\n", "damaged"),
        ("x" * (1 << 24) + "\n", "longer than any line"),
        (HEADER, "another filter"),
    ],
)
def test_what_is_no_recording_is_named(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "log.jsonl").write_text(text)
    with pytest.raises(ValueError, match=message):
        replay(tmp_path / "log.jsonl", filters()["ebip"], primitive())


@pytest.mark.parametrize(
    "line",
    [
        '["push", "nose", 0.1, [1.0]]',
        '["launch", 1]',
        '["push", "hand"]',
        '["advance", "soon"]',
        "{}",
        "[[1]]",
        f'["forecast", 0.1, {[0.1] * 20_000}, [[0.0]]]',
        f'["advance", 1{"0" * 400}]',
    ],
)
def test_a_damaged_line_is_named(line: str, tmp_path: Path) -> None:
    record(tmp_path / "log.jsonl")
    lines = (tmp_path / "log.jsonl").read_text().splitlines()
    lines[5] = line
    (tmp_path / "log.jsonl").write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match=r"log\.jsonl"):
        replay(tmp_path / "log.jsonl", filters()["ebip with options"], primitive())


def test_damaged_settings_are_named(tmp_path: Path) -> None:
    record(tmp_path / "log.jsonl")
    lines = (tmp_path / "log.jsonl").read_text().splitlines(keepends=True)
    evil = tmp_path / "evil"
    good = json.loads(lines[0])["settings"]
    for settings in (
        {},
        3,
        {**good, "window": "wide"},
        {**good, "window": math.inf},
        {**good, "window": 1e9},
        {**good, "longest_gap": 1e12},
        {**good, "record": str(evil)},
    ):
        header: dict[str, Any] = {**json.loads(lines[0]), "settings": settings}
        (tmp_path / "bad.jsonl").write_text(json.dumps(header) + "\n")
        with pytest.raises(ValueError, match="settings of the session are damaged"):
            replay(tmp_path / "bad.jsonl", filters()["ebip with options"], primitive())
    assert not evil.exists()


def test_a_recording_that_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log.jsonl")
    for path in (tmp_path / "log.jsonl", tmp_path, "/dev/zero", "/proc/self/mem"):
        with pytest.raises(ValueError, match=r"expected a regular file|cannot be opened|not a recording"):
            replay(path, filters()["ebip"], primitive())


def test_what_the_session_refused_does_not_spoil_its_recording(tmp_path: Path) -> None:
    with live(record=tmp_path / "log.jsonl") as session:
        session.push("hand", (0.1, 1.0), 0.0)
        for now in (1e6, math.nan, 10**400):
            with pytest.raises(ValueError, match="now"):
                session.advance(now)
        with pytest.raises(ValueError, match="horizons"):
            session.forecast(math.inf)
        session.forecast(0.1)
    assert replay(tmp_path / "log.jsonl", filters()["ebip with options"], primitive()).identical


def test_settings_of_any_library_are_recorded(tmp_path: Path) -> None:
    with live(window=np.float32(0.25), seed=np.int64(2), record=tmp_path / "log.jsonl") as session:
        session.push("hand", np.array([0.1, 1.0], dtype=np.float32), np.float32(0.1))
        session.forecast(np.float32(0.1), np.float32(0.2))
    assert replay(tmp_path / "log.jsonl", filters()["ebip with options"], primitive()).identical


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """No file can grow beyond so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_ends_the_recording_and_not_the_session(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    session = live(record=path)
    stream = samples()
    for sample in stream[:20]:
        session.push(*sample)
    session.report()
    written = path.read_text()
    with full_disk(path.stat().st_size):
        session.push(*stream[20])
        with pytest.warns(UserWarning, match=r"log\.jsonl: (the recording ends here|the last lines may be missing)"):
            session.report()
        session.push(*stream[21])
        assert bool(session.forecast(0.1).mean.isfinite().all())
    session.push(*stream[22])
    session.close()
    assert path.read_text() == written


def test_a_recording_that_starts_on_a_full_disk_names_its_path_and_leaves_nothing(tmp_path: Path) -> None:
    with full_disk(0), pytest.raises(OSError, match=r"File too large: .*log\.jsonl"):
        live(record=tmp_path / "log.jsonl")
    assert not list(tmp_path.iterdir())
    live(record=tmp_path / "log.jsonl").close()


@pytest.mark.parametrize(
    ("settings", "entries", "message"),
    [
        ({"window": 70.0}, [], "a window or a gap of more than 2000 ticks"),
        ({"longest_gap": 1e5}, [], "a window or a gap of more than 2000 ticks"),
        (
            {"longest_gap": 60.0, "start": 0.0},
            [["advance", 50.0], ["advance", 100.0], ["advance", 150.0]],
            "ticks to filter already",
        ),
    ],
)
def test_a_few_bytes_do_not_ask_for_minutes_of_work(
    settings: dict[str, float], entries: list[Any], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "log.jsonl"
    live(record=path).close()
    header = json.loads(path.read_text())
    header["settings"] |= settings
    path.write_text("\n".join(map(json.dumps, [header, *entries])) + "\n")
    began = time.monotonic()
    with pytest.raises(ValueError, match=message):
        replay(path, filters()["ebip with options"], primitive())
    assert time.monotonic() - began < 10


def test_a_window_does_not_ask_for_gigabytes(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    live(record=path).close()
    header = json.loads(path.read_text())
    header["settings"]["window"] = 33.0
    big = ebip(primitive(), 3000)
    header["filter"] = fingerprint(big)
    path.write_text(json.dumps(header) + "\n")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"a window whose states take \d+ bytes"):
        replay(path, big, primitive())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000
