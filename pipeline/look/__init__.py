"""What is in a recording, a store, an evaluation, a machine, for people who would rather look.

One room a topic: facts, pictures and the sections of its page together; `page` writes them.
"""
