"""Module paths of before, which are still found: with a `DeprecationWarning`, until version 0.3.

Appended to `sys.meta_path`, so that it is asked only for what is not there otherwise.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

PACKAGE = "torch_ebip"
MOVED = {
    "ambient": ("common.ambient",),
    "archives": ("recordings.archives",),
    "arguments": ("common.arguments",),
    "basis": ("interaction.basis",),
    "checkpoint": ("learning.checkpoint",),
    "demonstrations": ("recordings.demonstrations",),
    "draws": ("common.draws",),
    "files": ("common.files",),
    "filters": ("filtering", "interaction", "live"),
    "folders": ("recordings.folders",),
    "functional": ("filtering.functional",),
    "layout": ("recordings.layout",),
    "losses": ("learning.losses",),
    "meaning": ("common.meaning",),
    "metrics": ("learning.metrics",),
    "monitor": ("learning.monitor",),
    "noise": ("filtering", "interaction"),
    "objective": ("learning.objective",),
    "primitive": ("interaction.primitive",),
    "ranks": ("learning.ranks",),
    "repeats": ("recordings.repeats",),
    "scores": ("filtering.functional.scores",),
    "session": ("live",),
    "tuning": ("learning",),
}
"""Below the package, by the name of before; what lay deeper is looked for in the same places."""


class FormerPaths(MetaPathFinder, Loader):
    """Finds a module of before, whose names are those of where they are now."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """See `importlib.abc.MetaPathFinder`: fullname; path and target are not looked at."""
        package, _, rest = fullname.partition(".")
        if package != PACKAGE or rest.split(".")[0] not in MOVED:
            return None
        return ModuleSpec(fullname, self, is_package="." not in rest)

    def exec_module(self, module: ModuleType) -> None:
        """Give a new module the names of where they are now."""
        places = MOVED[module.__name__.split(".")[1]]
        now = " and ".join(f"{PACKAGE}.{place}" for place in places)
        warnings.warn(f"{module.__name__} is now {now}: see CHANGELOG.md", DeprecationWarning, stacklevel=2)

        def found(name: str) -> Any:
            """A name of one of the places."""
            for place in places:
                there = importlib.import_module(f"{PACKAGE}.{place}")
                if hasattr(there, name):
                    return getattr(there, name)
            raise AttributeError(f"{module.__name__} is now {now}, where there is no {name!r}: see CHANGELOG.md")

        module.__doc__ = f"Of before: the names of {now}."
        module.__getattr__ = found  # type: ignore[method-assign]


def keep_former_paths() -> None:
    """Have them found, once."""
    if not any(type(finder) is FormerPaths for finder in sys.meta_path):
        sys.meta_path.append(FormerPaths())
