"""Hostile model files: headers that lie, descriptions of what is not there, and sums that are right all the same."""

from __future__ import annotations

import json
import pickle
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import safetensors.torch
import torch

from experiments.fuzz.mutations import Mutation, content
from experiments.fuzz.planted_archives import bombs
from torch_ebip.learning.model_file import read_model_file, write_model_file

Header = dict[str, Any]


def model(folder: Path, seed: int, rounds: int, quick: bool) -> Iterator[Mutation]:
    """Of models; the sums of those with another description are right."""
    for name, bomb in bombs(folder).items():
        yield content(f"pickle, {name}", lambda bomb=bomb: pickle.dumps(bomb))
        yield _described(f"description says {name}", {"filter": str(bomb), "basis": {"families": [str(bomb)]}})
    for length in (0, 1, 1 << 24, (1 << 24) + 1, 1 << 40, (1 << 64) - 1):
        yield Mutation(f"header of {length} bytes", _bytes(lambda data, n=length: struct.pack("<Q", n) + data[8:]))
    changes: dict[str, Callable[[Header], Any]] = {
        "no metadata": lambda header: {k: v for k, v in header.items() if k != "__metadata__"},
        "metadata is a list": lambda header: {**header, "__metadata__": [1]},
        "another format": lambda header: _said(header, format="pt"),
        "another version": lambda header: _said(header, version="2"),
        "version 0": lambda header: _said(header, version="0"),
        "version without end": lambda header: _said(header, version="9" * 5000),
        "no sum": lambda header: _said(header, sha256=""),
        "no description": lambda header: _said(header, description=""),
        "a list": lambda header: [header],
        "deep": lambda header: _said(header, description="[" * 100_000),
        "tensors of terabytes": lambda header: _placed(header, shape=[1 << 40], data_offsets=[0, 1 << 42]),
        "negative shape": lambda header: _placed(header, shape=[-1]),
        "overlapping": lambda header: _placed(header, data_offsets=[0, 4]),
        "behind the end": lambda header: _placed(header, data_offsets=[1 << 50, (1 << 50) + 4]),
        "another kind": lambda header: _placed(header, dtype="I32"),
        "no kind": lambda header: _placed(header, dtype="OBJECT"),
    }
    for name, change in changes.items():
        yield Mutation(f"header: {name}", _bytes(lambda data, change=change: _headed(data, change)))
    yield content("another library's", lambda: safetensors.torch.save({"w": torch.ones(3)}, {"format": "pt"}))
    wrong: dict[str, Any] = {
        "layout": [[], {}, None, [{"name": "x"}], [{"name": "a", "dofs": [], "unit": "m", "controlled": False}]],
        "rate": [0, -1, None, "60", 1e400, [30.0]],
        "basis": [None, {}, {"families": [], "of_dof": []}, {"families": [{"family": "os.system"}], "of_dof": [0]}],
        "filter": [None, {}, {"preset": "bip"}, "ebip"],
        "targets": [None, ["nobody"], 3],
        "labels": [["a"], 3, {"a": 1}],
        "report": [None, [1], "good"],
    }
    for key, values in wrong.items():
        for value in values:
            yield _described(f"{key} is {str(value)[:40]}", {key: value})
    yield _described("nothing described", {}, remove=True)
    draws = Random(seed)
    for i in range(rounds):
        name = draws.choice(["primitive.weights", "primitive.phase_velocity", "primitive.residual_variance"])
        yield Mutation(f"{name} of another shape, {i}", _shaped(name, draws.randint(0, 5)))


def generate(random: Random, path: Path, valid: bool) -> None:
    """The model that lies there with any numbers, or with one that is of no tensor in it."""
    description, tensors = read_model_file(path)
    draws = torch.Generator().manual_seed(random.getrandbits(32))
    for name, tensor in tensors.items():
        if name.endswith(".raw"):
            tensors[name] = torch.empty_like(tensor).uniform_(-2, 2, generator=draws)
    if not valid:
        tensors[random.choice(["filter.nobody", "primitive.nothing", "stranger", "filter."])] = torch.ones(2)
    write_model_file(path, description, tensors)


def _described(name: str, change: Header, remove: bool = False) -> Mutation:
    def apply(path: Path) -> None:
        """Write it anew, with a sum that is right."""
        description, tensors = read_model_file(path)
        write_model_file(path, {} if remove else {**description, **change}, tensors)

    return Mutation(name, apply)


def _shaped(name: str, rows: int) -> Callable[[Path], None]:
    def apply(path: Path) -> None:
        """Other rows than there are demonstrations."""
        description, tensors = read_model_file(path)
        write_model_file(path, description, {**tensors, name: tensors[name][:rows].contiguous()})

    return apply


def _bytes(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(change(path.read_bytes())) and None


def _headed(data: bytes, change: Callable[[Header], Any]) -> bytes:
    (length,) = struct.unpack("<Q", data[:8])
    text = json.dumps(change(json.loads(data[8 : 8 + length]))).encode()
    return struct.pack("<Q", len(text)) + text + data[8 + length :]


def _said(header: Header, **metadata: str) -> Header:
    return {**header, "__metadata__": {**header["__metadata__"], **metadata}}


def _placed(header: Header, **place: Any) -> Header:
    name = next(name for name in header if name != "__metadata__")
    return {**header, name: {**header[name], **place}}
