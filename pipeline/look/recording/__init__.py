"""Recordings: a file a topic with its facts, what looks wrong in it, its picture and section."""
