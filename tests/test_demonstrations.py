import json
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.conftest import interactions, layout
from torch_ebip import Demonstrations


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
    ],
)
def test_a_folder_that_does_not_say_enough(tmp_path: Path, description: str, body: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Demonstrations.load_folder(folder(tmp_path, description, body))


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
