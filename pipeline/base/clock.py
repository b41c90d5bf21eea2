"""What clocks leave open."""

CLOCK_SLACK_S = 1e-6
"""A reading that is older than a window by less is in it: clocks are rounded."""
