"""Every public name of torch_ebip with its signature, as text: `python -m tests.public_surface --write`.

Public is what torch_ebip and its subpackages export in ``__all__``, and what its other top-level modules define
without an underscore. A name stands where it is defined; elsewhere it is said where that is. "attribute" is what a
constructor sets. What torch, NamedTuple and dataclasses bring themselves is left out, and annotations are as
written, so that the text is the same for every version of Python and of torch.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib
import inspect
import pkgutil
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ForwardRef, TypeVar

import torch_ebip

REVIEWED = Path(__file__).with_name("public_surface.txt")
COMMAND = "python -m tests.public_surface --write"
SYNTAX = {"__len__", "__getitem__", "__iter__", "__enter__"}
"""What is called by len(x), x[i], for and with."""


def surface() -> str:
    """The listing: a heading for each module, a line for each name, its members below it."""
    listed = public_names()
    # An object is described once: in the module nearest to its definition.
    home = {id(thing): module for module, things in listed.items() for thing in things.values() if _is_code(thing)}
    lines = []
    for module, things in listed.items():
        lines.append(f"\n# {module}")
        for name, thing in sorted(things.items()):
            where = home.get(id(thing), module)
            if isinstance(thing, types.ModuleType):
                lines.append(f"{name}: module")
            elif where != module:
                lines.append(f"{name}: see {where}")
            else:
                lines.extend(_lines(name, thing))
    return "\n".join(lines).strip() + "\n"


def public_names() -> dict[str, dict[str, Any]]:
    """What is public, by module and name: of the package, and of subpackages and modules one level down.

    What lies deeper is public only where a subpackage exports it.
    """
    names = sorted(f"torch_ebip.{module.name}" for module in pkgutil.iter_modules(torch_ebip.__path__))
    return {name: _public(importlib.import_module(name)) for name in ["torch_ebip", *names]}


def _public(module: types.ModuleType) -> dict[str, Any]:
    names = getattr(module, "__all__", None) or _defined(module)
    things = {name: getattr(module, name) for name in names}
    return {name: thing for name, thing in things.items() if not isinstance(thing, TypeVar)}


def _defined(module: types.ModuleType) -> list[str]:
    """Names without an underscore that a module defines itself: what it imports is not its own."""
    names = []
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.append(node.name)
        elif isinstance(node, ast.Assign):
            names.extend(target.id for target in node.targets if isinstance(target, ast.Name))
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.append(node.target.id)
    return [name for name in names if not name.startswith("_")]


def _is_code(thing: Any) -> bool:
    return inspect.isclass(thing) or inspect.isfunction(thing)


def _lines(name: str, thing: Any) -> Iterator[str]:
    if inspect.isclass(thing):
        yield from _class_lines(name, thing)
    elif inspect.isfunction(thing):
        yield f"def {name}{_signature(thing)}"
    else:
        yield f"{name}{_value(thing)}"


def _class_lines(name: str, cls: type) -> Iterator[str]:
    """A class: its bases among ours and the standard library's, how it is made, and its members."""
    bases = ", ".join(base.__name__ for base in cls.__bases__ if base is not object)
    yield f"class {name}({bases})" if bases else f"class {name}"
    ours = [part for part in cls.__mro__ if part.__module__.startswith("torch_ebip")]
    fields = getattr(cls, "_fields", None)
    if fields is not None or dataclasses.is_dataclass(cls) or any("__init__" in vars(part) for part in ours):
        made = cls.__new__ if fields is not None else cls.__init__
        yield f"    ({_parameters(made)})"
    members: dict[str, str] = {}
    for part in reversed(ours):
        members.update(_members(part, {*(fields or ()), *vars(part).get("__match_args__", ())}))
    for member in sorted(members):
        yield f"    {members[member]}"


def _members(cls: type, fields: set[str]) -> Iterator[tuple[str, str]]:
    """Public members that a class defines itself, fields left out, each with its line."""
    annotations = inspect.get_annotations(cls)
    for name in sorted({*vars(cls), *annotations, *_attributes(cls)} - fields):
        thing = vars(cls).get(name)
        if name.startswith("_") and name not in SYNTAX:
            continue
        if isinstance(thing, property):
            assert thing.fget is not None
            yield name, f"{name}: property -> {_annotation(thing.fget.__annotations__.get('return'))}"
        elif isinstance(thing, (classmethod, staticmethod)):
            yield name, f"{type(thing).__name__} {name}{_signature(thing.__func__)}"
        elif inspect.isfunction(thing):
            yield name, f"def {name}{_signature(thing)}"
        elif name in vars(cls):
            yield name, f"{name}{_value(thing)}"
        else:
            yield name, f"{name}: {_annotation(annotations[name])}" if name in annotations else f"{name}: attribute"


def _attributes(cls: type) -> set[str]:
    """What the class's own constructor sets on the object."""
    made = vars(cls).get("__init__")
    if not inspect.isfunction(made) or dataclasses.is_dataclass(cls):
        return set()
    tree = ast.parse(textwrap.dedent(inspect.getsource(made)))
    stores = (node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store))
    return {node.attr for node in stores if isinstance(node.value, ast.Name) and node.value.id == "self"}


def _signature(function: Any) -> str:
    return f"({_parameters(function)}) -> {_annotation(inspect.signature(function).return_annotation)}"


def _parameters(function: Any) -> str:
    """Parameters as written, without self and cls."""
    written, bare = [], True
    for index, parameter in enumerate(inspect.signature(function).parameters.values()):
        if index == 0 and parameter.name in ("self", "cls", "_cls"):
            continue
        if parameter.kind is parameter.KEYWORD_ONLY and bare:
            written.append("*")
        bare = bare and parameter.kind not in (parameter.KEYWORD_ONLY, parameter.VAR_POSITIONAL)
        stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
        default = "" if parameter.default is parameter.empty else _value(parameter.default)
        written.append(f"{stars}{parameter.name}: {_annotation(parameter.annotation)}{default}")
    return ", ".join(written)


def _annotation(annotation: Any) -> str:
    if isinstance(annotation, ForwardRef):  # what NamedTuple makes of a string
        return annotation.__forward_arg__
    return annotation if isinstance(annotation, str) else "not said"


def _value(thing: Any) -> str:
    """A constant or a default, where its text is the same for every version of Python; not so for type aliases."""
    plain = thing is None or isinstance(thing, (bool, int, float, str))
    plain = plain or (isinstance(thing, tuple) and all(isinstance(part, (int, float, str)) for part in thing))
    return f" = {thing!r}" if plain else " = ..."


def main() -> None:
    """Print the listing, or accept it as reviewed."""
    parser = argparse.ArgumentParser(prog="python -m tests.public_surface", description="the public names")
    parser.add_argument("--write", action="store_true", help=f"accept them: write {REVIEWED.name}")
    if parser.parse_args().write:
        REVIEWED.write_text(surface(), encoding="utf-8")
    else:
        print(surface(), end="")


if __name__ == "__main__":
    main()
