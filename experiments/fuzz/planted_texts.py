"""Texts that somebody made on purpose: tables, descriptions, robots and recordings of sessions."""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from experiments.fuzz.mutations import Mutation, content
from experiments.fuzz.planted_archives import bombs

HUGE = "1" + "0" * 5000
"""A number that Python itself refuses to read."""
ODD: tuple[Any, ...] = (
    None,
    True,
    0,
    -1,
    7,
    1.5,
    math.nan,
    math.inf,
    10**400,
    "",
    "x",
    "nan",
    "\ud800",
    [],
    [1],
    [[]],
    {},
)
"""Values of other types than expected."""


def table(folder: Path, seed: int, rounds: int, quick: bool) -> Iterator[Mutation]:
    """Of a table of samples."""
    yield from _pickles(folder)
    head, rows = "hand.x,hand.y,arm.1", "\n1,2,3" * 3
    million = 10**6
    others = ",".join(f"c{i}" for i in range(million))
    for name, text in {
        "a million columns": f"{head},{others}\n1,2,3{',0' * million}\n4,5,6{',0' * million}\n",
        "a million empty columns": f"{head}{',' * million}\n1,2,3{',' * million}\n4,5,6{',' * million}\n",
        "a million cells in a row": f"{head}{rows}\n{'1,' * million}\n",
        "a million empty rows": f"{head}{rows}{chr(10) * million}",
        "a long cell": f"{head}{rows}\n1,2,{'3' * 10**6}\n",
        "a cell just short enough": f"{head}{rows}\n1,2,{'3' * 131_000}\n",
        "a row of many lines": f"{head}{rows}\n" + '"\n",' * (5 * million),
        "a line without an end": f"{head}{rows}\n" + "," * (20 << 20),
        "a quote without an end": f'{head}{rows}\n1,2,"3\n' + "4,5,6\n" * 100_000,
        "a column twice": f"{head},hand.x\n1,2,3,1\n4,5,6,4\n",
        "a column less": "hand.x,arm.1" + "\n1,2" * 3,
        "the head only": head,
        "no head": rows.strip(),
        "no line at all": "\n",
        "carriage returns": f"{head}{rows}".replace("\n", "\r"),
        "a mark of order": f"\ufeff{head}{rows}",
        "nul": f"{head}\n1,2,\0\n4,5,6\n",
        "separators": f"{head}{rows}".replace(",", ";"),
    }.items():
        yield content(name, text.encode)
    for cell in (
        "inf",
        "-inf",
        "nan",
        "1e999",
        "1e39",
        "1_000",
        "٣",
        "0x10",
        "1,5",
        "--1",
        "True",
        '"1"',
        "'1'",
        HUGE,
        "=1+1",
    ):
        yield content(f"a cell {cell[:10]}", f"{head}{rows}\n1,2,{cell}\n".encode)
    yield content("utf-16", lambda: f"{head}{rows}".encode("utf-16"))
    yield content("latin-1", lambda: f"{head},größe\n1,2,3,4\n5,6,7,8\n".encode("latin-1"))


def toml(folder: Path, seed: int, rounds: int, quick: bool) -> Iterator[Mutation]:
    """Of a description in TOML."""
    yield from _pickles(folder)
    valid = 'rate = 30\n[[modalities]]\nname = "hand"\ndofs = ["hand.x", "hand.y"]\nunit = "m"\n'
    for line in valid.splitlines():
        if " = " in line:
            name = line.split(" = ")[0]
            yield content(f"no {name}", valid.replace(line, "").encode)
            for value in (
                "true",
                "0",
                "-1",
                "nan",
                "inf",
                "1e400",
                HUGE,
                '""',
                '"x"',
                "[]",
                "[1]",
                "[[]]",
                "{}",
                "1979-05-27",
            ):
                yield content(f"{name} = {value[:10]}", valid.replace(line, f"{name} = {value}").encode)
    for name, text in {
        "dofs as a string": valid.replace('["hand.x", "hand.y"]', '"hand.x"'),
        "controlled as a string": valid + 'controlled = "false"\n',
        "modalities as a table": valid.replace("[[modalities]]", "[modalities]"),
        "modalities as a number": "rate = 30\nmodalities = 3\n",
        "modalities of numbers": "rate = 30\nmodalities = [1, 2]\n",
        "modalities of text": 'rate = 30\nmodalities = "hand"\n',
        "a dof twice": valid.replace("hand.y", "hand.x"),
        "a modality twice": valid + valid.split("30\n")[1],
        "rate twice": "rate = 1\n" + valid,
        "deep": "x = " + "[" * 100_000,
        "deep tables": "x = " + "{a = " * 50_000,
        "long keys": ".".join(["a"] * 100_000) + " = 1",
        "long keys in tables": "x = {" + ".".join(["a"] * 100_000) + " = 1}",
        "long quoted keys": " . ".join(['"\\""'] * 50_000) + " = 1",
        "long heads": "[" + ".".join(["a"] * 50_000) + "]\n" + "b.c = 1\n" * 20_000,
        "many modalities": "rate = 30\n"
        + "".join(f'[[modalities]]\nname = "{i}"\ndofs = ["{i}"]\nunit = "m"\n' for i in range(15_000)),
        "many dofs": valid.replace('"hand.y"', ", ".join(f'"{i}"' for i in range(100_000))),
        "a long name": valid.replace('"hand"', f'"{"x" * 500_000}"'),
        "too large": valid + "#" * (2 << 20),
        "nul": valid.replace("hand", "ha\0nd"),
    }.items():
        yield content(name, text.encode)
    yield content("utf-16", lambda: valid.encode("utf-16"))


def json_layout(folder: Path, seed: int, rounds: int, quick: bool) -> Iterator[Mutation]:
    """Of a description in JSON."""
    yield from _pickles(folder)
    yield from _texts()

    def description(**changes: Any) -> dict[str, Any]:
        return {"rate": 30, "modalities": [{"name": "hand", "dofs": ["hand.x"], "unit": "m"}], **changes}

    for value in ODD:
        yield _json(f"{str(value)[:10]} as all of it", value)
        yield _json(f"{str(value)[:10]} as rate", description(rate=value))
        yield _json(f"{str(value)[:10]} as modalities", description(modalities=value))
        yield _json(f"{str(value)[:10]} as a modality", description(modalities=[value]))
        for name in ("name", "dofs", "unit", "controlled"):
            modality = {**description()["modalities"][0], name: value}
            yield _json(f"{str(value)[:10]} as {name}", description(modalities=[modality]))
            modality = {**modality, "dofs": ["hand.x", value]}
            yield _json(f"{str(value)[:10]} as a dof with {name}", description(modalities=[modality]))


def urdf(folder: Path, seed: int, rounds: int, quick: bool) -> Iterator[Mutation]:
    """Of a robot."""
    yield from _pickles(folder)
    parts = {"xyz": "0.5 0 0", "rpy": "0.1 0 0", "axis": "0 0 1", "lower": "-1", "upper": "2", "velocity": "3"}

    def robot(before: str = "", inside: str = "", kind: str = "revolute", **changes: str) -> str:
        p = {**parts, **changes}
        return (
            f'{before}<robot name="r"><link name="base"/><link name="flange"/>{inside}<joint name="j" type="{kind}">'
            f'<parent link="base"/><child link="flange"/><origin xyz="{p["xyz"]}" rpy="{p["rpy"]}"/>'
            f'<axis xyz="{p["axis"]}"/><limit lower="{p["lower"]}" upper="{p["upper"]}" effort="1" '
            f'velocity="{p["velocity"]}"/></joint></robot>'
        )

    def chain(count: int) -> str:
        links = "".join(f'<link name="l{i}"/>' for i in range(count))
        joints = "".join(
            f'<joint name="j{i}" type="fixed"><parent link="{above}"/><child link="l{i}"/></joint>'
            for i, above in enumerate(["base", *(f"l{i}" for i in range(count - 1))])
        )
        return robot(inside=links + joints).replace(
            'parent link="base"/><child link="flange"', f'parent link="l{count - 1}"/><child link="flange"'
        )

    yield Mutation("two links", lambda path: path.write_text(robot()) and None, valid=True)
    for name, value in parts.items():
        for number in ("nan", "inf", "-inf", "1e300", "1e999", "1e-300", "0", "", "x", HUGE, "0x10", "1_0", "1,0"):
            yield content(
                f"{name} = {number[:10]}", robot(**{name: value.replace(value.split()[0], number, 1)}).encode
            )
        yield content(f"{name} of zeros", robot(**{name: "0 0 0"}).encode)
        yield content(f"{name} of a million numbers", robot(**{name: "0 " * 10**6}).encode)
    for kind in ("fixed", "continuous", "prismatic", "floating", "planar", "unknown", "", "x" * 10**5):
        yield content(f"a joint of type {kind[:20]}", robot(kind=kind).encode)
        yield content(f"a joint of type {kind[:20]} about nothing", robot(kind=kind, axis="0 0 0").encode)
    laughs = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 12))
    canary = folder / "canary"
    for name, before in {
        "a billion laughs": f'<!DOCTYPE r [<!ENTITY l0 "ha">{laughs}]>',
        "an entity of a file": '<!DOCTYPE r [<!ENTITY l11 SYSTEM "file:///etc/passwd">]>',
        "an entity without an end": '<!DOCTYPE r [<!ENTITY l11 SYSTEM "file:///dev/zero">]>',
        "an entity of the net": '<!DOCTYPE r [<!ENTITY l11 SYSTEM "http://127.0.0.1:9/x">]>',
        "a definition elsewhere": f'<!DOCTYPE r SYSTEM "file://{canary}">',
        "parameters": f'<!DOCTYPE r [<!ENTITY % p SYSTEM "file:///etc/passwd"> %p; <!ENTITY l0 "x">{laughs}]>',
        "a quadratic blow-up": f'<!DOCTYPE r [<!ENTITY l11 "{"a" * 10**5}">]>',
    }.items():
        inside = f'<link name="{"&l11;"}"/><link name="x">{"&l11;" * 1000}</link>'
        for encoding in ("utf-8", "utf-16", "utf-16-le", "utf-32", "utf-7", "cp037"):
            declared = f'<?xml version="1.0" encoding="{encoding}"?>' + robot(before, inside)
            yield content(f"{name} in {encoding}", lambda d=declared, e=encoding: d.encode(e))
            yield content(f"{name} declared as {encoding}", declared.encode)
    for name, text in {
        "a loop": robot(inside='<joint name="k" type="fixed"><parent link="flange"/><child link="base"/></joint>'),
        "a joint above itself": robot().replace('parent link="base"', 'parent link="flange"'),
        "two joints above": robot(
            inside='<joint name="k" type="fixed"><parent link="x"/><child link="flange"/></joint>'
        ),
        "no links": robot().replace("<link", "<lonk"),
        "no child": robot().replace("<child", "<chold"),
        "no parent": robot().replace("<parent", "<porent"),
        "no name": robot().replace('joint name="j"', "joint"),
        "no axis": robot().replace("<axis", "<oxis"),
        "no limit": robot().replace("<limit", "<lomit"),
        "limits the wrong way round": robot(lower="2", upper="-2"),
        "a negative speed": robot(velocity="-1"),
        "another root": "<sdf/>",
        "a list": "<a><b/></a>",
        "a space of names": robot().replace("<robot ", '<robot xmlns="http://x" '),
        "inclusion": robot(
            inside='<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="/etc/passwd" parse="text"/>'
        ),
        "deep": robot(inside="<a>" * 200_000 + "</a>" * 200_000),
        "deep without an end": robot(inside="<a>" * 200_000),
        "a hundred joints": chain(99),
        "a thousand joints": chain(1000),
        "many joints": chain(20_000),
        "many links": robot(inside="".join(f'<link name="x{i}"/>' for i in range(200_000))),
        "many attributes": robot(inside="<link " + " ".join(f'a{i}="1"' for i in range(200_000)) + "/>"),
        "many instructions": robot(inside="<?x y?>" * 200_000),
        "a long comment": robot(inside=f"<!--{'x' * (5 << 20)}-->"),
        "too large": robot() + " " * (20 << 20),
        "nul": robot().replace("base", "ba\0se"),
        "two declarations": '<?xml version="1.0"?><?xml version="1.0" encoding="utf-7"?>' + robot(),
        "a mark of order": "\ufeff" + robot(),
        "a long name": robot().replace("flange", "x" * 10**6),
    }.items():
        yield content(name, text.encode)


def session(folder: Path, seed: int, rounds: int, quick: bool) -> Iterator[Mutation]:
    """Of a recorded session."""
    yield from _pickles(folder)
    yield from _texts()
    for value in ODD:
        for name in ("kind", "format", "filter", "primitive", "sensors", "settings"):
            yield _first(f"{str(value)[:10]} as {name}", lambda head, n=name, v=value: {**head, n: v})
        for name in (
            "start",
            "window",
            "settle",
            "margin",
            "frozen_after",
            "stale_after",
            "longest_gap",
            "seed",
            "more",
        ):
            yield _settings(f"{str(value)[:10]} as {name}", name, value)
        for name, entry in {
            "sensor": ["push", value, 0.1, [1, 1]],
            "moment": ["push", "hand", value, [1, 1]],
            "sample": ["push", "hand", 0.1, value],
            "number": ["push", "hand", 0.1, [value, 1]],
            "present": ["advance", value],
            "horizon": ["forecast", 0.1, value, [[0.0]]],
            "horizons": ["forecast", 0.1, [value, 0.1], [[0.0], [0.0]]],
            "mean": ["forecast", 0.1, 0.1, value],
            "sort": [value, 1, 2, 3],
            "line": value,
        }.items():
            yield _line(f"{str(value)[:10]} as {name}", entry)
    for name in ("window", "longest_gap"):
        for seconds in (60.0, 1e3, 1e6, 1e9, 1e15, 1e300):
            yield _settings(f"{name} of {seconds} s", name, seconds)
    yield _settings("a file to write to", "record", str(folder / "canary"))
    yield _first("a file to write to, beside", lambda head: {**head, "record": str(folder / "canary")})
    yield _first("a hundred thousand sensors", lambda head: {**head, "sensors": [str(i) for i in range(100_000)]})
    million = 10**6
    yield _line("a million horizons", ["forecast", 0.1, [0.1] * million, [[0.0]]])
    yield _line("a million numbers", ["push", "hand", 0.1, [0.1] * million])
    yield _line("a million means", ["forecast", 0.1, 0.1, [[0.1] * million]])
    yield Mutation("ten thousand samples", lambda path: _append(path, ['["push", "hand", 0.8, [0.1, 0.2]]'] * 10_000))
    yield Mutation("a long line", lambda path: _append(path, ["[" + "1," * (10 << 20) + "1]"]))
    yield Mutation("lists in lists", lambda path: _append(path, ["[" * 10**6]))


def run_json(folder: Path, seed: int, rounds: int, quick: bool) -> Iterator[Mutation]:
    """Of what an experiment keeps in its folder."""
    yield from _pickles(folder)
    yield from _texts()
    cell = {
        "subset": "all",
        "observed": 0.5,
        "metric": "mae",
        "modality": "robot",
        "unit": "rad",
        "values": {"a": [1, 2]},
    }
    for value in ODD:
        yield _json(f"{str(value)[:10]} as all of it", value)
        yield _json(f"{str(value)[:10]} as an entry", [value])
        for name in (*cell, "more"):
            yield _json(f"{str(value)[:10]} as {name}", [{**cell, name: value}])
        for name in ("start", "factor", "sharpness", "more"):
            start = {"factor": 100.0, "sharpness": 10.0, name: value}
            yield _json(f"{str(value)[:10]} as {name}", {"start": value if name == "start" else start})
        yield _json(f"{str(value)[:10]} as a method", [{**cell, "values": {"a": value, "b": [1, 2]}}])
        yield _json(f"{str(value)[:10]} as a value", [{**cell, "values": {"a": [value, 1]}}])


def _texts() -> Iterator[Mutation]:
    """What any JSON may be."""
    for name, text in {
        "deep": "[" * 10**6,
        "deep tables": '{"a":' * 10**5,
        "a huge number": HUGE,
        "a long text": '"' + "x" * (5 << 20) + '"',
        "many lists": "[" + "[]," * 10**6 + "[]]",
        "many names": "{" + ",".join(f'"{i}":1' for i in range(300_000)) + "}",
        "comments": "/* x */ {}",
        "two values": "{} {}",
        "nul": "{\0}",
    }.items():
        yield content(name, (text + "\n").encode)
    yield content("utf-16", lambda: "{}\n".encode("utf-16"))


def _pickles(folder: Path) -> Iterator[Mutation]:
    for name, bomb in bombs(folder).items():
        for protocol in (0, 2, 5):
            yield content(f"pickle {protocol}, {name}", lambda b=bomb, p=protocol: pickle.dumps(b, p))


def _json(name: str, value: Any) -> Mutation:
    return content(name, lambda: json.dumps(value).encode())


def _first(name: str, change: Callable[[dict[str, Any]], Any]) -> Mutation:
    """Another first line."""

    def rewrite(path: Path) -> None:
        first, *others = path.read_text().splitlines(keepends=True)
        path.write_text("".join([json.dumps(change(json.loads(first))) + "\n", *others]))

    return Mutation(name, rewrite)


def _settings(name: str, setting: str, value: Any) -> Mutation:
    return _first(name, lambda head: {**head, "settings": {**head["settings"], setting: value}})


def _line(name: str, entry: Any) -> Mutation:
    """Another entry in the middle."""

    def rewrite(path: Path) -> None:
        lines = path.read_text().splitlines(keepends=True)
        lines[len(lines) // 2] = json.dumps(entry) + "\n"
        path.write_text("".join(lines))

    return Mutation(f"line: {name}", rewrite)


def _append(path: Path, lines: list[str]) -> None:
    path.write_text(path.read_text() + "\n".join(lines) + "\n")
