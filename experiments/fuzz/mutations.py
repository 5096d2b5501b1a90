"""Damage that any file can take: cut off, bits flipped, pieces moved, or something else in its place."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

Change = Callable[[Path], None]
"""Changes the file at a path."""
CUTS = 64
"""Places at which every file is cut off, beside every kilobyte."""
TOKENS = (
    b"nan",
    b"1e999",
    b"-1",
    b"\0",
    b'"',
    b"\n",
    b"[" * 50,
    b"{",
    b",",
    b"\xff\xfe",
    b"9" * 400,
    b"null",
    b"true",
)
"""Pieces that mean something to one reader or another."""


class Mutation(NamedTuple):
    """One change of a valid file.

    Attributes:
        name: of its sort, with what repeats it.
        change: does it.
        damage: whether it is blind: formats with checksums must notice, or give the same content.
        valid: whether the file is valid all the same and must be read.
    """

    name: str
    change: Change
    damage: bool = False
    valid: bool = False


def cuts(size: int, places: int) -> Iterator[Mutation]:
    """Cut off at every kilobyte, and at so many places evenly."""
    marks = {*range(0, size, 1024), *np.linspace(0, size - 1, min(places, size), dtype=int).tolist()}
    for mark in sorted(marks):
        yield Mutation(f"cut at {mark}", _writer(lambda content, mark=mark: content[:mark]), damage=True)


def flips(rounds: int, seed: int) -> Iterator[Mutation]:
    """One to eight bits flipped."""
    for i in range(rounds):
        yield Mutation(f"flip {i}", _writer(lambda content, i=i: flipped(content, [seed, i])), damage=True)


def splices(rounds: int, seed: int) -> Iterator[Mutation]:
    """A piece removed, repeated elsewhere, or replaced by noise or by a token."""
    for i in range(rounds):
        yield Mutation(f"splice {i}", _writer(lambda content, i=i: spliced(content, [seed, i])), damage=True)


def flipped(content: bytes, seed: list[int]) -> bytes:
    """One to eight bits flipped."""
    rng = np.random.default_rng(seed)
    changed = bytearray(content)
    for place in rng.integers(len(content), size=rng.integers(1, 9)).tolist():
        changed[place] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def spliced(content: bytes, seed: list[int]) -> bytes:
    """A piece removed, repeated elsewhere, or replaced by noise or by a token."""
    rng = np.random.default_rng(seed)
    start, to = rng.integers(len(content), size=2).tolist()
    piece = content[start : start + int(rng.integers(1, 200))]
    match int(rng.integers(4)):
        case 0:
            return content[:start] + content[start + len(piece) :]
        case 1:
            return content[:to] + piece + content[to:]
        case 2:
            return content[:start] + rng.bytes(len(piece)) + content[start + len(piece) :]
        case _:
            token = TOKENS[int(rng.integers(len(TOKENS)))]
            return content[:start] + token + content[start + len(token) * int(rng.integers(2)) :]


def places(root: bool) -> Iterator[Mutation]:
    """Something that is no file where one is expected; links, also those that lead to one."""
    yield Mutation("untouched", lambda path: None, valid=True)
    yield Mutation("link to the file", _link_to_itself_elsewhere, valid=True)
    yield Mutation("missing", lambda path: path.unlink())
    yield Mutation("empty", lambda path: path.write_bytes(b"") and None)
    for name, make in {
        "folder": lambda path: path.mkdir(),
        "fifo": lambda path: os.mkfifo(path),
        "socket": _socket,
        "link to itself": lambda path: path.symlink_to(path.name),
        "loop of links": _loop,
    }.items():
        yield Mutation(name, _instead(make))
    for target in (
        "nowhere",
        "/etc/passwd",
        "/dev/zero",
        "/dev/null",
        "/dev/full",
        "/proc/self/mem",
        "/proc/self/environ",
        "/proc/version",
        "/",
    ):
        yield Mutation(f"link to {target}", _instead(lambda path, target=target: path.symlink_to(target)))
    if not root:  # who may read everything is refused nothing
        yield Mutation("unreadable", lambda path: path.chmod(0))


def content(name: str, make: Callable[[], bytes]) -> Mutation:
    """Other content altogether."""
    return Mutation(name, lambda path: path.write_bytes(make()) and None)


def _writer(change: Callable[[bytes], bytes]) -> Change:
    return lambda path: path.write_bytes(change(path.read_bytes())) and None


def _instead(make: Callable[[Path], None]) -> Change:
    def change(path: Path) -> None:
        path.unlink()
        make(path)

    return change


def _link_to_itself_elsewhere(path: Path) -> None:
    moved = path.with_name("elsewhere")
    path.rename(moved)
    path.symlink_to(moved.name)


def _loop(path: Path) -> None:
    other = path.with_name("other")
    path.symlink_to(other.name)
    other.symlink_to(path.name)


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            server.bind(f"/proc/self/fd/{folder}/{path.name}")  # paths of sockets are short
        finally:
            os.close(folder)
