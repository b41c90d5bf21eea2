"""Pages to look at recordings, a store, an evaluation or rollouts; and the doctor.

Each topic has a file with its facts, pictures and sections. Recordings, the largest topic, are a
folder of such files. `page` writes the pages.
"""
