"""How an episode and a row of a store are called wherever a user reads of them."""

from pipeline.store.episodes import Episode
from pipeline.store.reader import FeatureStore


def episode_name(episode: Episode) -> str:
    """`source/id`, by which a checkpoint, a report and an error call an episode."""
    return f"{episode.source}/{episode.id}"


def place(store: FeatureStore, stream: str, row: int) -> str:
    """Where a store-global row of a stream lies: episode, row in it and time on its clock.

    `stream` is `tick`, `vl`, `sensor` or `state`; a row of the last two is called a reading.
    """
    starts = store.array(f"episode/{stream}_start")
    index = int(starts.searchsorted(row, side="right")) - 1
    kind = {"tick": "tick", "vl": "VL row"}.get(stream, f"{stream} reading")
    time_s = float(store.array(f"{stream}/time")[row])
    return (
        f"{episode_name(store.episodes[index])}, {kind} {row - int(starts[index])} "
        f"(at {time_s:.3f} s)"
    )
