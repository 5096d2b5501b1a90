"""What callers hand in: taken as it is meant, whatever library it comes from, or refused by name.

Nothing is coerced on the way: no boolean becomes a number, no fraction a count, no mask a list of indices.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
import torch
from torch import Tensor


def as_count(name: str, value: Any, least: int = 1) -> int:
    """A whole number of at least ``least``, of whatever integer type.

    Args:
        name: of the argument, for errors.
        value: anything.
        least: the smallest that is taken.

    Raises:
        ValueError: a boolean, a fraction (10.0 included), or anything below.
    """
    try:
        if isinstance(value, bool | np.bool_) or (isinstance(value, Tensor) and value.dtype == torch.bool):
            raise TypeError
        number = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} must be a whole number, got {_brief(value)}") from None
    if number < least:
        raise ValueError(f"{name} must be at least {least}, got {number}")
    return number


def as_number(
    name: str, value: Any, low: float = -math.inf, high: float = math.inf, *, above: bool = False, of: str = ""
) -> float:
    """A finite real number from ``low`` to ``high``; with ``above`` not ``low`` itself.

    Args:
        name: of the argument, for errors.
        value: a number of any library.
        low, high: the range.
        above: whether ``low`` is outside.
        of: what it is a number of, for errors: "of seconds".

    Raises:
        ValueError: a boolean, text, NaN, infinity, or anything outside.
    """
    if isinstance(value, Tensor | np.ndarray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        raise ValueError(f"{name} must be a number{of and ' ' + of}, got {_brief(value)}")
    number = float(value)
    if math.isfinite(number) and low <= number <= high and not (above and number == low):
        return number
    if high < math.inf:
        raise ValueError(f"{name} must lie between {low:g} and {high:g}, got {number}")
    kind = "finite" if low == -math.inf else "positive" if above else "finite and not negative"
    raise ValueError(f"{name} must be a {kind} number{of and ' ' + of}, got {number}")


def as_numbers(
    name: str, values: Any, count: int, what: str, low: float = -math.inf, *, above: bool = False
) -> list[float]:
    """As many numbers as there are of something: those given, or one for all of them.

    Args:
        name: of the argument, for errors.
        values: a number, or a sequence or array of them.
        count: how many.
        what: they must be, for errors: "one number for each memory".
        low, above: of each, see `as_number`.

    Raises:
        ValueError: more or fewer, none, or one that `as_number` refuses.
    """
    each = list(values) if np.ndim(values) else [values] * count
    if len(each) != count or not count:
        raise ValueError(f"{name} must be {what}, got {len(each)} for {count}")
    return [as_number(name, value, low, above=above) for value in each]


def as_seconds(dt: Any, like: Tensor) -> Tensor:
    """A step of time in the dtype and on the device of ``like`` [...].

    Args:
        dt: seconds, a number or [...].
        like: [...], what it is computed with.

    Raises:
        ValueError: negative, NaN or infinite, or no numbers at all.
    """
    if type(dt) is float and 0 <= dt < math.inf:  # most of all calls
        return torch.as_tensor(dt, dtype=like.dtype, device=like.device)
    if isinstance(dt, Tensor):
        good = dt.is_floating_point() and bool(((dt >= 0) & dt.isfinite()).all())
        step = dt.to(like) if good else dt
    else:
        step = torch.as_tensor(float("nan") if isinstance(dt, bool) else dt, dtype=like.dtype, device=like.device)
        good = bool(((step >= 0) & step.isfinite()).all())
    if not good:
        raise ValueError(f"dt must be a finite number >= 0 of seconds, got {_brief(dt)}")
    return step


def check_clocks(step: Tensor, batch: Sequence[int]) -> None:
    """Steps of time [...] must be one number, or one for each entry of a ``batch``.

    Raises:
        ValueError: they are more, or others.
    """
    rows = tuple(batch)[max(len(batch) - step.ndim, 0) :]
    if step.ndim > len(batch) or any(n not in (1, b) for n, b in zip(step.shape, rows, strict=True)):
        raise ValueError(f"dt must be a number, or one for each of a batch {list(batch)}, got {list(step.shape)}")


def as_mask(name: str, value: Any, length: int) -> Tensor:
    """bool [length] on the CPU, of a tensor, an array or a list of booleans.

    Args:
        name: of the argument, for errors.
        value: anything.
        length: how many there must be.

    Raises:
        ValueError: other types, indices among them, or another length.
    """
    mask = value if isinstance(value, Tensor) else _plain(name, value)
    if mask.shape != (length,) or mask.dtype != torch.bool:
        raise ValueError(f"{name} must be bool [{length}], got {str(mask.dtype)[6:]} {list(mask.shape)}")
    return mask.cpu()


def as_indices(name: str, value: Any, count: int) -> Tensor:
    """int64 [M], which of ``count`` things: indices, negative ones from the end, or a mask bool [count].

    Args:
        name: of such a thing, for errors.
        value: anything.
        count: how many there are.

    Raises:
        ValueError: fractions, an index that there is not, a mask of another length.
    """
    if isinstance(value, Tensor | np.ndarray):
        chosen = value if isinstance(value, Tensor) else _plain(name, value)
    else:
        items = list(value)
        if any(isinstance(item, bool | np.bool_) for item in items) and not all(
            isinstance(item, bool | np.bool_) for item in items
        ):
            raise ValueError(f"{name} mixes booleans and indices: {_brief(items)}")
        chosen = _plain(name, items) if items else torch.empty(0, dtype=torch.long, device="cpu")
    if chosen.dtype == torch.bool:
        return as_mask(name, chosen, count).nonzero().squeeze(-1)
    if chosen.ndim != 1 or chosen.is_floating_point() or chosen.is_complex():
        raise ValueError(f"{name} must be integers [M] or bool [{count}], got {_brief(value)}")
    chosen = chosen.long()
    outside = (chosen < -count) | (chosen >= count)
    if bool(outside.any()):
        raise ValueError(f"no {name} {chosen[outside].tolist()[:8]}; there are {count}")
    return torch.where(chosen < 0, chosen + count, chosen)


def as_values(name: str, value: Any, dofs: Sequence[str] | None, like: Tensor | None = None) -> Tensor:
    """Floating-point values [..., D] of a tensor, an array, lists or a data frame.

    A frame's columns are taken by their names, in the order of ``dofs``; what a masked array masks was not measured.

    Args:
        name: what they are, for errors.
        value: of one of these kinds.
        dofs: names of the D columns, where they are known.
        like: [...], what they are computed with, whose dtype they get. A tensor must be on its device.

    Raises:
        ValueError: columns that lack a DoF; text, booleans, complex or half-precision numbers; another device than
            what they are computed with.
    """
    if isinstance(value, Tensor):
        if like is not None and value.dtype == like.dtype and value.device == like.device:
            return value
        if like is not None and value.device != like.device:
            raise ValueError(f"{name} must be on {like.device}, as the filter is, got {value.device}")
        if value.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{name} must hold floating-point numbers of 32 or 64 bits, got {str(value.dtype)[6:]}")
        return value if like is None else value.to(like.dtype)
    columns = getattr(value, "columns", None)
    if columns is not None and dofs is not None:
        missing = [dof for dof in dofs if dof not in list(columns)]
        if missing:
            raise ValueError(f"{name} is a frame without the columns {', '.join(missing[:8])}")
        value = value[list(dofs)]
    array = value
    if np.ma.isMaskedArray(value):
        array = np.ma.filled(value if value.dtype.kind == "f" else value.astype(np.float64), np.nan)
    tensor = _plain(name, array)
    if tensor.dtype == torch.bool or tensor.is_complex():
        raise ValueError(f"{name} must hold real numbers, got {str(tensor.dtype)[6:]}")
    if like is not None:
        return tensor.to(like)
    wide = tensor.dtype in (torch.float32, torch.float64)
    return tensor if wide and isinstance(array, np.ndarray) else tensor.to(torch.get_default_dtype())


def _plain(name: str, value: Any) -> Tensor:
    """A tensor of an array or nested lists, on the CPU, in memory of its own."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biufc":
            raise ValueError("neither numbers nor booleans")
        return torch.tensor(np.ascontiguousarray(array.astype(array.dtype.newbyteorder("="))), device="cpu")
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise ValueError(f"{name} must be a tensor, an array or lists of numbers, got {_brief(value)}") from error


def _brief(value: Any) -> str:
    """A value in a few words."""
    if isinstance(value, Tensor) and value.ndim:
        return f"{str(value.dtype)[6:]} {list(value.shape)}"
    if isinstance(value, np.ndarray) and value.ndim:
        return f"{value.dtype} {list(value.shape)}"
    text = repr(value)
    return text if len(text) <= 60 else f"a {type(value).__name__}: {text[:60]}..."
