import json
import math
import os
import pickle
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.conftest import interactions, layout
from torch_ebip import Demonstrations
from torch_ebip.common.files import open_file


def equal(a: Demonstrations, b: Demonstrations) -> bool:
    same = all(torch.equal(x.nan_to_num(-99), y.nan_to_num(-99)) for x, y in zip(a, b, strict=True))
    return same and a.layout == b.layout and a.rate == b.rate and a.columns.keys() == b.columns.keys()


def test_durations_and_padding() -> None:
    made = Demonstrations(layout(), [torch.zeros(4, 5), torch.ones(7, 5)], 10.0)
    torch.testing.assert_close(made.durations, torch.tensor([0.3, 0.6]))
    values, observed = made.pad()
    assert values.shape == (2, 7, 5)
    assert values[0, 4:].isnan().all()
    assert observed.sum().item() == 55


def test_subset_keeps_columns() -> None:
    made = Demonstrations(layout(), list(interactions(4)), 30.0, {"who": np.array(["a", "b", "c", "d"])})
    part = made.subset([2, 0])
    assert part.columns["who"].tolist() == ["c", "a"]
    assert torch.equal(part[0].nan_to_num(), made[2].nan_to_num())
    with pytest.raises(ValueError, match=r"no demonstration \[4\]"):
        made.subset([4])


def test_folds_cover_everything_once(demonstrations: Demonstrations) -> None:
    folds = demonstrations.folds(5, torch.Generator().manual_seed(0))
    assert sorted(torch.cat([test for _, test in folds]).tolist()) == list(range(24))
    for train, test in folds:
        assert sorted([*train.tolist(), *test.tolist()]) == list(range(24))
        assert len(test) in (4, 5)
    again = demonstrations.folds(5, torch.Generator().manual_seed(0))
    assert all(torch.equal(a[1], b[1]) for a, b in zip(folds, again, strict=True))
    with pytest.raises(ValueError, match="between 2 and the 24"):
        demonstrations.folds(25)


def test_save_and_load(tmp_path: Path, demonstrations: Demonstrations) -> None:
    path = tmp_path / "made.npz"
    made = Demonstrations(demonstrations.layout, list(demonstrations), 30.0, {"release": np.arange(24.0)})
    made.save(path)
    assert equal(Demonstrations.load(path), made)
    assert [file.name for file in tmp_path.iterdir()] == ["made.npz"]


@pytest.mark.parametrize("keep", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_named(tmp_path: Path, demonstrations: Demonstrations, keep: float) -> None:
    path = tmp_path / "cut.npz"
    demonstrations.save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(ValueError, match=r"cut\.npz"):
        Demonstrations.load(path)


class Bomb:
    """Would write a file if it were unpickled."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self):
        return (open, (self.path, "w"))


def test_pickles_are_refused_and_not_run(tmp_path: Path, demonstrations: Demonstrations) -> None:
    path, witness = tmp_path / "planted.npz", tmp_path / "witness"
    demonstrations.save(path)
    arrays = dict(np.load(path))
    arrays["dofs"] = np.array([Bomb(str(witness))] * 5, dtype=object)
    np.savez(path, allow_pickle=True, **arrays)
    with pytest.raises(ValueError, match="pickled"):
        Demonstrations.load(path)
    path.write_bytes(pickle.dumps(Bomb(str(witness))))
    with pytest.raises(ValueError, match=r"planted\.npz"):
        Demonstrations.load(path)
    assert not witness.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lengths": np.array([3, 4])}, "lengths add up to 7"),
        ({"lengths": np.array([3.0, 4.0])}, "lengths must be counts"),
        ({"lengths": np.array([-3, 4])}, "lengths must be counts"),
        ({"rate": np.float64(-1)}, "rate must be a positive"),
        ({"rate": np.array([1.0, 2.0])}, "rate must be one number"),
        ({"unit": np.array(["m"])}, r"unit has shape \(1,\), expected \(5,\)"),
        ({"values": np.zeros((3, 5), dtype=np.int64)}, "values must be floats"),
        ({"modality": np.array(["hand", "gaze", "hand", "arm", "arm"])}, "not side by side"),
        ({"unit": np.array(["m", "rad", "rad", "rad", "rad"])}, "must have one unit"),
        ({"release": np.zeros(3)}, "column 'release'"),
        ({"release": np.zeros(24, dtype="i4,f8")}, "neither numbers nor strings"),
        ({"lengths": np.array([2**63, 2**63, 969], dtype=np.uint64)}, "lengths add up to"),
        ({"lengths": np.array([0] * 10**6)}, "lengths must be counts"),
        ({"values": np.zeros((9, 5), dtype=np.longdouble)}, "at most 64 bits"),
        ({"controlled": np.array(["False"] * 5)}, "controlled must hold booleans"),
        ({"dofs": np.array([b"a", b"b", b"c", b"d", b"e"])}, "dofs must hold strings"),
        ({"dofs": np.array([0x7FFFFFFF, 1, 2, 3, 4], dtype="<u4").view("<U1")}, "characters that do not exist"),
        ({"lengths": np.array([9]), "values": np.zeros((9, 10**6), dtype="f4")}, "expected at most 100000 of each"),
    ],
)
def test_arrays_that_contradict_each_other(
    tmp_path: Path, demonstrations: Demonstrations, change: dict, message: str
) -> None:
    path = tmp_path / "odd.npz"
    demonstrations.save(path)
    np.savez(path, **{**np.load(path), **change})
    with pytest.raises(ValueError, match=message):
        Demonstrations.load(path)


@pytest.mark.parametrize("dtype", [">f4", "<f2", ">f8"])
def test_floats_of_other_machines_are_read(tmp_path: Path, demonstrations: Demonstrations, dtype: str) -> None:
    path = tmp_path / "big.npz"
    demonstrations.save(path)
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "values": arrays["values"].astype(dtype)})
    read = Demonstrations.load(path)
    assert read[1].dtype == (torch.float64 if dtype == ">f8" else torch.float32)
    torch.testing.assert_close(read[1].float(), demonstrations[1], atol=2e-3, rtol=0)


def rezip(path: Path, **members: bytes) -> None:
    """Other members in an archive."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in {**content, **members}.items():
            archive.writestr(name, data)


def test_archives_are_looked_through_before_they_are_unpacked(tmp_path: Path, demonstrations: Demonstrations) -> None:
    path = tmp_path / "bomb.npz"
    demonstrations.save(path)
    size = sum(array.nbytes for array in np.load(path).values())
    with pytest.raises(ValueError, match=r"bomb\.npz: .* bytes unpacked, expected at most"):
        Demonstrations.load(path, limit=size)
    whole = path.read_bytes()
    for content in (b"MZ" + whole, whole + b"more", whole[:-2] + b"\1\0x"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"bomb\.npz: .*zip archive"):
            Demonstrations.load(path)
    for shape in ("(1000000000000, 5)", "(-3, -5)", "(0, 1000000000000000000)"):
        header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}}}\n".encode()
        path.write_bytes(whole)
        data = b"" if shape.startswith("(0") else bytes(60)
        rezip(path, **{"values.npy": b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + data})
        with pytest.raises(ValueError, match=r"bomb\.npz: .*(bytes, expected|demonstrations of|lengths add up)"):
            Demonstrations.load(path)
    path.write_bytes(whole)
    rezip(path, **{"notes.txt": b"hello"})
    with pytest.raises(ValueError, match="is no array"):
        Demonstrations.load(path)


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "loop").symlink_to("loop")
    for name in ("fifo", "loop", ".", "/dev/zero", "a\0b"):
        with pytest.raises(ValueError, match=r"expected a regular file|cannot be opened"):
            open_file(tmp_path / name, 10)
    with pytest.raises(FileNotFoundError):
        open_file(tmp_path / "none", 10)
    (tmp_path / "large").write_bytes(bytes(11))
    with pytest.raises(ValueError, match="11 bytes, expected at most 10"):
        open_file(tmp_path / "large", 10)
    (tmp_path / "link").symlink_to("large")
    with open_file(tmp_path / "link", 11) as file:
        assert len(file.read()) == 11


def test_a_missing_array_is_named(tmp_path: Path) -> None:
    path = tmp_path / "half.npz"
    np.savez(path, values=np.zeros((2, 1)))
    with pytest.raises(ValueError, match="lacks lengths, rate"):
        Demonstrations.load(path)
    with pytest.raises(FileNotFoundError):
        Demonstrations.load(tmp_path / "nowhere.npz")


@pytest.mark.parametrize(
    ("trajectories", "rate", "message"),
    [
        ([], 30.0, "at least one demonstration"),
        ([torch.zeros(5, 4)], 30.0, r"demonstration 0 has shape \(5, 4\), expected \[T, 5\]"),
        ([torch.zeros(9, 5), torch.full((9, 5), math.nan)], 30.0, "demonstration 1 has no measured value"),
        ([torch.zeros(1, 5)], 30.0, "1 samples"),
        ([torch.full((4, 5), math.inf)], 30.0, "infinite values in hand.x"),
        ([torch.zeros(4, 5, dtype=torch.long)], 30.0, "floating-point"),
        ([torch.zeros(4, 5), torch.zeros(4, 5).double()], 30.0, "one dtype"),
        ([torch.zeros(4, 5)], 0.0, "rate must be a positive"),
        ([torch.zeros(4, 5)], math.nan, "rate must be a positive"),
    ],
)
def test_what_makes_no_demonstrations(trajectories: list, rate: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Demonstrations(layout(), trajectories, rate)


def test_columns_have_a_row_a_demonstration_and_names_of_their_own(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"column 'release' has shape \(3,\), expected 2 rows"):
        Demonstrations(layout(), [torch.zeros(4, 5)] * 2, 30.0, {"release": np.zeros(3)})
    for name in ("values", "file"):
        odd = Demonstrations(layout(), [torch.zeros(4, 5)] * 2, 30.0, {name: np.zeros(2)})
        with pytest.raises(ValueError, match=f"column '{name}' has the name of a part of the format"):
            odd.save(tmp_path / "odd.npz")
    assert not list(tmp_path.iterdir())


def test_objects_are_not_saved(tmp_path: Path) -> None:
    made = Demonstrations(layout(), [torch.zeros(4, 5)], 30.0, {"who": np.array([object()])})
    with pytest.raises(ValueError, match="holds Python objects"):
        made.save(tmp_path / "made.npz")
    assert list(tmp_path.iterdir()) == []


TOML = """
rate = 50
[[modalities]]
name = "hand"
dofs = ["hand.x", "hand.y"]
unit = "m"
[[modalities]]
name = "arm"
dofs = ["arm.1"]
unit = "rad"
controlled = true
"""


def folder(path: Path, description: str = TOML, body: str = "1,2,9,3\n,5,9,nan\n") -> Path:
    (path / "layout.toml").write_text(description)
    (path / "b.csv").write_text("hand.x,arm.1,ignored,hand.y\n" + body)
    (path / "a.csv").write_text("hand.y,hand.x,arm.1\n1,2,3\n4,5,6\n7,8,9\n")
    return path


def test_a_folder_of_csv_files(tmp_path: Path) -> None:
    made = Demonstrations.load_folder(folder(tmp_path))
    assert made.rate == 50
    assert made.layout.controlled.tolist() == [False, False, True]
    assert made.columns["demo_id"].tolist() == ["a", "b"]
    assert made[0].tolist() == [[2, 1, 3], [5, 4, 6], [8, 7, 9]]
    assert made[1][0].tolist() == [1, 3, 2]
    assert made[1][1].isnan().tolist() == [True, True, False]


def test_the_description_may_be_json(tmp_path: Path) -> None:
    folder(tmp_path)
    (tmp_path / "layout.toml").unlink()
    modalities = [{"name": "hand", "dofs": ["hand.x"], "unit": "m"}]
    (tmp_path / "layout.json").write_text(json.dumps({"rate": 50, "modalities": modalities}))
    assert Demonstrations.load_folder(tmp_path).layout.dofs == ("hand.x",)


@pytest.mark.parametrize(
    ("description", "body", "message"),
    [
        (TOML.replace("rate = 50", ""), "", "lacks 'rate'"),
        (TOML.replace("rate = 50", "rate = "), "", r"layout\.toml"),
        (TOML.replace('unit = "m"', ""), "", "lacks 'unit'"),
        (TOML.replace("hand.y", "hand.z"), "1,2,3,4\n", "header lacks hand.z"),
        (TOML, "1,2,3\n", r"b\.csv:2: 3 cells, the header has 4"),
        (TOML, "1,2,3,x\n", r"b\.csv:2: column 'hand.y': 'x' is not a number"),
        (TOML, "", "demonstration 1 has 0 samples|no measured value"),
        (TOML.replace('["arm.1"]', '"arm"'), "", "dofs must be of type list"),
        (TOML.replace('["arm.1"]', "[1]"), "", "dofs must be a list of names"),
        (TOML.replace("rate = 50", "rate = true"), "", "rate must be of type float"),
        (TOML.replace("controlled = true", 'controlled = "false"'), "", "controlled must be of type bool"),
        (TOML.replace("[[modalities]]", "[modalities.x]", 1).split("[[")[0], "", "modalities must be of type list"),
        (TOML + "x = " + "[" * 10_000, "", r"layout\.toml"),
        (TOML + ".".join("x" * 30_000) + " = 1", "", r"layout\.toml: a key of more than 16 parts"),
        (TOML.replace("arm.1", "hand.x"), "", r"layout\.toml: DoF named more than once"),
        (TOML, f"1,2,3,{'4' * 200_000}\n", r"b\.csv:2: field larger"),
        (TOML, '"\n",' * 5_000_000, r"b\.csv:\d+: a row of more than"),
        (TOML.replace("hand.y", "ignored"), "1,2,3,4\n", r"a\.csv:1: the header lacks ignored"),
    ],
)
def test_a_folder_that_does_not_say_enough(tmp_path: Path, description: str, body: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Demonstrations.load_folder(folder(tmp_path, description, body))


def test_a_description_in_json_holds_the_right_types(tmp_path: Path) -> None:
    folder(tmp_path)
    (tmp_path / "layout.toml").unlink()
    for text in (
        "[]",
        "3",
        "[" * 100_000,
        '{"rate": 1' + "0" * 400 + ', "modalities": []}',
        '{"rate": 5, "modalities": [1]}',
    ):
        (tmp_path / "layout.json").write_text(text)
        with pytest.raises(ValueError, match=r"layout\.json: "):
            Demonstrations.load_folder(tmp_path)


def test_tables_that_are_not_what_they_seem(tmp_path: Path) -> None:
    folder(tmp_path)
    for content, message in (
        (b"hand.x,arm.1,hand.y\n1,2,\xff\n", "utf-8"),
        (b"hand.x,arm.1,hand.y,hand.x\n1,2,3,4\n", "names 'hand.x' more than once"),
    ):
        (tmp_path / "b.csv").write_bytes(content)
        with pytest.raises(ValueError, match=rf"b\.csv:\d+: .*{message}"):
            Demonstrations.load_folder(tmp_path)
    (tmp_path / "b.csv").unlink()
    with pytest.raises(ValueError, match=r"a\.csv: 38 bytes, expected at most 20"):
        Demonstrations.load_folder(tmp_path, limit=20)


def test_a_million_columns_take_linear_time(tmp_path: Path) -> None:
    folder(tmp_path)
    dofs = [f"d{i}" for i in range(20_000)]
    (tmp_path / "layout.toml").write_text(TOML.replace('["arm.1"]', json.dumps(dofs)))
    for name in ("a", "b"):
        head = ",".join(["hand.x", "hand.y", *(f"x{i}" for i in range(200_000)), *dofs])
        (tmp_path / f"{name}.csv").write_text(head + 2 * ("\n" + "1," * 220_001 + "1"))
    began = time.process_time()
    assert Demonstrations.load_folder(tmp_path).layout.n_dofs == 20_002
    assert time.process_time() - began < 20  # a minute and more, if each name is looked for in all


def test_an_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"neither layout\.toml nor layout\.json"):
        Demonstrations.load_folder(tmp_path)
    (tmp_path / "layout.toml").write_text(TOML)
    with pytest.raises(FileNotFoundError, match=r"no \.csv files"):
        Demonstrations.load_folder(tmp_path)


def test_the_real_recordings(handover: Demonstrations) -> None:
    assert len(handover) == 95
    assert handover.layout.names == ("taker_position", "taker_rotation", "giver_position", "giver_rotation")
    assert (int(handover.lengths.min()), int(handover.lengths.max())) == (155, 241)
    assert handover.layout.controlled.sum().item() == 6
