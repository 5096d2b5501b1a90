"""LeRobot data sets, versions 2.1 and 3: parquet tables of episodes, times, and tasks as labels."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from torch_ebip.common.files import read_text
from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.frames import Rows, of_rows
from torch_ebip.recordings.mapping import FieldMap

HINT = "LeRobot data sets need pyarrow: pip install 'torch-ebip[recordings]'"
META_LIMIT = 1 << 26
"""Bytes of a file of ``meta``."""
DATA_LIMIT = 1 << 33
"""Bytes of all columns that are read, unpacked."""


def read_lerobot(path: str | os.PathLike[str], mapping: FieldMap) -> Demonstrations:
    """The episodes of a LeRobot data set; its task is the label of each.

    Args:
        path: of its folder, with ``meta/info.json`` and ``data``.
        mapping: ``source`` is a column, such as ``"observation.state"``, ``fields`` places in it. ``time`` is
            ``"timestamp"``, ``episode`` is ``"episode_index"`` unless it says otherwise, ``rate`` is ``fps``.

    Raises:
        ImportError: pyarrow is not installed.
        FileNotFoundError: no ``meta/info.json``, or no table.
        ValueError: a column that is not there; a table that is cut off; see `frames.from_frame`.
    """
    try:
        import pyarrow
        import pyarrow.parquet as parquet
    except ImportError as error:
        raise ImportError(HINT) from error
    folder = Path(path)
    about = _json(folder / "meta" / "info.json", read_text(folder / "meta" / "info.json", META_LIMIT))
    fps = about.get("fps") if isinstance(about, dict) else None
    mapping = mapping._replace(
        time=mapping.time or "timestamp", episode=mapping.episode or "episode_index",
        rate=mapping.rate or (float(fps) if isinstance(fps, int | float) else None),
    )  # fmt: skip
    files = sorted((folder / "data").rglob("*.parquet"))
    if not files:
        raise FileNotFoundError(f"{folder / 'data'}: no .parquet files")
    names = {str(mapping.time), str(mapping.episode)}
    for source in mapping.sources:
        names |= {source.source} if source.source else {str(field) for field in source.fields}
    tasks = _tasks(folder, parquet) if mapping.label is None else {}
    label = "task_index" if mapping.label is None and tasks else mapping.label
    parts: dict[str, list[Any]] = {}
    room = DATA_LIMIT
    for file in files:
        try:
            schema = parquet.read_schema(file)
            missing = sorted(names - set(schema.names))
            if missing:
                raise ValueError(f"no column {missing[0]!r}; there are {', '.join(schema.names[:12])}")
            about_file = parquet.read_metadata(file)
            room -= sum(about_file.row_group(i).total_byte_size for i in range(about_file.num_row_groups))
            if room < 0:
                raise ValueError(f"more than {DATA_LIMIT} bytes in this data set")
            wanted = sorted(names | ({label} if label is not None and label in schema.names else set()))
            table = parquet.read_table(file, columns=wanted)
        except (pyarrow.ArrowException, ValueError, OSError) as error:
            raise ValueError(f"{file}: {str(error)[:300]}") from error
        for name in table.column_names:
            parts.setdefault(name, []).append(table.column(name).to_numpy())
    columns: Rows = {name: np.concatenate(each) for name, each in parts.items()}
    if label == "task_index" and label in columns:
        columns["task"] = np.array([tasks.get(int(index), str(index)) for index in columns[label]])
        mapping = mapping._replace(label="task")
    return of_rows(columns, mapping, str(folder))


def _json(path: Path, text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from error


def _tasks(folder: Path, parquet: Any) -> dict[int, str]:
    """Names of tasks by their number: a file of lines before version 3, a table since."""
    lines, table = folder / "meta" / "tasks.jsonl", folder / "meta" / "tasks.parquet"
    if lines.exists():
        rows = [_json(lines, line) for line in read_text(lines, META_LIMIT).splitlines() if line.strip()]
        try:
            return {int(row["task_index"]): str(row["task"]) for row in rows}
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{lines}: expected task_index and task in each line, {error!r}") from error
    if table.exists():
        columns = parquet.read_table(table).to_pydict()
        name = next((key for key in ("task", "__index_level_0__") if key in columns), None)
        if name is None or "task_index" not in columns:
            raise ValueError(f"{table}: expected task_index and task, got {', '.join(columns)}")
        return dict(zip(map(int, columns["task_index"]), map(str, columns[name]), strict=True))
    return {}
