"""Archives that somebody made on purpose: recordings and checkpoints that lie, swell or would execute something."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments.fuzz.mutations import Mutation, content, flipped, spliced


class Bomb:
    """Something that makes a file when it is unpickled."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.made = (function, arguments)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """What pickle calls to make it."""
        return self.made


def bombs(folder: Path) -> dict[str, Bomb]:
    """Ways to make the file ``canary`` in a folder."""
    canary = str(folder / "canary")
    return {
        "open": Bomb(open, canary, "w"),
        "system": Bomb(os.system, f"touch {canary}"),
        "exec": Bomb(exec, f"open({canary!r}, 'w')"),
    }


def recordings(folder: Path, seed: int, rounds: int, quick: bool) -> Iterator[Mutation]:
    """Of ``.npz`` recordings."""
    yield from _members(seed, rounds)
    for name, bomb in bombs(folder).items():
        objects = np.array([bomb] * 3, dtype=object)
        yield content(f"pickle, {name}", lambda bomb=bomb: pickle.dumps(bomb))
        for array in ("values", "lengths", "rate", "dofs", "modality", "controlled", "release", "further"):
            yield _arrays(f"pickle as {array}, {name}", {array: objects})
    yield _arrays("pickle as 0-d rate", {"rate": np.array(bombs(folder)["open"], dtype=object)})
    for name in ("values", "lengths", "rate", "dofs", "modality", "unit", "controlled", "release"):
        yield _arrays(f"no {name}", {name: None})
        for dtype in ("f2", "f4", ">f8", "g", "G", "c8", "i8", ">i4", "u1", "?", "S3", "U3", ">U9", "M8[s]", "m8[D]"):
            yield Mutation(
                f"{name} as {dtype}", _changed(lambda a, name=name, dtype=dtype: a[name].astype(dtype), name)
            )
        yield Mutation(f"{name} as a structure", _changed(lambda a: np.zeros(3, dtype="i4,f8"), name))
        for shape in ((), (0,), (1,), (3,), (1, 1), (3, 3, 3), (0, 5), (5, 0)):
            yield Mutation(f"{name} of shape {shape}", _changed(lambda a, n=name, s=shape: np.resize(a[n], s), name))
    for value in (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, 5e-324):
        yield _arrays(f"rate {value}", {"rate": np.float64(value)})
    huge = np.longdouble(2) ** 5000
    yield _arrays("rate beyond floats", {"rate": np.array(huge)})
    for value in (np.nan, np.inf, 1e39):
        yield Mutation(
            f"values of {value}", _changed(lambda a, value=value: np.full(a["values"].shape, value), "values")
        )
    for lengths in ([-1, 1], [2**63 - 1, 2**63 - 1, 2], [0] * 12, [1] * 12, [2**62] * 4):
        yield _arrays(f"lengths {lengths}", {"lengths": np.array(lengths, dtype=np.int64)})
    yield Mutation("lengths that wrap around", _changed(_wrapped, "lengths"))
    yield _arrays("dofs of one name", {"dofs": np.array(["x"] * 3)})
    yield _arrays("dofs without names", {"dofs": np.array([""] * 3)})
    yield _arrays("dofs with surrogates", {"dofs": np.array(["\ud800", "b", "c"])})
    yield _arrays("dofs of a megabyte", {"dofs": np.array(["a" * 10**6, "b", "c"])})
    yield _arrays("dofs of no characters", {"dofs": np.array([0x7FFFFFFF, 1, 2], dtype="<u4").view("<U1")})
    million = 10**6
    wide = {
        "values": np.zeros((2, million), np.float32),
        "lengths": np.array([2]),
        "dofs": np.arange(million).astype("U7"),
        "modality": np.arange(million).astype("U7"),
        "unit": np.full(million, "m"),
        "controlled": np.zeros(million, bool),
        "release": None,
        "who": None,
    }
    yield _arrays("a million columns", wide)
    many = {
        "lengths": np.full(million, 2),
        "values": np.zeros((2 * million, 3), np.float32),
        "who": None,
        "release": None,
    }
    yield _arrays("a million demonstrations", many)
    yield _arrays("a million empty ones", {"lengths": np.zeros(million, np.int64)})
    for name, header in {
        "petabytes": "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 3)}",
        "negative": "{'descr': '<f4', 'fortran_order': False, 'shape': (-2, -3)}",
        "nothing of much": "{'descr': '<f4', 'fortran_order': False, 'shape': (0, 1000000000000000000)}",
        "no width": "{'descr': '<U0', 'fortran_order': False, 'shape': (1000000000000000000,)}",
        "no width at all": "{'descr': '|V0', 'fortran_order': False, 'shape': (1000000000000000000,)}",
        "many dimensions": f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({'1,' * 100})}}",
        "nested": f"{{'descr': {'[(' * 500}, 'fortran_order': False, 'shape': ()}}",
        "nested structure": f"{{'descr': {chr(91) + '(' + repr('a') + ','}'<f4', 'shape': 1}}",
        "code": "__import__('os').system('true')",
        "a list": "[1, 2]",
        "python 2": "{'descr': '<f4', 'fortran_order': False, 'shape': (1L, 3L)}",
        "true": "{'descr': '<f4', 'fortran_order': 7, 'shape': (True, 3)}",
        "long": "{'descr': '<f4', 'fortran_order': False, 'shape': (1, 3)}" + " " * 60_000,
    }.items():
        for version in (1, 2, 3, 9):
            yield _replaced(f"header, {name}, version {version}", "values.npy", _npy(header, bytes(12), version))
    yield _replaced("a header of four gigabytes", "values.npy", b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + bytes(100))
    yield _replaced("another file", "notes.txt", b"hello")
    yield _replaced(
        "a path", "../../evil.npy", _npy("{'descr': '<f4', 'fortran_order': False, 'shape': ()}", bytes(4), 1)
    )
    yield from _zips(quick, zipfile.ZIP_DEFLATED, "release.npy")


def checkpoint(folder: Path, seed: int, rounds: int, quick: bool) -> Iterator[Mutation]:
    """Of checkpoints."""
    yield from _members(seed, rounds)
    for name, bomb in bombs(folder).items():
        yield content(f"pickle, {name}", lambda bomb=bomb: pickle.dumps(bomb))
        for zipped in (True, False):
            for part in ("format", "configuration", "content"):
                made = {"format": 1, "configuration": {}, "content": {}, part: bomb}
                yield content(f"pickle as {part}, {name}, zip {zipped}", lambda m=made, z=zipped: _saved(m, z))
    nested: list[Any] = []
    for _ in range(150):
        nested = [nested]
    doubled: list[Any] = []
    for _ in range(40):
        doubled = [doubled, doubled]
    odd: dict[str, Any] = {
        "none": None,
        "a list": [1, 2],
        "a tensor": torch.ones(3),
        "nested": nested,
        "doubled": doubled,
        "doubled by name": {"seed": doubled, "horizons": doubled, "start": {"factor": doubled}},
        "tensors": {"seed": torch.ones(2), "horizons": torch.ones(1).expand(10**12), "start": torch.ones(2)},
        "numbers as names": {1: 2, "seed": 1},
        "a huge number": {"seed": 10**6000},
        "nan": {"seed": float("nan")},
        "sparse": torch.ones(2, 2).to_sparse(),
        "endless": torch.ones(1).expand(10**12),
        "a device": torch.device("cuda:7"),
        "meta": torch.ones(3, device="meta"),
    }
    for name, value in odd.items():
        for part in ("format", "configuration", "content"):
            made = {"format": 1, "configuration": {}, "content": {}, part: value}
            yield content(f"{part}: {name}", lambda m=made: _saved(m))
        yield content(f"saved: {name}", lambda value=value: _saved(value))
    yield content("torchscript", _script)
    for name, code in {
        "nothing": b"",
        "memo of gigabytes": b"\x80\x02}r\xf0\xff\xff\xff.",
        "endless depth": b"\x80\x02" + b"(" * 10**6 + b".",
        "lists in lists": b"\x80\x02" + b"]" * 10**5 + b"a" * (10**5 - 1) + b".",
        "gigabytes of bytes": b"\x80\x02cbuiltins\nbytearray\nJ\xff\xff\xff\x7f\x85R.",
        "terabytes of numbers": b"\x80\x02ctorch\nTensor\n\x8a\x06\0\0\0\0\0\x10\x85R.",
        "text without an end": b"\x80\x02X\xff\xff\xff\x7fabc",
        "a number without an end": b"\x80\x02\x8b\xff\xff\xff\x7fabc",
        "exec": b"\x80\x02cbuiltins\nexec\nX\x04\0\0\0passq\0\x85R.",
        "attributes": b"\x80\x02cbuiltins\ngetattr\n.",
    }.items():
        yield Mutation(f"code: {name}", _rezipped(lambda members, code=code: _pickle(members, code)))
    for name, old, new in (
        ("storages of terabytes", b"K", b"\x8a\x06\0\0\0\0\0\x10"),
        ("other types", b"FloatStorage", b"DoubleStorage"),
        ("other functions", b"_rebuild_tensor_v2", b"_rebuild_sparse_tensor"),
        ("other names", b"X\x01\0\0\0" + b"0", b"X\x01\0\0\0" + b"9"),
        ("paths", b"X\x01\0\0\0" + b"0", b"X\x07\0\0\0" + b"../../x"),
        ("devices", b"X\x03\0\0\0cpu", b"X\x06\0\0\0cuda:9"),
        ("offsets", b"QK\x00", b"QJ\xff\xff\xff\x7f"),
    ):
        yield Mutation(f"tensors: {name}", _rezipped(lambda m, o=old, n=new: _pickle(m, _code(m).replace(o, n))))
    yield from _zips(quick, zipfile.ZIP_STORED, "archive/data/0")


def _zips(quick: bool, method: int, member: str) -> Iterator[Mutation]:
    """What any zip archive may be."""
    for other in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        yield Mutation(f"compressed by method {other}", _rezipped(lambda members: members, other))
    for size in (64 << 20, *(() if quick else (1100 << 20, 9 << 29)[method == zipfile.ZIP_STORED :][:1])):
        yield Mutation(f"bomb of {size >> 20} MB", lambda path, size=size: _swell(path, member, size, method))
    yield Mutation("a member twice", _twice)
    yield Mutation("fifty thousand members", _rezipped(lambda m: {**m, **{f"x{i}.npy": b"" for i in range(50_000)}}))
    yield Mutation("no members", _rezipped(lambda members: {}))
    for name, change in {
        "something before": lambda c: b"MZ" + bytes(1000) + c,
        "something behind": lambda c: c + bytes(1000),
        "a pickle before": lambda c: pickle.dumps(1) + c,
        "twice": lambda c: c + c,
        "encrypted": lambda c: c.replace(b"PK\x01\x02\x2d\x03\x2d\0\0\0", b"PK\x01\x02\x2d\x03\x2d\0\1\0"),
        "sizes of terabytes": lambda c: _directory(c, 24, b"\xff\xff\xff\xfe"),
        "packed sizes of terabytes": lambda c: _directory(c, 20, b"\xff\xff\xff\xfe"),
        "sizes of nothing": lambda c: _directory(c, 24, bytes(4)),
        "places far away": lambda c: _directory(c, 42, b"\xff\xff\xff\x7f"),
        "one place for all": lambda c: _directory(c, 42, bytes(4)),
        "names without an end": lambda c: _directory(c, 28, b"\xff\xff"),
        "a huge directory": lambda c: c[:-10] + b"\xff\xff\xff\x7f" + c[-6:],
        "a comment": lambda c: c[:-2] + b"\x03\0abc",
    }.items():
        yield Mutation(name, lambda path, change=change: path.write_bytes(change(path.read_bytes())) and None)


def _members(seed: int, rounds: int) -> Iterator[Mutation]:
    """Damage inside a member, with sums that fit."""
    for i in range(rounds):
        for name, damage in (("flip", flipped), ("splice", spliced)):

            def change(members: dict[str, bytes], damage: Any = damage, i: int = i) -> dict[str, bytes]:
                chosen = list(members)[i % len(members)]
                return {**members, chosen: damage(members[chosen], [seed, i, 1]) if members[chosen] else b"x"}

            yield Mutation(f"{name} inside {i}", _rezipped(change))


def _rezipped(change: Callable[[dict[str, bytes]], Mapping[str, bytes]], method: int | None = None) -> Any:
    def rewrite(path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            members = {member.filename: archive.read(member) for member in archive.infolist()}
            used = archive.infolist()[0].compress_type if method is None else method
        with zipfile.ZipFile(path, "w", used) as archive:
            for name, data in change(members).items():
                archive.writestr(name, data)

    return rewrite


def _replaced(name: str, member: str, data: bytes) -> Mutation:
    return Mutation(name, _rezipped(lambda members: {**members, member: data}))


def _changed(make: Callable[[dict[str, Any]], Any], name: str) -> Any:
    """Another array of that name, made from all there are; None: none."""

    def change(path: Path) -> None:
        with np.load(path) as archive:
            arrays = dict(archive)
        try:
            arrays[name] = make(arrays)
        except (TypeError, ValueError):
            arrays[name] = None  # not every array can be of every type
        np.savez(path, allow_pickle=True, **{key: array for key, array in arrays.items() if array is not None})

    return change


def _arrays(name: str, new: Mapping[str, Any]) -> Mutation:
    def change(path: Path) -> None:
        with np.load(path) as archive:
            arrays = {**archive, **new}
        kept = {key: array for key, array in arrays.items() if array is not None}
        np.savez_compressed(path, allow_pickle=True, **kept)

    return Mutation(name, change)


def _wrapped(arrays: Mapping[str, Any]) -> Any:
    """Lengths that add up to the right number in 64 bits only."""
    half = np.uint64(2**63)
    return np.array([half, half, len(arrays["values"])], dtype=np.uint64)


def _npy(header: str, data: bytes, version: int) -> bytes:
    text = header.encode() + b"\n"
    size = len(text).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + size + text + data


def _saved(value: Any, zipped: bool = True) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer, _use_new_zipfile_serialization=zipped)
    return buffer.getvalue()


def _script() -> bytes:
    buffer = io.BytesIO()
    torch.jit.save(torch.jit.trace(torch.nn.Linear(2, 2), torch.ones(1, 2)), buffer)
    return buffer.getvalue()


def _code(members: Mapping[str, bytes]) -> bytes:
    return next(data for name, data in members.items() if name.endswith("data.pkl"))


def _pickle(members: Mapping[str, bytes], code: bytes) -> dict[str, bytes]:
    return {name: code if name.endswith("data.pkl") else data for name, data in members.items()}


def _swell(path: Path, member: str, size: int, method: int) -> None:
    """A member of zeros, compressed where it may be, or else with holes that take no space."""
    with zipfile.ZipFile(path) as archive:
        members = {m.filename: archive.read(m) for m in archive.infolist() if m.filename != member}
    with zipfile.ZipFile(path, "w", method, compresslevel=1) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
        if method == zipfile.ZIP_STORED:
            archive.writestr(member, b"x")
        else:
            info = zipfile.ZipInfo(member)
            info.compress_type = method
            with archive.open(info, "w", force_zip64=True) as stream:
                for _ in range(size >> 20):
                    stream.write(bytes(1 << 20))
    if method == zipfile.ZIP_STORED:
        os.truncate(path, size)


def _twice(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        members = [(member.filename, archive.read(member)) for member in archive.infolist()]
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in [*members, (members[0][0][:-1] + "?", members[0][1])]:
            archive.writestr(name, data)
    name = members[0][0].encode()
    path.write_bytes(content.getvalue().replace(name[:-1] + b"?", name))


def _directory(content: bytes, offset: int, new: bytes) -> bytes:
    """Every entry of the directory with other bytes at an offset."""
    changed = bytearray(content)
    place = content.find(b"PK\x01\x02")
    while place >= 0:
        changed[place + offset : place + offset + len(new)] = new
        place = content.find(b"PK\x01\x02", place + 1)
    return bytes(changed)
