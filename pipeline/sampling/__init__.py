"""Which ticks are trained on, which are held out, and which come next.

Everything here is a pure function of the store's contents and of (seed, step): nothing has to be
saved to resume, and resuming at any step gives the same stream.
"""

from pipeline.sampling.mixture import TickSampler, ticks_by_source
from pipeline.sampling.split import Split, episodes_by_recording, split_by_episode

__all__ = [
    "Split",
    "TickSampler",
    "episodes_by_recording",
    "split_by_episode",
    "ticks_by_source",
]
