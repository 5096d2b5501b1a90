"""A small campaign finds nothing, and would find what there is."""

from __future__ import annotations

import json
import os
import pickle
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from experiments.fuzz.__main__ import main
from experiments.fuzz.campaign import Tally, run_kind
from experiments.fuzz.kinds import KINDS
from experiments.fuzz.mutations import Mutation, content


def test_a_small_campaign_finds_nothing(tmp_path: Path) -> None:
    main(["--quick", "--rounds", "2", "--kinds", "npz,toml,urdf,checkpoint,session", "--out", str(tmp_path / "run")])
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert [row["kind"] for row in results["kinds"]] == ["npz", "toml", "urdf", "checkpoint", "session"]
    for row in results["kinds"]:
        assert row["read"] > 1
        assert row["refused"] > 30
        assert row["read"] + row["refused"] == row["cases"]
    assert results["failures"] == []
    assert results["total"]["crashed"] == results["total"]["executed"] == results["total"]["overwritten"] == 0


def unpickle(folder: Path) -> Any:
    """What no reader should do."""
    pickle.loads((folder / "values.json").read_bytes())


def overwrite(folder: Path) -> Any:
    """Nor this."""
    (folder.parent / "corpus" / "values.json").write_text("mine")


def nameless(folder: Path) -> Any:
    """Nor this."""
    raise ValueError("something is wrong")


def die(folder: Path) -> Any:
    """Nor this."""
    os.kill(os.getpid(), signal.SIGSEGV)


def swell(folder: Path) -> Any:
    """Nor this."""
    return len(bytearray(6 << 30))


def misread(folder: Path) -> Any:
    """Nor this."""
    assert (folder / "values.json").stat().st_size < 0


@pytest.mark.parametrize(
    ("read", "verdict", "message"),
    [
        (lambda folder: {}["no"], "crashed", "KeyError"),
        (lambda folder: time.sleep(60), "crashed", "took more than"),
        (nameless, "crashed", "unclear: ValueError: something is wrong"),
        (die, "crashed", "the process died"),
        (swell, "crashed", "MemoryError"),
        (misread, "crashed", "AssertionError"),
        (unpickle, "executed", "planted code"),
        (overwrite, "overwritten", "changed: corpus/values.json"),
    ],
)
def test_what_goes_wrong_is_found(tmp_path: Path, read: Callable[[Path], Any], verdict: str, message: str) -> None:
    tally = campaign(tmp_path, read, limit=0.05 if "took" in message else 0.5)
    assert tally.counts[verdict] >= 1
    failure = next(failure for failure in tally.failures if failure["verdict"] == verdict)
    assert message in failure["message"]
    assert failure["kind"] == "fold values"


def test_refusing_a_valid_file_and_missing_damage_are_found(tmp_path: Path) -> None:
    def refuse(folder: Path) -> Any:
        raise ValueError(f"{folder}: no")

    tally = campaign(tmp_path / "a", refuse, limit=20.0)
    assert [failure["mutation"] for failure in tally.failures] == ["untouched", "link to the file"]
    tally = campaign(tmp_path / "b", lambda folder: sum((folder / "values.json").read_bytes()), exact=True)
    assert "damage went unnoticed" in {failure["message"] for failure in tally.failures}


class Bomb:
    """Makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, (str(self.path), "w"))


def campaign(folder: Path, read: Callable[[Path], Any], limit: float = 0.5, exact: bool = False) -> Tally:
    """Few cases for another reader."""

    def planted(folder: Path, seed: int, rounds: int, quick: bool) -> list[Mutation]:
        return [content("pickle", lambda: pickle.dumps(Bomb(folder / "canary")))]

    kind = replace(KINDS["fold values"], read=read, planted=planted, exact=exact)
    return run_kind(kind, folder, 0, 0, True, limit, lambda: None)
