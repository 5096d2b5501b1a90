"""Bags written by rosbags, of three kinds, hold one interaction: every reader gives what the streams say."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torch_ebip import Demonstrations, Layout, Modality
from torch_ebip.recordings import read
from torch_ebip.recordings.bags import read_bag
from torch_ebip.recordings.cutting import cut, spans_of_labels, spans_of_movement

pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

BEGAN = 1_700_000_000
LAYOUT = Layout([
    Modality("hand", ["x", "y", "z"], "m"), Modality("touch", ["force"], "N"),
    Modality("arm", ["elbow", "wrist"], "rad", controlled=True),
])  # fmt: skip
TOUCH = "std_msgs/Header header\nfloat32[2] pressure\n"
MAPPING = {
    "rate": 50.0, "max_gap": 0.2,
    "modalities": [
        {"name": "hand", "dofs": ["x", "y", "z"], "unit": "m", "source": "/hand",
         "fields": ["pose.position.x", "pose.position.y", "pose.position.z"]},
        {"name": "touch", "dofs": ["force"], "unit": "N", "source": "/touch", "fields": ["pressure.1"]},
        {"name": "arm", "dofs": ["elbow", "wrist"], "unit": "rad", "controlled": True, "source": "/joint_states",
         "fields": ["position.elbow_joint", "position.wrist_joint"]},
    ],
}  # fmt: skip


def streams(seed: int) -> dict:
    """Three rates, jitter, a gap, and a sensor that falls silent; stamps to the nanosecond."""
    random = np.random.default_rng(seed)
    found = {}
    for name, rate, d in (("hand", 60, 3), ("touch", 12, 1), ("arm", 100, 2)):
        times = np.arange(0, 2 + 0.1 * seed, 1 / rate)
        times = np.round(times + random.uniform(-0.2, 0.2, len(times)) / rate, 9).clip(0) + 0.001
        if name == "hand":
            times = times[(times < 0.5) | (times > 0.9)]
        values = np.stack([np.sin(2 * times + k + seed) for k in range(d)], -1).astype(np.float32).astype(np.float64)
        found[name] = (times + BEGAN, values)
    return found


def write(path: Path, seed: int, kind: str, silent: str = "") -> Path:
    """As a robot would have; messages are written down 30 ms after they were taken."""
    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag1" else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(TOUCH, "touch_msgs/msg/Touch"))
    T = store.types
    if kind == "bag1":
        path = path.with_suffix(".bag")
        writer = Writer1(path)
    else:
        writer = Writer2(path, version=9, storage_plugin=getattr(StoragePlugin, kind.upper()))
    header_type, time_type = T["std_msgs/msg/Header"], T["builtin_interfaces/msg/Time"]

    def header(seconds: float):
        stamp = time_type(sec=int(seconds), nanosec=round((seconds - int(seconds)) * 1e9))
        first = {"seq": 0} if kind == "bag1" else {}
        return header_type(**first, stamp=stamp, frame_id="")

    with writer:
        links = {
            name: writer.add_connection(topic, msgtype, typestore=store)
            for name, topic, msgtype in (
                ("hand", "/hand", "geometry_msgs/msg/PoseStamped"), ("touch", "/touch", "touch_msgs/msg/Touch"),
                ("arm", "/joint_states", "sensor_msgs/msg/JointState"),
            )
        }  # fmt: skip
        messages = []
        for name, (times, values) in streams(seed).items():
            if name == silent:
                continue
            for time, row in zip(times.tolist(), values, strict=True):
                if name == "hand":
                    point = T["geometry_msgs/msg/Point"](*row.tolist())
                    pose = T["geometry_msgs/msg/Pose"](point, T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
                    message = T["geometry_msgs/msg/PoseStamped"](header(time), pose)
                elif name == "touch":
                    message = T["touch_msgs/msg/Touch"](header(time), np.array([0.0, row[0]], np.float32))
                else:
                    none = np.array([])
                    names = ["wrist_joint", "elbow_joint"]
                    message = T["sensor_msgs/msg/JointState"](header(time), names, row[::-1].copy(), none, none)
                messages.append((int((time + 0.03) * 1e9), name, message))
        for written, name, message in sorted(messages, key=lambda each: each[:2]):
            msgtype = links[name].msgtype
            raw = store.serialize_ros1(message, msgtype) if kind == "bag1" else store.serialize_cdr(message, msgtype)
            writer.write(links[name], written, raw)
    return path


KINDS = ["bag1", "sqlite3", "mcap"]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_says_what_was_written(tmp_path: Path, kind: str) -> None:
    for seed in range(3):
        write(tmp_path / f"take_{seed}", seed, kind)
    found = read(tmp_path, MAPPING)
    wanted = Demonstrations.from_streams(LAYOUT, [streams(seed) for seed in range(3)], rate=50.0, max_gap=0.2)
    assert found.layout == LAYOUT
    assert found.columns["demo_id"].tolist() == ["take_0", "take_1", "take_2"]
    for ours, theirs in zip(found, wanted, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0, equal_nan=True)
        assert ours[:, 0].isnan().any()
        assert not ours[:, 3:].isnan().any()


def test_stamps_of_the_header_or_of_the_bag(tmp_path: Path) -> None:
    path = write(tmp_path / "take", 0, "mcap")
    taken, written = (read_bag(path, {**MAPPING, "time": time})["hand"][0] for time in ("header", "bag"))
    np.testing.assert_allclose(written - taken, 0.03, atol=1e-5)
    with pytest.raises(ValueError, match="time must be one of header, bag"):
        read_bag(path, {**MAPPING, "time": "stamp"})


def test_a_topic_without_a_message_was_not_measured(tmp_path: Path) -> None:
    path = write(tmp_path / "take", 0, "mcap", silent="touch")
    assert read_bag(path, MAPPING)["touch"][1].shape == (0, 1)
    with pytest.warns(UserWarning, match="touch: nothing of it in 1 of 1"):
        found = read(path, MAPPING)
    assert found[0][:, 3].isnan().all()


def changed(**options) -> dict:
    first = {**MAPPING["modalities"][0], **options}
    return {**MAPPING, "modalities": [first, *MAPPING["modalities"][1:]]}


@pytest.mark.parametrize(
    ("mapping", "said"),
    [
        (changed(source="/head"), "no topic '/head'; there are /hand, /joint_states, /touch"),
        (changed(fields=["pose.position.x", "pose.position.w", "pose.position.z"]), "no field 'pose.position.w'.*x"),
        (changed(fields=["pose.position.x", "pose", "pose.position.z"]), "'pose' is no number, but"),
        (changed(fields=["pose.position.x"] * 3), "mapped twice"),
        (changed(source="/touch", fields=["pressure.0", "pressure.7", "pressure.2"]), "place 7 of 2"),
        (changed(source="/joint_states", fields=["position.0", "position.nose", "position.1"]), "nose.*wrist_joint"),
    ],
)  # fmt: skip
def test_what_is_not_there_is_named(tmp_path: Path, mapping: dict, said: str) -> None:
    path = write(tmp_path / "take", 0, "sqlite3")
    with pytest.raises(ValueError, match=said):
        read_bag(path, mapping)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_that_is_cut_off(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path / "take", 0, kind)
    file = path if path.is_file() else next(each for each in path.iterdir() if each.suffix in (".db3", ".mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
    with pytest.raises(ValueError, match="take"):
        read_bag(path, MAPPING)
    with pytest.raises(FileNotFoundError, match="no such bag"):
        read_bag(tmp_path / "none.bag", MAPPING)


def test_types_that_the_bag_does_not_describe(tmp_path: Path) -> None:
    folder = tmp_path / "touch_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Touch.msg").write_text(TOUCH)
    path = write(tmp_path / "take", 0, "sqlite3")
    told = read_bag(path, {**MAPPING, "messages": [str(folder / "Touch.msg")]})
    np.testing.assert_allclose(told["touch"][1], streams(0)["touch"][1], atol=1e-6)


def test_one_long_recording_is_cut(tmp_path: Path) -> None:
    times = np.arange(0, 9, 0.02)
    x = np.clip(times - 1, 0, 1) + np.clip(times - 4, 0, 1.5) + np.clip(times - 8.9, 0, 1)
    moving = spans_of_movement(times, x[:, None], speed=0.5)
    np.testing.assert_allclose([span[:2] for span in moving], [(1.0, 2.0), (4.0, 5.5)], atol=0.05)
    labels = spans_of_labels(times, ["wave" if 1 <= t <= 2 else "reach" if 4 <= t <= 5 else "" for t in times])
    assert [span.label for span in labels] == ["wave", "reach"]
    layout = Layout([Modality("hand", ["x"], "m", controlled=True)])
    long = {"hand": (times, x[:, None])}
    made = Demonstrations.from_streams(layout, cut(long, labels), labels=[span.label for span in labels])
    assert made.labels == ("wave", "reach")
    again = Demonstrations.from_streams(layout, [long, long], span=labels)
    torch.testing.assert_close(again[0], made[0])
    assert made.durations.tolist() == pytest.approx([1.0, 1.0])
    assert spans_of_movement(times, 0 * x[:, None], speed=0.5) == []
    with pytest.raises(ValueError, match="start < end"):
        cut(long, [(2.0, 1.0)])
    with pytest.raises(ValueError, match="as many"):
        spans_of_labels(times, ["a"])
    with pytest.raises(ValueError, match="expected"):
        spans_of_movement(times, x, 0.5)


def test_what_is_not_installed_is_said_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "take", 0, "mcap")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ImportError, match=r"pip install 'torch-ebip\[bags\]'"):
        read_bag(path, MAPPING)
