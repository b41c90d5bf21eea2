"""Recordings: what they hold, what looks wrong, and their page."""
