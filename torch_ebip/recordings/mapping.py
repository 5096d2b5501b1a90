"""What is where in a file of others: which field of which source becomes which degree of freedom, in which unit."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, NamedTuple

from torch_ebip.recordings.layout import Layout, Modality
from torch_ebip.recordings.toml import entry, modality_of, number, read_description

Field = str | int
TEXTS = ("span", "time", "episode", "label")


class Source(NamedTuple):
    """Where the values of a modality come from.

    Attributes:
        modality: what they become.
        source: a topic of a bag, a column of a table, a data set of an HDF5 group; empty: the fields are columns.
        fields: of each DoF: its name there, or its place in a list of numbers.
    """

    modality: Modality
    source: str
    fields: tuple[Field, ...]


class FieldMap(NamedTuple):
    """A mapping, as a TOML file has it.

    Attributes:
        sources: one a modality.
        rate: of the grid, Hz; None: that of the fastest sensor.
        max_gap: see `Demonstrations.from_streams`.
        how: by name of a modality, likewise, of those that say so.
        span: likewise, the name of a modality.
        time: the column of times, where there are columns.
        episode: the column that says which interaction a row is of.
        label: the column that says what is shown.
        messages: paths of ``.msg`` files, of bags that do not describe their types.
    """

    sources: tuple[Source, ...]
    rate: float | None
    max_gap: float | None
    how: dict[str, Any]
    span: str | None
    time: str | None
    episode: str | None
    label: str | None
    messages: tuple[str, ...] = ()

    @property
    def layout(self) -> Layout:
        """Of what is read."""
        return Layout([source.modality for source in self.sources])


def field_map(given: str | os.PathLike[str] | Mapping[str, Any]) -> FieldMap:
    """A mapping of a TOML (or JSON) file, or of what such a file says.

    A list ``modalities`` of tables as in `folders.read_folder`, each with ``source`` and ``fields`` beside ``name``,
    ``dofs``, ``unit``: without ``fields`` they are named as the DoFs, or, of a source that is a list of numbers, its
    first ones. ``how`` of a modality, ``rate``, ``max_gap``, ``span`` are those of `Demonstrations.from_streams`;
    ``time``, ``episode``, ``label`` name columns.

    Args:
        given: path of the file, or its tables.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it does not say what is expected; a field that is named twice.
    """
    where = "the mapping" if isinstance(given, Mapping) else str(given)
    table = dict(given) if isinstance(given, Mapping) else read_description(given)
    try:
        parts = entry(table, "modalities", list)
        sources, how = [], {}
        for part in parts:
            modality = modality_of(part)
            source = entry(part, "source", str) if "source" in part else ""
            fields = tuple(entry(part, "fields", list)) if "fields" in part else _usual(modality, source)
            if len(fields) != len(modality.dofs) or not all(type(field) in (str, int) for field in fields):
                raise ValueError(
                    f"{modality.name}: fields must be {len(modality.dofs)} names or places, one a DoF, "
                    f"got {list(fields)}"
                )
            if "how" in part:
                how[modality.name] = entry(part, "how", str)
            sources.append(Source(modality, source, fields))
        named = [(source.source, field) for source in sources for field in source.fields]
        for source_name, field in named:
            if named.count((source_name, field)) > 1:
                raise ValueError(f"field {field!r} of {source_name or 'the columns'!r} is mapped twice")
        span, time, episode, label = (entry(table, name, str) if name in table else None for name in TEXTS)
        found = FieldMap(
            tuple(sources), number(table, "rate"), number(table, "max_gap"), how, span, time, episode, label
        )
        if "messages" in table:
            found = found._replace(messages=tuple(map(str, entry(table, "messages", list))))
        found.layout  # noqa: B018 - names that are there twice are refused here
        return found
    except KeyError as error:
        raise ValueError(f"{where}: lacks {error}") from error
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _usual(modality: Modality, source: str) -> tuple[Field, ...]:
    """Fields where nobody names them."""
    return tuple(range(len(modality.dofs))) if source else modality.dofs
