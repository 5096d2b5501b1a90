"""Units that people write, and the SI units that layouts keep."""

from __future__ import annotations

import math
import re

FACTORS = {
    "mm": ("m", 1e-3), "cm": ("m", 1e-2), "dm": ("m", 1e-1), "km": ("m", 1e3), "um": ("m", 1e-6), "µm": ("m", 1e-6),
    "in": ("m", 0.0254), "inch": ("m", 0.0254), "ft": ("m", 0.3048),
    "deg": ("rad", math.pi / 180), "degree": ("rad", math.pi / 180), "degrees": ("rad", math.pi / 180),
    "°": ("rad", math.pi / 180), "mrad": ("rad", 1e-3), "rev": ("rad", 2 * math.pi), "turn": ("rad", 2 * math.pi),
    "ms": ("s", 1e-3), "us": ("s", 1e-6), "µs": ("s", 1e-6), "ns": ("s", 1e-9), "min": ("s", 60.0),
    "g": ("m/s^2", 9.80665), "gram": ("kg", 1e-3), "mg": ("kg", 1e-6), "lb": ("kg", 0.45359237),
    "mN": ("N", 1e-3), "kN": ("N", 1e3), "kPa": ("Pa", 1e3), "hPa": ("Pa", 1e2), "bar": ("Pa", 1e5),
    "mV": ("V", 1e-3), "uV": ("V", 1e-6), "µV": ("V", 1e-6), "mA": ("A", 1e-3), "kHz": ("Hz", 1e3),
    "rpm": ("rad/s", 2 * math.pi / 60), "dps": ("rad/s", math.pi / 180), "gauss": ("T", 1e-4), "uT": ("T", 1e-6),
    "%": ("1", 1e-2),
}  # fmt: skip
"""What each is in SI. ``g`` is the standard gravity, as accelerometers have it; grams are ``gram``."""
NO_FACTOR = {"degC", "°C", "degF", "°F", "celsius", "fahrenheit", "dB"}
"""What no factor converts."""
_PART = re.compile(r"([^\d^*/ ]+)(?:\^?(-?\d))?\Z")


def in_si(unit: str) -> tuple[str, float]:
    """The SI unit of a unit, and by what values in it are multiplied; what is not known stays as it is, by 1.

    Args:
        unit: such as ``"mm"``, ``"deg/s"``, ``"cm/s^2"``, ``"N*mm"``.

    Raises:
        ValueError: one that no factor converts: degrees Celsius, decibels.

    Example:
        >>> in_si("mm/s")
        ('m/s', 0.001)
        >>> in_si("N")
        ('N', 1.0)
    """
    if unit in FACTORS:
        return FACTORS[unit]
    factor, found = 1.0, []
    for place, side in enumerate(unit.split("/")):
        parts = []
        for part in side.split("*"):
            match = _PART.match(part.strip())
            base = "" if match is None else match[1]
            if base in NO_FACTOR:
                raise ValueError(f"unit {unit!r} has no factor to an SI unit; convert the values first")
            if match is None or base not in FACTORS:
                parts.append(part)
                continue
            si, times = FACTORS[base]
            power = int(match[2] or 1)
            if "/" in si or si == "1":  # no part of a product: who writes that is asked
                return unit, 1.0
            parts.append(si + part.strip()[len(base) :])
            factor *= times ** (-power if place else power)
        found.append("*".join(parts))
    return "/".join(found), factor
