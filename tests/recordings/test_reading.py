"""One interaction in every format, by the format's own writers: every reader gives the same demonstrations."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from experiments.data import Roles
from experiments.data import load as load_data
from torch_ebip import Demonstrations, Layout, Modality
from torch_ebip.recordings import from_frame, read, to_frame

h5py = pytest.importorskip("h5py")
pandas = pytest.importorskip("pandas")
pyarrow = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")

RATE = 20.0
LAYOUT = Layout([Modality("hand", ["x", "y"], "m"), Modality("arm", ["q"], "rad", controlled=True)])
NAMES = ["wave to me", "reach", "wave to me"]


def made() -> Demonstrations:
    generator = torch.Generator().manual_seed(0)
    paths = [torch.randn(30 + 5 * i, 3, generator=generator, dtype=torch.float64).cumsum(0) for i in range(3)]
    paths[1][4:7, 0] = torch.nan
    return Demonstrations(LAYOUT, paths, RATE, labels=NAMES)


def mapping(hand: dict, arm: dict, **more) -> dict:
    return {
        **more,
        "modalities": [
            {"name": "hand", "dofs": ["x", "y"], "unit": "m", **hand},
            {"name": "arm", "dofs": ["q"], "unit": "deg", "controlled": True, **arm},
        ],
    }


def same(ours: Demonstrations, tolerance: float = 1e-9) -> None:
    theirs = made()
    assert ours.layout == theirs.layout
    assert ours.rate == theirs.rate
    assert ours.labels == theirs.labels
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a.double(), b, atol=tolerance, rtol=tolerance, equal_nan=True)


def rows() -> dict:
    """Columns of all of it, the arm in degrees."""
    frame = to_frame(made())
    frame["q"] = np.rad2deg(frame["q"])
    return {name: frame[name].to_numpy() for name in frame.columns}


COLUMNS = mapping({}, {}, time="time", episode="episode", label="label", rate=RATE, max_gap=0.06)


def test_frames() -> None:
    same(from_frame(pandas.DataFrame(rows()), COLUMNS))
    again = from_frame(pandas.DataFrame(rows()), {**COLUMNS, "rate": 2 * RATE, "max_gap": 0.3})
    assert again.lengths.tolist() == [59, 69, 79]
    torch.testing.assert_close(again[0][::2], made()[0], atol=1e-9, rtol=0)


@pytest.mark.parametrize(("sep", "mark"), [(",", ""), (";", "\ufeff"), ("\t", "")])
def test_one_csv(tmp_path: Path, sep: str, mark: str) -> None:
    path = tmp_path / "all.csv"
    text = pandas.DataFrame(rows()).to_csv(index=False, sep=sep)
    path.write_text(mark + text, encoding="utf-8")
    same(read(path, COLUMNS))


def hdf5(path: Path, with_rate: bool = True) -> Path:
    columns = rows()
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        if with_rate:
            data.attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": RATE}})
        for i, name in enumerate(["demo_0", "demo_2", "demo_10"]):
            which = columns["episode"] == i
            group = data.create_group(name)
            group.attrs["language"] = NAMES[i]
            group["obs/hand"] = np.stack([0 * columns["x"], columns["y"], columns["x"]], -1)[which]
            group["actions"] = columns["q"][which]
            group["obs/stamps"] = columns["time"][which]
    return path


HDF5 = mapping({"source": "obs/hand", "fields": [2, 1]}, {"source": "actions"}, label="language", max_gap=0.06)


def test_hdf5(tmp_path: Path) -> None:
    found = read(hdf5(tmp_path / "demo.hdf5"), HDF5)
    same(found)
    assert found.columns["demo_id"].tolist() == ["demo_0", "demo_2", "demo_10"]
    same(read(hdf5(tmp_path / "no_rate.h5", with_rate=False), {**HDF5, "time": "obs/stamps", "rate": RATE}))


def lerobot(folder: Path, version: str) -> Path:
    columns = rows()
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({"codebase_version": version, "fps": int(RATE)}))
    tasks = sorted(set(NAMES))
    which = np.array([tasks.index(label) for label in columns["label"]])
    states = list(np.stack([columns["x"], columns["y"]], -1))
    table = pyarrow.table({
        "observation.state": pyarrow.array(states, pyarrow.list_(pyarrow.float64())),
        "action": pyarrow.array(list(columns["q"][:, None].astype(np.float32)), pyarrow.list_(pyarrow.float32(), 1)),
        "timestamp": columns["time"].astype(np.float32), "episode_index": columns["episode"], "task_index": which,
    })  # fmt: skip
    if version == "v2.1":
        for i in range(3):
            part = table.filter(pyarrow.array(columns["episode"] == i))
            parquet.write_table(part, folder / "data" / "chunk-000" / f"episode_{i:06}.parquet")
        lines = [json.dumps({"task_index": i, "task": task}) for i, task in enumerate(tasks)]
        (folder / "meta" / "tasks.jsonl").write_text("\n".join(lines) + "\n")
    else:
        parquet.write_table(table, folder / "data" / "chunk-000" / "file-000.parquet")
        frame = pandas.DataFrame({"task_index": range(len(tasks))}, index=tasks)
        frame.to_parquet(folder / "meta" / "tasks.parquet")
    return folder


LEROBOT = mapping({"source": "observation.state"}, {"source": "action", "fields": [0]}, max_gap=0.06)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_lerobot(tmp_path: Path, version: str) -> None:
    same(read(lerobot(tmp_path / "set", version), LEROBOT), 1e-6)


def test_a_mapping_beside_the_file_and_studies(tmp_path: Path) -> None:
    hdf5(tmp_path / "demo.hdf5")
    with pytest.raises(FileNotFoundError, match=r"no mapping says which fields of demo\.hdf5"):
        read(tmp_path / "demo.hdf5")
    (tmp_path / "mapping.toml").write_text(
        'label = "language"\nmax_gap = 0.06\n[[modalities]]\nname = "hand"\ndofs = ["x", "y"]\nunit = "m"\n'
        'source = "obs/hand"\nfields = [2, 1]\n[[modalities]]\nname = "arm"\ndofs = ["q"]\nunit = "deg"\n'
        'controlled = true\nsource = "actions"\n'
    )
    same(read(tmp_path / "demo.hdf5"))
    found, task = load_data(str(tmp_path / "demo.hdf5"), 10, 0, Roles())
    same(found)
    assert task.targets == ["arm"]
    made().save(tmp_path / "made.npz")
    same(read(tmp_path / "made.npz"))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"label": "nothing"}, "demo_0: no attribute 'nothing'"),
        ({"time": "obs/none"}, "demo_0: no data set 'obs/none'; there are actions, obs/hand, obs/stamps"),
        (mapping({"source": "obs/hand", "fields": [3, 1]}, {"source": "actions"}), "has 3 numbers, no field 3"),
        (mapping({"source": "obs"}, {"source": "actions"}), "no data set 'obs'"),
        (mapping({}, {"source": "actions"}), "hand needs a `source`"),
    ],
)  # fmt: skip
def test_hdf5_that_is_not_what_it_seems(tmp_path: Path, change: dict, said: str) -> None:
    path = hdf5(tmp_path / "demo.hdf5")
    with pytest.raises(ValueError, match=said):
        read(path, {**HDF5, **change})


def test_files_that_are_cut_off(tmp_path: Path) -> None:
    path = hdf5(tmp_path / "demo.hdf5")
    cut(path)
    with pytest.raises(ValueError, match=r"demo\.hdf5: no HDF5 file, or cut off"):
        read(path, HDF5)
    folder = lerobot(tmp_path / "set", "v3.0")
    cut(folder / "data" / "chunk-000" / "file-000.parquet")
    with pytest.raises(ValueError, match=r"file-000\.parquet"):
        read(folder, LEROBOT)
    (tmp_path / "x.csv").write_bytes(b"\xff\xfe\x00\x01" * 40)
    with pytest.raises(ValueError, match=r"x\.csv: no table"):
        read(tmp_path / "x.csv", COLUMNS)
    (tmp_path / "x.mat").write_bytes(b"")
    with pytest.raises(ValueError, match=r"\.mat is no format that is known"):
        read(tmp_path / "x.mat", COLUMNS)


def test_nothing_says_how_fast(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="nothing says how fast"):
        read(hdf5(tmp_path / "demo.hdf5", with_rate=False), HDF5)
    with pytest.raises(ValueError, match="neither a column of `time` nor a `rate`"):
        from_frame(pandas.DataFrame(rows()), {k: v for k, v in COLUMNS.items() if k not in ("time", "rate")})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"time": "stamp"}, "no column 'stamp'; there are"),
        (mapping({"fields": ["x", "z"]}, {}), "no column 'z'"),
        (mapping({"fields": ["x", "x"]}, {}), "field 'x' of 'the columns' is mapped twice"),
        (mapping({"fields": ["x"]}, {}), "hand: fields must be 2 names or places"),
        (mapping({"fields": ["x", "label"]}, {}), "column 'label' holds no numbers"),
        ({"modalities": 3}, "modalities must be of type list"),
        ({"episode": "time"}, "1 sample, at least 2 are needed"),
        (mapping({"how": "spline"}, {}), "must be one of linear"),
    ],
)
def test_frames_that_are_not_what_they_seem(change: dict, said: str) -> None:
    frame = pandas.DataFrame(rows())
    frame["time"] += frame["episode"] * 100.0
    with pytest.raises(ValueError, match=said):
        from_frame(frame, {**COLUMNS, **change})


@pytest.mark.parametrize("missing", ["pandas", "h5py", "pyarrow"])
def test_what_is_not_installed_is_said_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    paths = {
        "pandas": (tmp_path / "x.csv", COLUMNS), "h5py": (hdf5(tmp_path / "d.h5"), HDF5),
        "pyarrow": (lerobot(tmp_path / "set", "v3.0"), LEROBOT),
    }  # fmt: skip
    (tmp_path / "x.csv").write_text("x\n1\n")
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=r"pip install 'torch-ebip\[recordings\]'"):
        read(*paths[missing])
