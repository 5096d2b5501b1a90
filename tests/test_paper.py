"""`docs/paper.md` holds: every symbol that it names is there, and every variable within it."""

import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import pytest

TEXT = (Path(__file__).parents[1] / "docs" / "paper.md").read_text(encoding="utf-8")
SYMBOL = re.compile(r"`([a-z_]+(?:\.\w+)+)`((?: \((?:`\w+`(?:, )?)+\))?)")
SYMBOLS = [
    (path, re.findall(r"`(\w+)`", within)) for path, within in SYMBOL.findall(TEXT) if path.split(".")[-1] != "py"
]


def resolved(path: str) -> Any:
    """The thing at a path below torch_ebip."""
    parts = path.split(".")
    for k in range(len(parts), 0, -1):
        try:
            thing = importlib.import_module(".".join(["torch_ebip", *parts[:k]]))
        except ModuleNotFoundError:
            continue
        for name in parts[k:]:
            thing = getattr(thing, name)
        return thing
    raise AssertionError(f"no module of {path}")


@pytest.mark.parametrize(("path", "variables"), SYMBOLS, ids=[path for path, _ in SYMBOLS])
def test_what_it_names_is_there(path: str, variables: list[str]) -> None:
    thing = resolved(path.removeprefix("torch_ebip."))
    if variables:
        source = inspect.getsource(thing)
        for name in variables:
            assert re.search(rf"\b{name}\b", source), f"{path} has no {name}"


def test_the_steps_of_an_update_have_names() -> None:
    """S, the cross-covariance, the gain's application and the new members, which a reader looks for first."""
    named = {name for _, variables in SYMBOLS for name in variables} | {path.split(".")[-1] for path, _ in SYMBOLS}
    assert {"S", "cross_covariance", "apply_gain", "updated", "moves"} <= named
    assert len(SYMBOLS) > 40
    every = set(re.findall(r"^\| (\d)", TEXT, re.MULTILINE))
    assert every == set("12345")  # the steps of the box
