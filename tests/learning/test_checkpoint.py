"""Checkpoints from strangers: damage is noticed, nothing is executed, nothing grows beyond its file."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch

from torch_ebip.learning.checkpoint import load_checkpoint, save_checkpoint


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A checkpoint of a few numbers."""
    save_checkpoint(tmp_path / "c.pt", {"seed": 1}, {"x": torch.arange(1000.0)})
    return tmp_path / "c.pt"


def recode(path: Path, code: bytes, method: int = zipfile.ZIP_STORED) -> None:
    """The same archive with other code."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, code if code and name.endswith("data.pkl") else data)


def test_a_flipped_bit_is_noticed(path: Path) -> None:
    whole = path.read_bytes()
    place = whole.index(torch.arange(1000.0).numpy().tobytes()) + 2000
    path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
    with pytest.raises(ValueError, match=r"c\.pt: not a readable checkpoint .*not what was written"):
        load_checkpoint(path, {"seed": 1})


def test_size_is_looked_at_first(path: Path) -> None:
    with pytest.raises(ValueError, match=r"c\.pt: .*expected at most 4000"):
        load_checkpoint(path, {"seed": 1}, limit=4000)
    recode(path, b"", zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match="compressed in a way that is not used here"):
        load_checkpoint(path, {"seed": 1})


@pytest.mark.parametrize(
    "code",
    [
        b"\x80\x02cbuiltins\nbytearray\nJ\x00\x00\x00\x40\x85R.",
        b"\x80\x02ctorch\nTensor\nK\x05\x85R.",
        b"\x80\x02cbuiltins\nexec\nX\x04\0\0\0pass\x85R.",
    ],
)
def test_nothing_is_made_but_what_is_saved(path: Path, code: bytes) -> None:
    recode(path, code)
    with pytest.raises(ValueError, match="none of tensors, numbers, strings, containers"):
        load_checkpoint(path, {})


def test_other_ways_of_saving_are_refused_and_not_run(path: Path) -> None:
    witness = path.with_name("witness")

    class Bomb:
        def __reduce__(self) -> tuple[Any, ...]:
            return (open, (str(witness), "w"))

    legacy = io.BytesIO()
    torch.save({"format": 1, "configuration": {}, "content": Bomb()}, legacy, _use_new_zipfile_serialization=False)
    for content in (legacy.getvalue(), pickle.dumps(Bomb()), pickle.dumps(Bomb()) + path.read_bytes()):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"c\.pt: not a readable checkpoint"):
            load_checkpoint(path, {})
    assert not witness.exists()
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(ValueError, match="expected a regular file"):
        load_checkpoint(path, {})


def endless() -> list[Any]:
    """A list whose text would fill any memory."""
    made: list[Any] = []
    for _ in range(50):
        made = [made, made]
    return made


@pytest.mark.parametrize(
    "theirs",
    [
        {"seed": endless()},
        {"seed": torch.ones(2)},
        {"seed": 10**600},
        {"seed": {"a": endless()}, "more": endless()},
    ],
)
def test_an_odd_configuration_is_refused_shortly(path: Path, theirs: dict[str, Any]) -> None:
    save_checkpoint(path, theirs, {})
    with pytest.raises(ValueError, match=r"another configuration: .*seed: .* there, 1 here") as caught:
        load_checkpoint(path, {"seed": 1})
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("part", ["configuration", "content", "format"])
def test_parts_of_other_types_are_refused(path: Path, part: str) -> None:
    torch.save({"format": 1, "configuration": {}, "content": {}, part: [1, {1: 2}]}, path)
    with pytest.raises(ValueError, match=r"c\.pt: (not a readable checkpoint|checkpoint format)"):
        load_checkpoint(path, {})
    save_checkpoint(path, {1: 2, "a": 1}, {})  # type: ignore[dict-item]
    with pytest.raises(ValueError, match="settings without names"):
        load_checkpoint(path, {})
