"""ROS bags, 1 and 2 (sqlite3 and MCAP): topics at rates of their own, each field a degree of freedom."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.mapping import FieldMap, Source, field_map
from torch_ebip.recordings.streams import Interaction

HINT = "bags need rosbags: pip install 'torch-ebip[bags]'"
MOST_MESSAGES = 20_000_000
"""Of the topics that are read."""
STAMPS = ("header", "bag")
"""What ``time`` of a mapping may say: when a message says that it was taken, or when it was written down."""


def is_bag(path: Path) -> bool:
    """Whether a path is one bag.

    Args:
        path: of a file or folder.
    """
    return (path.is_dir() and (path / "metadata.yaml").exists()) or path.suffix in (".bag", ".mcap", ".db3")


def read_bags(path: str | os.PathLike[str], mapping: FieldMap) -> Demonstrations:
    """A bag, one interaction, or a folder of bags, one each, in the order of their names.

    Args:
        path: of a ``.bag``, of the folder of a ROS 2 bag, or of a folder of either.
        mapping: see `read_bag`.

    Raises:
        ImportError: rosbags is not installed.
        FileNotFoundError: no bag there.
        ValueError: see `read_bag` and `Demonstrations.from_streams`.
    """
    place = Path(path)
    bags = [place] if is_bag(place) else sorted(each for each in place.iterdir() if is_bag(each))
    if not bags:
        raise FileNotFoundError(f"{place}: no bag, and none in it")
    interactions = [_read(bag, mapping) for bag in bags]
    try:
        return Demonstrations.from_streams(
            mapping.layout, interactions, mapping.rate, mapping.max_gap, how=mapping.how, span=mapping.span,
            columns={"demo_id": np.array([bag.stem for bag in bags])},
        )  # fmt: skip
    except ValueError as error:
        raise ValueError(f"{place}: {error} (interaction 0 is {bags[0].name})") from error


def read_bag(path: str | os.PathLike[str], mapping: str | os.PathLike[str] | Mapping[str, Any]) -> Interaction:
    """What a bag's topics say, each with times of its own: {modality: (times [T] in s, values [T, d])}.

    For a bag of many interactions: `cutting.cut` makes several of it, for `Demonstrations.from_streams`.

    Args:
        path: of a ``.bag``, or of the folder of a ROS 2 bag.
        mapping: see `mapping.field_map`. ``source`` is a topic, ``fields`` are such as ``"pose.position.x"``,
            ``"data.3"``, or of joint states ``"position.elbow_joint"``. ``time`` is ``"header"``, when a message says
            that it was taken, or ``"bag"``, when it was written down; default: the header's where there is one.
            ``messages`` lists ``.msg`` files (``PACKAGE/msg/NAME.msg``) of types that the bag does not describe.

    Raises:
        ImportError: rosbags is not installed.
        FileNotFoundError: there is no such bag.
        ValueError: a bag that is cut off; a topic or a field that is not there; a type that nobody describes.
    """
    return _read(Path(path), field_map(mapping))


def _read(path: Path, mapping: FieldMap) -> Interaction:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise ImportError(HINT) from error
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such bag")
    if mapping.time is not None and mapping.time not in STAMPS:
        raise ValueError(f"time must be one of {', '.join(STAMPS)}, got {mapping.time!r}")
    types = get_typestore(Stores.LATEST)
    for file in map(Path, mapping.messages):
        name = "/".join([*file.parts[-3:-1], file.stem])
        types.register(get_types_from_msg(file.read_text(encoding="utf-8"), name))
    by_topic: dict[str, list[Source]] = {}
    for source in mapping.sources:
        by_topic.setdefault(source.source, []).append(source)
    found: dict[str, tuple[list[float], list[list[float]]]] = {s.modality.name: ([], []) for s in mapping.sources}
    try:
        with AnyReader([path], default_typestore=types) as reader:
            missing = sorted(set(by_topic) - set(reader.topics))
            if missing:
                raise ValueError(f"no topic {missing[0]!r}; there are {', '.join(sorted(reader.topics)[:12])}")
            wanted = [connection for connection in reader.connections if connection.topic in by_topic]
            if sum(connection.msgcount for connection in wanted) > MOST_MESSAGES:
                raise ValueError(f"more than {MOST_MESSAGES} messages of these topics")
            for connection, written, raw in reader.messages(wanted):
                message = reader.deserialize(raw, connection.msgtype)
                time = 1e-9 * written if mapping.time == "bag" else _stamp(message, written, mapping.time)
                for source in by_topic[connection.topic]:
                    times, rows = found[source.modality.name]
                    times.append(time)
                    rows.append([_field(message, str(field), connection.topic) for field in source.fields])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    except Exception as error:  # sqlite3, lz4, zstandard, yaml and rosbags raise their own types on damaged bytes
        raise ValueError(
            f"{path}: no bag that can be read, or cut off: {type(error).__name__}: {str(error)[:200]}"
        ) from error
    widths = {source.modality.name: len(source.fields) for source in mapping.sources}
    return {name: (np.array(t), np.array(rows).reshape(len(t), widths[name])) for name, (t, rows) in found.items()}


def _stamp(message: Any, written: int, asked: str | None) -> float:
    """s, when a message says that it was taken; when it was written down if it does not say."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None or (stamp.sec == 0 and stamp.nanosec == 0):
        if asked == "header":
            raise ValueError("a message has no stamp in its header; say time = 'bag'")
        return 1e-9 * written
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _field(message: Any, field: str, topic: str) -> float:
    """A number of a message, by a path of names and places."""
    value = message
    for part in field.split("."):
        if part.isdigit() and hasattr(value, "__getitem__"):
            if int(part) >= len(value):
                raise ValueError(f"{topic}: {field!r} asks for place {part} of {len(value)}")
            value = value[int(part)]
        elif hasattr(value, "__getitem__") and part in list(getattr(message, "name", [])):
            value = value[list(message.name).index(part)]
        elif hasattr(value, part) and not part.startswith("_"):
            value = getattr(value, part)
        else:
            names = getattr(value, "__dataclass_fields__", None) or getattr(message, "name", [])
            there = ", ".join(name for name in names if not name.startswith("_"))
            raise ValueError(f"{topic}: no field {field!r}; where {part!r} is looked for there are {there or 'none'}")
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{topic}: {field!r} is no number, but {type(value).__name__}") from None
