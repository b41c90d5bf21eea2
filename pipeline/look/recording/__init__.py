"""Recordings: each topic has a file with its facts, its issues, its picture and its section."""
