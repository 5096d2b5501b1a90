"""What was saved loads; what is hostile costs nothing. Names, sizes, shrinkage, time."""

from __future__ import annotations

import io
import pickle
import resource
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_ebip import Demonstrations, Layout, Modality
from torch_ebip.learning.checkpoint import load_checkpoint, save_checkpoint
from torch_ebip.recordings import arrays
from torch_ebip.recordings.arrays import LONGEST_NAME, read_npz

TEXT = st.text(min_size=1, max_size=12)


def made(
    columns: dict[str, Any] | None = None, modality: str = "hand", dof: str = "x", count: int = 2
) -> Demonstrations:
    layout = Layout([Modality(modality, [dof], "m")])
    return Demonstrations(layout, [torch.full((4, 1), float(i)) for i in range(count)], 30.0, columns)


@settings(max_examples=200)
@given(TEXT, TEXT, TEXT, TEXT)
def test_what_was_saved_loads_whatever_its_names(
    tmp_path_factory: pytest.TempPathFactory, modality: str, dof: str, unit: str, column: str
) -> None:
    """Or it is refused by name, when the layout is made or the file is written; never after."""
    path, refused = tmp_path_factory.mktemp("names") / "a.npz", ""
    try:
        demonstrations = Demonstrations(
            Layout([Modality(modality, [dof], unit)]), [torch.ones(4, 1)] * 2, 30.0, {column: np.arange(2)}
        )
        demonstrations.save(path)
    except ValueError as error:
        refused = str(error)
    if refused:
        assert any(word in refused for word in ("must be printable", "name of a part", "needs a"))
        assert not path.exists()
        return
    again = Demonstrations.load(path)
    assert again.layout == demonstrations.layout
    assert again.columns[column].tolist() == [0, 1]


@pytest.mark.parametrize(
    "name", ["allow_pickle", "args", "kwds", "a/b", "../up", "x.npy", "mmap_mode", "CON", "a" * LONGEST_NAME, "é"]
)
def test_columns_with_names_of_other_things(name: str, tmp_path: Path) -> None:
    made({name: np.array([3, 4])}).save(tmp_path / "a.npz")
    assert Demonstrations.load(tmp_path / "a.npz").columns[name].tolist() == [3, 4]
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.parametrize("name", ["a\x00b", "\x1b[31m", "a\nb", "", "a" * (LONGEST_NAME + 1), 3])
def test_columns_with_no_name(name: Any, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="names must be printable, of 1 to"):
        made({name: np.array([3, 4])}).save(tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())


def test_plain_numpy_reads_what_is_written(tmp_path: Path) -> None:
    made({"release": np.array([0.1, 0.2])}).save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert arrays["lengths"].tolist() == [4, 4]
        assert arrays["release"].tolist() == [0.1, 0.2]


@pytest.mark.parametrize("constant", [True, False])
def test_large_recordings_load(constant: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At a thousandth of the limits: beyond what any archive may unpack to, constants are stored as they are."""
    monkeypatch.setattr(arrays, "DENSE", arrays.DENSE // 1000)
    values = torch.zeros(1000, 50) if constant else torch.randn(1000, 50, generator=torch.Generator().manual_seed(0))
    layout = Layout([Modality("body", [f"x{i}" for i in range(50)], "m")])
    Demonstrations(layout, [values] * 6, 60.0).save(tmp_path / "a.npz")
    assert 6 * values.nbytes > arrays.DENSE
    again = Demonstrations.load(tmp_path / "a.npz")
    assert len(again) == 6
    assert torch.equal(again[5], values)


def test_nothing_is_written_that_would_not_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "LIMIT", 3000)
    with pytest.raises(ValueError, match="at most 3000: write them to several files"):
        made(count=500).save(tmp_path / "a.npz")
    monkeypatch.undo()
    monkeypatch.setattr(arrays, "MOST", 3)
    with pytest.raises(ValueError, match="4 demonstrations of 1 DoFs, expected at most 3 of each"):
        made(count=4).save(tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())


def test_an_archive_that_unpacks_to_gigabytes_is_refused_at_once(tmp_path: Path) -> None:
    path, rows = tmp_path / "bomb.npz", 1 << 27
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (rows, 1)})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("values.npy", "w") as member:
        member.write(header.getvalue())
        for _ in range(512):
            member.write(bytes(1 << 20))
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    with pytest.raises(ValueError, match="no recording shrinks like that"):
        read_npz(path)
    assert time.monotonic() - began < 1
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000


def test_many_modalities_are_read_in_time(tmp_path: Path) -> None:
    """Time that grows with demonstrations times modalities would be a minute."""
    layout = Layout([Modality(f"m{i}", [f"x{i}"], "m") for i in range(10_000)])
    Demonstrations(layout, [torch.ones(2, 10_000)] * 300, 30.0).save(tmp_path / "a.npz")
    began = time.monotonic()
    again = Demonstrations.load(tmp_path / "a.npz")
    assert again.layout.slice("m9999") == slice(9999, 10_000)
    assert sum(again.layout.slice(name).start for name in again.layout.names) == sum(range(10_000))
    assert time.monotonic() - began < 5


CONFIGURATION = {"seed": 1}


def rewrite(path: Path, change: Any) -> None:
    """The archive again, with every member's name and bytes changed."""
    with zipfile.ZipFile(path) as archive:
        members = [(member.filename, archive.read(member)) for member in archive.infolist()]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members:
            archive.writestr(*change(name, content))


@pytest.mark.parametrize(
    "spelling", ["DATA.PKL", "Data.pkl", "data.PKL", "./data.pkl", "data.pkl ", "sub/data.pkl", "data.pkl/"]
)
def test_code_that_is_spelled_otherwise(spelling: str, tmp_path: Path) -> None:
    """Torch looks members up without regard to case: what is checked must be what it finds."""
    path = tmp_path / "c.pt"
    save_checkpoint(path, CONFIGURATION, {"x": torch.ones(2)})
    bomb = b"\x80\x02cbuiltins\nbytearray\nJ\xff\xff\xff\x7f\x85R."
    rewrite(path, lambda n, b: (n.replace("data.pkl", spelling), bomb) if n.endswith("/data.pkl") else (n, b))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="not a readable checkpoint") as caught:
        load_checkpoint(path, CONFIGURATION)
    assert "weights_only" not in str(caught.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000


@pytest.mark.parametrize("extra", ["c/DATA.PKL", "c/data.PKL", "other/data.pkl", "c/data/0x", "evil.py"])
def test_a_second_member_beside_the_code(extra: str, tmp_path: Path) -> None:
    path = tmp_path / "c.pt"
    save_checkpoint(path, CONFIGURATION, {"x": torch.ones(2)})
    with zipfile.ZipFile(path) as archive:
        root = archive.namelist()[0].partition("/")[0]
    with zipfile.ZipFile(path, "a", zipfile.ZIP_STORED) as archive:
        archive.writestr(extra.replace("c/", f"{root}/"), b"\x80\x02N.")
    with pytest.raises(ValueError, match="not a readable checkpoint"):
        load_checkpoint(path, CONFIGURATION)


@pytest.mark.parametrize("nested", [lambda t: t, lambda t: [t], lambda t: {"a": ({"b": t},)}])
def test_tensors_larger_than_their_bytes(nested: Any, tmp_path: Path) -> None:
    path = tmp_path / "c.pt"
    content = {"x": nested(torch.ones(1).expand(1 << 15, 1 << 15))}
    save_checkpoint(path, CONFIGURATION, content)
    assert path.stat().st_size < 10_000
    with pytest.raises(ValueError, match=r"a tensor .* of 4 bytes|not a readable checkpoint"):
        load_checkpoint(path, CONFIGURATION)


@pytest.mark.parametrize(
    "thing", [Path("x"), slice(0, 1), np.float64(1.0), b"\x80\x02ctorch\nEvilStorage\n.", b"\x80\x02ctorch\nSize\n."]
)
def test_torchs_advice_to_load_it_unsafely_reaches_nobody(thing: Any, tmp_path: Path) -> None:
    path = tmp_path / "c.pt"
    save_checkpoint(path, CONFIGURATION, {"x": torch.ones(1)})
    code = thing
    if not isinstance(thing, bytes):
        code = pickle.dumps({"format": 1, "configuration": CONFIGURATION, "content": {"x": thing}}, protocol=2)
    rewrite(path, lambda n, b: (n, code if n.endswith("/data.pkl") else b))
    with pytest.raises(ValueError, match="not a readable checkpoint") as caught:
        load_checkpoint(path, CONFIGURATION)
    for word in ("weights_only", "safe_globals", "unsafe", "trust"):
        assert word not in str(caught.value)
