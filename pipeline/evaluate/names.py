"""How channels and numbers are written wherever a user reads of them."""

from collections.abc import Mapping


def with_unit(name: str, unit: str) -> str:
    """A name and, where it has one, its unit in brackets."""
    return f"{name} [{unit}]" if unit else name


def rounded(values: Mapping[str, float | None]) -> dict[str, float]:
    """For a JSON document: 6 significant digits, without what has no value."""
    return {key: float(f"{value:.6g}") for key, value in values.items() if value is not None}
