"""Channels that are one quantity over place, such as the depths of an A-scan."""

import re

PROFILE_CHANNELS = 24
"""Channels of one unit that a number alone tells apart, from which they are one profile."""


def unnumbered(name: str) -> str:
    """The name with `#` for each number: `aline_#` of `aline_0012`; the same without a number."""
    return re.sub(r"\d+", "#", name)
