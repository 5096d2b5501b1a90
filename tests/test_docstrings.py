"""Docstrings say what somebody needs who calls it: every parameter, the shapes of tensors, units.

All that has no underscore has a docstring, with shapes if tensors go in or out. What is public (as listed in
`public_surface.txt`) also names every parameter, in its Args if it has them, and units where the name of a parameter
or of a property is that of a quantity. "See `that`" and "as `that`" take in what is said there.
"""

from __future__ import annotations

import doctest
import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

import torch_ebip
from tests.public_surface import public_names

# A bracket that names a dimension, as [..., D] does and the interval [0, 1] does not; or one of a fixed size.
SHAPE = re.compile(r"\[(?=[^\][]*(?:\.\.\.|[A-Za-z]))[^\][]+\]|\[\d\]|\[(\d), \1\]|\bscalar\b")
REFERENCE = re.compile(r"(?:[Ss]ee|\bas) `([\w.]+)`")
SECTIONS = ("Args", "Attributes")
SECONDS, ANGLES = r"\bseconds\b|\bs\b", r"\brad\b"
UNITS = {
    "dt": SECONDS,
    "time": SECONDS,
    "horizon": SECONDS,
    "durations": SECONDS,
    "now": rf"{SECONDS}|\bphases\b",
    "rate": r"\bHz\b",
    "phase_velocity": r"\b1/s\b",
    "joints": ANGLES,
    "predicted_joints": ANGLES,
    "target_joints": ANGLES,
    "joint_limits": ANGLES,
    "velocity_limits": r"\brad/s\b",
    "tool": r"\bmetres\b",
    "y": r"\bunits\b",
    "target": r"\bunits?\b",
    "variance": r"\bsquared units\b",
    "residual_variance": r"\bsquared units\b",
}


class Documented(NamedTuple):
    """A function, class, method or property, with the annotations of what it takes and gives."""

    name: str
    docstring: str
    parameters: dict[str, str]
    returns: str
    public: bool


def _everything() -> Iterator[Documented]:
    """All without an underscore, where it is defined."""
    public = {id(thing) for things in public_names().values() for thing in things.values()}
    # What a public class inherits is public too.
    public |= {id(part) for things in public_names().values() for thing in things.values() for part in _bases(thing)}
    names = [module.name for module in pkgutil.walk_packages(torch_ebip.__path__, "torch_ebip.")]
    for module in map(importlib.import_module, names):
        for name, thing in vars(module).items():
            if name.startswith("_") or getattr(thing, "__module__", None) != module.__name__:
                continue
            path = f"{module.__name__}.{name}"
            if inspect.isfunction(thing):
                yield _documented(path, thing, thing, id(thing) in public)
            elif inspect.isclass(thing):
                made = thing.__new__ if hasattr(thing, "_fields") else vars(thing).get("__init__")
                yield _documented(path, thing, made, id(thing) in public)._replace(returns="")
                for member, value in vars(thing).items():
                    function = getattr(value, "fget", getattr(value, "__func__", value))
                    if not member.startswith("_") and inspect.isfunction(function):
                        yield _documented(f"{path}.{member}", function, function, id(thing) in public)


def _bases(thing: Any) -> tuple[type, ...]:
    return thing.__mro__ if inspect.isclass(thing) else ()


def _documented(name: str, thing: Any, called: Any, public: bool) -> Documented:
    parameters, returns = {}, ""
    if called is not None:
        signature = inspect.signature(called)
        parameters = {key: str(value.annotation) for key, value in signature.parameters.items()}
        returns = str(signature.return_annotation)
    for key in ("self", "cls", "_cls", "args", "kwargs"):
        parameters.pop(key, None)
    return Documented(
        name, inspect.cleandoc(vars(thing).get("__doc__") or thing.__doc__ or ""), parameters, returns, public
    )


EVERYTHING = {documented.name: documented for documented in _everything()}


def _complaints(documented: Documented) -> list[str]:
    """What a docstring lacks."""
    own = documented.docstring
    if not own:
        return ["has no docstring"]
    text = _with_references(own)
    tensors = [name for name, annotation in documented.parameters.items() if _is_tensor(annotation)]
    complaints = []
    if (tensors or _is_tensor(documented.returns)) and not SHAPE.search(text):
        complaints.append("takes or gives tensors and states no shape, such as [..., D]")
    has_arguments = any(f"{section}:\n" in own for section in SECTIONS)
    for name in documented.parameters if documented.public else ():
        entries = _entries(text, name)
        if has_arguments and not entries:
            complaints.append(f"does not list {name} in its Args")
        elif len(documented.parameters) > 1 and not re.search(rf"\b{name}\b", text):
            complaints.append(f"does not mention {name}")
        elif name in tensors and entries and not any(map(SHAPE.search, entries)):
            complaints.append(f"states no shape of {name}")
    if documented.public and "Returns:\n" in own and _is_tensor(documented.returns):
        after = own.split("Returns:\n", 1)[1].split("\n\n", 1)[0]
        if not SHAPE.search(after):
            complaints.append("states no shape of what it returns")
    measured = [*documented.parameters, *([] if documented.parameters else [documented.name.rsplit(".", 1)[-1]])]
    for name in measured if documented.public else ():
        unit = UNITS.get(name, "")
        if not any(re.search(unit, entry) for entry in _entries(text, name) or [text]):
            complaints.append(f"states no unit of {name}")
    return complaints


def _is_tensor(annotation: str) -> bool:
    return re.search(r"\bTensor\b", annotation) is not None


def _with_references(docstring: str) -> str:
    """A docstring and, after it, those that it refers to."""
    texts, pending = [docstring], REFERENCE.findall(docstring)
    while pending:
        name = pending.pop()
        for path, documented in EVERYTHING.items():
            if path.endswith(f".{name}") and documented.docstring not in texts:
                texts.append(documented.docstring)
                pending.extend(REFERENCE.findall(documented.docstring))
    return "\n\n".join(texts)


def _entries(text: str, name: str) -> list[str]:
    """What is said of a parameter in lists of arguments: several may be described in one entry."""
    found = re.findall(rf"^    (?:\w+, )*{name}(?:, \w+)*: (.*(?:\n {{8,}}.*)*)", text, re.MULTILINE)
    return [str(entry) for entry in found]


@pytest.mark.parametrize("name", EVERYTHING)
def test_it_is_documented(name: str) -> None:
    complaints = _complaints(EVERYTHING[name])
    assert not complaints, f"{name}: {'; '.join(complaints)}"


GOOD = """Advance.

Args:
    y: [..., D], units of the DoFs.
    dt: seconds, [...].

Returns:
    The state, [..., n].
"""


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("", ""), ""),
        (("[..., D], units", "units"), "states no shape of y"),
        (("[..., D], units of the DoFs", "[..., D]"), "states no unit of y"),
        (("seconds, [...]", "[...]"), "states no unit of dt"),
        (("    dt: seconds, [...].\n", ""), "does not list dt in its Args"),
        (("[..., n]", "as it is then"), "states no shape of what it returns"),
        ((GOOD, "Advance y, units of the DoFs, by dt seconds within [0, 1]."), "states no shape, such as [..., D]"),
        ((GOOD, "Advance [..., D] in units of the DoFs, by dt seconds."), "does not mention y"),
        ((GOOD, "As many as there are; see `ensemble_update`, by dt seconds."), ""),
        ((GOOD, ""), "has no docstring"),
    ],
)
def test_what_is_missing_is_found(change: tuple[str, str], complaint: str) -> None:
    parameters = {"y": "Tensor", "dt": "float | Tensor"}
    docstring = GOOD.replace(*change) if change[0] else GOOD
    complaints = "; ".join(_complaints(Documented("f", docstring, parameters, "Tensor", True)))
    assert (complaint in complaints) if complaint else not complaints


def test_every_docstring_of_tensors_needs_its_shapes() -> None:
    for documented in EVERYTHING.values():
        tensors = any(map(_is_tensor, [*documented.parameters.values(), documented.returns]))
        if tensors and not REFERENCE.search(documented.docstring):
            bare = documented._replace(docstring=SHAPE.sub("", documented.docstring))
            assert any("shape" in complaint for complaint in _complaints(bare)), documented.name


def test_the_examples_of_docstrings_run() -> None:
    tried = 0
    for module in pkgutil.walk_packages(torch_ebip.__path__, "torch_ebip."):
        result = doctest.testmod(importlib.import_module(module.name))
        assert not result.failed, module.name
        tried += result.attempted
    assert tried > 30
