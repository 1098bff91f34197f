"""Numbers as a person reads them."""

from __future__ import annotations


def length(value_m: float) -> str:
    """Return a length in mm below 10 cm, in m above, with three digits or so."""
    if abs(value_m) < 0.1:
        return f"{value_m * 1e3:.{2 if abs(value_m) < 1e-3 else 3}g} mm"
    return f"{value_m:.3g} m" if abs(value_m) < 10 else f"{value_m:,.1f} m"


def percent(share: float) -> str:
    """Return a share, with more digits where it is small."""
    digits = 0 if abs(share) >= 0.1 else 1 if abs(share) >= 0.01 else 2 if abs(share) >= 0.001 else 3
    return f"{share * 100:.{digits}f} %"


def count_of(number: int, thing: str) -> str:
    """Return a number and what it counts."""
    return f"{number:,} {thing}{'' if number == 1 else 's'}"
