"""How a channel is called wherever a user reads of it."""


def with_unit(name: str, unit: str) -> str:
    """A name and, where it has one, its unit in brackets."""
    return f"{name} [{unit}]" if unit else name
