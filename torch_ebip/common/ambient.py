"""A caller's ambient modes change neither numbers nor what is kept.

Under `torch.autocast` matrix products would be taken in half precision; under `torch.inference_mode` everything that
is made can never be differentiated, nor written into, outside of it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
_DEVICES = ("cpu", "cuda")
_autocast_enabled, _inference_mode_enabled = torch.is_autocast_enabled, torch.is_inference_mode_enabled


@contextmanager
def own_modes(inference: bool = False) -> Iterator[None]:
    """Without autocast; with ``inference`` also without inference mode, for what is kept beyond a call."""
    with ExitStack() as modes:
        for device in _DEVICES:
            if torch.is_autocast_enabled(device):
                modes.enter_context(torch.autocast(device, enabled=False))
        if inference and torch.is_inference_mode_enabled():
            modes.enter_context(torch.inference_mode(False))
            modes.enter_context(torch.no_grad())
        yield


def without_autocast(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Run a function in the precision of its arguments, whatever `torch.autocast` its caller is in."""

    @functools.wraps(function)
    def run(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        """The function."""
        if _autocast_enabled("cpu") or _autocast_enabled("cuda"):
            with own_modes():
                return function(*arguments, **options)
        return function(*arguments, **options)

    return run


def in_own_modes(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The same, for a function whose results are kept and written into: not in inference mode either."""

    @functools.wraps(function)
    def run(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        """The function."""
        if _autocast_enabled("cpu") or _autocast_enabled("cuda") or _inference_mode_enabled():
            with own_modes(inference=True):
                return function(*arguments, **options)
        return function(*arguments, **options)

    return run


def owned(tensor: Tensor) -> Tensor:
    """A copy of a tensor [...] that belongs to nobody's graph or mode, as buffers must be."""
    with own_modes(inference=True):
        return tensor.detach().clone()


def outside_inference(tensor: Tensor) -> Tensor:
    """The tensor [...]; a copy if it was made in inference mode and would be used outside of it."""
    if tensor.is_inference() and not torch.is_inference_mode_enabled():
        return tensor.clone()
    return tensor


def eager(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The same as `without_autocast`, and left out of `torch.compile`, whose graph is broken here.

    Which rows a sample measures decides what is computed; there is no one graph of it.
    """
    plain = without_autocast(function)

    @functools.wraps(function)
    def run(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        """The function."""
        if torch.compiler.is_compiling():
            # Not before: the compiler takes a second to import.
            return torch.compiler.disable(plain)(*arguments, **options)  # type: ignore[no-any-return, no-untyped-call]
        return plain(*arguments, **options)

    return run
