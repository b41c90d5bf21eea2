"""Pages for people who would rather look: recordings, a store, an evaluation, rollouts; doctor.

A file a topic has its facts, pictures and sections together; recordings, which have most, are a
folder of such files. `page` writes them.
"""
