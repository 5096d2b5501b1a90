"""Files made from scratch, kind by kind: valid ones of any shape, which must be read, or with one thing wrong.

Damage to one valid file finds what breaks near it; these go where it is not: other names, sizes, types, orders.
"""

from __future__ import annotations

import json
import math
import string
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch

from experiments.folds import write_values
from experiments.results import Cell
from torch_ebip import Filter, InteractionPrimitive, InteractionSession, SessionSettings
from torch_ebip.learning.checkpoint import save_checkpoint

Generator = Callable[[Random, Path, bool], None]
"""Writes a file to a path (and what belongs beside it), valid or with one thing wrong."""
LETTERS = string.ascii_letters + string.digits + "._-/ $[]{}|\\'\"%&<>~^äß²µ中∞"
WRONG_NAMES = ("", "\x00", "a\x00b", "\x1b[31mred", "a\nb", "\u202e", "\ud800", "x" * 100_000)
WRONG_NUMBERS = (math.nan, math.inf, -math.inf, -1.0, 0.0, 1e400, "1", None, [], {}, True, 10**400)


def names(random: Random, count: int) -> list[str]:
    """So many different ones."""
    found: dict[str, None] = {}
    while len(found) < count:
        found["".join(random.choices(LETTERS, k=random.randint(1, 12)))] = None
    return list(found)


def recordings(random: Random, path: Path, valid: bool) -> None:
    """``.npz`` of one to six modalities, with gaps and further columns."""
    D, N = random.randint(1, 6), random.randint(1, 5)
    rng = np.random.default_rng(random.getrandbits(32))
    lengths = rng.integers(2, 40, N)
    values = rng.normal(size=(int(lengths.sum()), D)) * 10.0 ** rng.integers(-6, 6)
    values[rng.random(values.shape) < random.choice((0.0, 0.3))] = np.nan
    values[np.cumsum(lengths) - 1] = 1.0  # something must have been measured
    groups = np.sort(rng.integers(0, D, D))
    kinds, units = names(random, D), names(random, D)
    arrays: dict[str, Any] = {
        "values": values.astype(random.choice(("<f4", "<f8", ">f4", ">f8"))),
        "lengths": lengths.astype(random.choice(("i8", "i4", "u2"))),
        "rate": np.float64(10.0 ** random.uniform(-2, 4)),
        "dofs": np.array(names(random, D)),
        "modality": np.array([kinds[group] for group in groups]),
        "unit": np.array([units[group] for group in groups]),
        "controlled": np.array([bool(group % 2) for group in groups]),
    }
    for name in names(random, random.randint(0, 3)):
        kind = random.choice(("f8", "i2", "?", "U5", "M8[s]", "c8"))
        arrays.setdefault(name, rng.integers(0, 100, (N, random.randint(1, 3))).astype(kind))
    if not valid:
        wrong = random.choice(("name", "length", "rate", "type", "infinite", "missing", "twice"))
        if wrong == "name":
            arrays[random.choice(("dofs", "modality", "unit"))] = np.array([random.choice(WRONG_NAMES[:-2])] * D)
        elif wrong == "length":
            arrays["lengths"] = arrays["lengths"] * random.choice((0, 2, -1))
        elif wrong == "rate":
            arrays["rate"] = np.array(random.choice((math.nan, math.inf, -1.0, 0.0, "30", True)))
        elif wrong == "type":
            arrays[random.choice(list(arrays))] = np.array(random.choice(([1, 2], ["a"], [[True]], 1j)))
        elif wrong == "infinite":
            arrays["values"][0, 0] = np.inf
        elif wrong == "missing":
            del arrays[random.choice(list(arrays)[:7])]
        else:
            arrays["dofs"] = np.array(["same"] * D) if D > 1 else np.array(["a", "b"])
    with zipfile.ZipFile(path, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name in random.sample(list(arrays), len(arrays)):
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asarray(arrays[name]), allow_pickle=False)


def table(random: Random, path: Path, valid: bool) -> None:
    """CSV with columns in any order, cells written in many ways, and columns that nobody asked for."""
    columns = ["hand.x", "hand.y", "arm.1", *[f"other {i}" for i in range(random.randint(0, 4))]]
    random.shuffle(columns)

    def cell(column: str) -> str:
        """A number, or what was not measured; anything in other columns."""
        if column.startswith("other"):
            return random.choice(("", "text", "1", '"a, b"', '"say ""x"""'))
        number = random.uniform(-1, 1) * 10 ** random.randint(-8, 8)
        ways = (f"{number}", f" {number:.3e} ", f'"{number:g}"', f"{number:+.0f}", "", "nan", "1_000", "١٢")
        return random.choice(ways[:6] if random.random() < 0.9 else ways)

    rows = [[cell(column) for column in columns] for _ in range(random.randint(2, 40))]
    rows[-1][columns.index("hand.x")] = "0.5"
    quoted = [f'"{column}"' if random.random() < 0.3 else column for column in columns]
    if not valid:
        row, place = random.choice(rows), random.randrange(len(columns))
        wrong = random.choice(("ragged", "cell", "header", "twice", "none"))
        if wrong == "ragged":
            row.append("1")
        elif wrong == "cell":
            row[columns.index("hand.y")] = random.choice(
                ("x", "inf", "1e999", "\x00", "--1", "0x10", "1,5", "\x1b[2J")
            )
        elif wrong == "header":
            quoted[place] = random.choice(WRONG_NAMES[:-2])
        elif wrong == "twice":
            quoted[place] = "hand.x"
        else:
            rows = rows[:1] if random.random() < 0.5 else []
    end = random.choice(("\n", "\r\n"))
    path.write_bytes(end.join([",".join(line) for line in (quoted, *rows)] + [""]).encode("utf-8"))


def _description(random: Random, valid: bool) -> dict[str, Any]:
    """A layout of some of the columns that the tables beside it have."""
    columns = random.sample(["hand.x", "hand.y", "arm.1"], random.randint(1, 3))
    modalities: list[dict[str, Any]] = []
    for i, name in enumerate(names(random, len(columns))):
        entry = {"name": name, "dofs": [columns[i]], "unit": random.choice(("m", "rad", "1", "m/s²"))}
        modalities.append(entry | ({"controlled": random.random() < 0.5} if random.random() < 0.5 else {}))
    described: dict[str, Any] = {"rate": random.choice((30, 30.0, 1e-3, 123456.789)), "modalities": modalities}
    if not valid:
        entry = random.choice(modalities)
        place = random.choice(("rate", "name", "dofs", "unit", "controlled", "modalities"))
        if place == "rate":
            described["rate"] = random.choice(WRONG_NUMBERS)
        elif place in ("name", "unit"):
            entry[place] = random.choice((*WRONG_NAMES[:6], 3, None, ["m"]))
        elif place == "dofs":
            entry["dofs"] = random.choice(([], "hand.x", [1], ["nowhere"], ["hand.x", "hand.x"], {}))
        elif place == "controlled":
            entry["controlled"] = random.choice((0, 1, "yes", None, []))
        else:
            described["modalities"] = random.choice(([], {}, 3, "hand", [3], modalities * 2))
    return described


def json_layout(random: Random, path: Path, valid: bool) -> None:
    """``layout.json``."""
    path.write_text(json.dumps(_description(random, valid), indent=random.choice((None, 2))))


def toml_layout(random: Random, path: Path, valid: bool) -> None:
    """``layout.toml``, in one of several ways to write it."""

    def text(value: Any) -> str:
        """A value as TOML writes it, or as it does not."""
        if isinstance(value, dict):
            return "{" + ", ".join(f"{name} = {text(entry)}" for name, entry in value.items()) + "}"
        if isinstance(value, float) and not math.isfinite(value):
            return str(value)
        return json.dumps(value, ensure_ascii=random.random() < 0.5)

    described = _description(random, valid)
    lines = [f"rate = {text(described['rate'])}"]
    tables = described["modalities"]
    if isinstance(tables, list) and all(isinstance(entry, dict) for entry in tables) and random.random() < 0.8:
        for entry in tables:
            lines += ["[[modalities]]", *(f"{name} = {text(value)}" for name, value in entry.items()), ""]
    else:
        inner = [text(entry) for entry in tables] if isinstance(tables, list) else None
        lines.append(f"modalities = {text(tables) if inner is None else '[' + ', '.join(inner) + ']'}")
    path.write_bytes("\n".join([*lines, "# the end"]).encode("utf-8", "surrogatepass"))


def urdf(random: Random, path: Path, valid: bool) -> None:
    """A tree with a chain to the link ``flange``, branches beside it, and its elements in any order."""
    depth = random.randint(1, 12)
    links = [*(f"link {i}" for i in range(depth)), "flange"]
    parts = [f'<link name="{link}"/>' for link in links]
    free: list[str] = []
    for i in range(depth):
        name, kind = f"joint {i}", random.choice(("revolute", "continuous", "prismatic", "fixed"))
        numbers = [f"{random.uniform(-2, 2):.{random.randint(0, 8)}g}" for _ in range(9)]
        inside = f'<parent link="{links[i]}"/><child link="{links[i + 1]}"/>'
        inside += f'<origin xyz="{" ".join(numbers[:3])}" rpy="{" ".join(numbers[3:6])}"/>'
        axis = random.choice(("0 0 1", "1 1 1", "0 -2 0.5", "1e-3 0 0"))
        inside += f'<axis xyz="{axis}"/>' if random.random() < 0.7 else ""
        inside += random.choice(("", "<limit/>", '<limit lower="-1" upper="2" effort="3" velocity="4"/>'))
        if free and kind != "fixed" and random.random() < 0.3:
            inside += f'<mimic joint="{random.choice(free)}" multiplier="{numbers[6]}" offset="{numbers[7]}"/>'
        if kind != "fixed":
            free.append(name)
        parts.append(f'<joint name="{name}" type="{kind}">{inside}</joint>')
        if random.random() < 0.3:
            parts.append(f'<link name="side {i}"/>')
            beside = f'<parent link="{links[i]}"/><child link="side {i}"/>'
            parts.append(
                f'<joint name="to side {i}" type="{random.choice(("fixed", "floating", "planar"))}">{beside}</joint>'
            )
    parts.append(random.choice(("", "<!-- nothing -->", "<gazebo><a/></gazebo>", '<material name="m"/>')))
    random.shuffle(parts)
    if not valid:
        place = next(i for i, part in enumerate(parts) if part.startswith('<joint name="joint'))
        old, new = random.choice(
            (
                ('type="', 'type="ball '),
                ('<parent link="', '<parent link="no '),
                ("<child", "<kid"),
                ('xyz="', 'xyz="nan '),
                ('xyz="', 'xyz="1e99 '),
                ("</joint>", '<mimic joint="nobody"/></joint>'),
                ("</joint>", f'<mimic joint="{parts[place].split(chr(34))[1]}"/></joint>'),
                ("</joint>", "<a>" * 5000 + "</a>" * 5000 + "</joint>"),
                ("<joint", "<joint unbound:x='1'"),
                ("</joint>", ""),
            )
        )
        parts[place] = parts[place].replace(old, new)
    path.write_text(f'<?xml version="1.0"?>\n<robot name="r">{"".join(parts)}</robot>', encoding="utf-8")


def _content(random: Random, depth: int) -> Any:
    """Tensors of all kinds, numbers, strings, containers of them."""
    generator = torch.Generator().manual_seed(random.getrandbits(32))
    kind = random.choice(("tensor", "number", "text", "list", "dict") if depth else ("tensor", "number", "text"))
    if kind == "tensor":
        shape = [random.randint(0, 5) for _ in range(random.randint(0, 3))]
        made = torch.randn(shape, generator=generator).to(random.choice((torch.float32, torch.float64, torch.int64)))
        return random.choice((made, made.T if made.ndim == 2 else made, made > 0, made[..., :1] if shape else made))
    if kind in ("number", "text"):
        return random.choice((1, -1.5, True, None, math.nan, math.inf, 2**70, "", "ä", "x" * 1000))
    inner = [_content(random, depth - 1) for _ in range(random.randint(0, 4))]
    return (
        random.choice((list, tuple))(inner)
        if kind == "list"
        else dict(zip(names(random, len(inner)), inner, strict=True))
    )


def checkpoint(random: Random, path: Path, valid: bool, configuration: dict[str, Any]) -> None:
    """A checkpoint of anything that one may hold."""
    content = {"parameters": {}, **{name: _content(random, 3) for name in names(random, random.randint(0, 5))}}
    wrong = None if valid else random.choice(("expanded", "configuration", "spelling", "member", "version"))
    if wrong == "expanded":
        content["x"] = torch.ones(1).expand(2 ** random.randint(1, 30))
    elif wrong == "configuration":
        configuration = {**configuration, random.choice(names(random, 3)): _content(random, 0)}
    save_checkpoint(path, configuration, content)
    if wrong in ("spelling", "member", "version"):
        with zipfile.ZipFile(path) as archive:
            members = [(member.filename, archive.read(member)) for member in archive.infolist()]
        if wrong == "member":
            members.append((random.choice(("x", "a/b", f"{members[0][0]}2", members[0][0].upper())), b"x"))
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for name, data in members:
                swapped = name.swapcase() if wrong == "spelling" and random.random() < 0.5 else name
                archive.writestr(swapped, b"99" if wrong == "version" and name.endswith("version") else data)


def session(random: Random, path: Path, valid: bool, filter: Filter, primitive: InteractionPrimitive) -> None:
    """A session in which sensors say all kinds of things, at all kinds of times."""
    path.unlink(missing_ok=True)
    settings = SessionSettings(
        window=random.uniform(0.01, 1.0),
        frozen_after=random.choice((None, 0.5, math.inf, {"hand": 1.0})),
        longest_gap=random.uniform(1.0, 20.0),
        start=random.choice((0.0, 1.7e9)),
        seed=random.getrandbits(40),
    )
    now = settings.start
    with InteractionSession(filter, primitive, settings=settings, record=path) as lived:
        for _ in range(random.randint(0, 60)):
            now += random.choice((0.0, 1 / 30, 0.2))
            value = random.choice(([0.1, 0.2], [random.random(), math.nan], [1e30, 0.0], "x", None, [1.0], math.inf))
            lived.push("hand", value, random.choice((now, now - 0.1, now - 5.0, now + 100.0, math.nan, "late")))
            if random.random() < 0.2:
                horizon = random.choice((None, 0.1, [0.0, 1.0], []))
                lived.forecast(horizon, now) if random.random() < 0.7 else lived.advance(now)
    if not valid:
        header, *entries = path.read_text().splitlines()
        told = json.loads(header)
        place = random.choice(list(told["settings"]))
        told["settings"][place] = random.choice((*WRONG_NUMBERS, 1e6, 1e-300, {"hand": -1}))
        entries.insert(0, json.dumps(random.choice((["advance", 1e9], ["push"], ["forecast", 0, "x", []], {}, 3))))
        path.write_text("\n".join([json.dumps(told), *entries]) + "\n")


def fold_values(random: Random, path: Path, valid: bool) -> None:
    """The values of a fold."""
    rng = np.random.default_rng(random.getrandbits(32))
    methods, count = names(random, random.randint(1, 4)), random.randint(1, 20)
    values = {}
    for subset in names(random, random.randint(1, 4)):
        cell = Cell(subset, random.random(), random.choice(("mse", "mae")), random.choice((None, "arm")), "rad")
        values[cell] = {name: rng.choice([0.5, math.nan, math.inf, -1e300], count) for name in methods}
    write_values(path, values)
    if not valid:
        content = json.loads(path.read_text())
        entry = random.choice(content)
        _spoil(random, entry, ("subset", "values"))
        path.write_text(json.dumps(content))


def _spoil(random: Random, entry: dict[str, Any], places: Sequence[str]) -> None:
    """Take something out of a table of JSON, or put something else in its place."""
    place = random.choice([name for name in places if name in entry])
    if random.random() < 0.3:
        del entry[place]
    else:
        entry[place] = random.choice((*WRONG_NUMBERS[:4], "1", None, [], {}, [[1]], {"a": [1, 2]}))
