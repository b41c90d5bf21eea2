"""Which episodes of a store a data set is of."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePath

from pipeline.base.differences import describe, differences
from pipeline.base.errors import StoreMismatch
from pipeline.data import Recording
from pipeline.data.recording import absolute
from pipeline.store import Episode, FeatureStore


def check_store(
    store: FeatureStore, vlm_reuse_count: int, action_hz: float | None, action_rotation: str
) -> None:
    """Raise `StoreMismatch` where a store's ticks are others than these settings ask for.

    An `action_hz` of None asks for no rate: a store says the rate of recorded rows too.
    """
    expected: dict[str, object] = {"vlm_reuse_count": vlm_reuse_count}
    if action_hz is not None:
        expected["action_hz"] = action_hz
    actual: dict[str, object] = {name: getattr(store, name) for name in expected}
    if action_rotation != "auto":
        rotations = {"rx": "rotvec", "da": "euler_delta"}
        names = store.streams["action"]["names"]
        actual["action_rotation"] = next((rotations[n] for n in names if n in rotations), "neither")
        expected["action_rotation"] = action_rotation
    if wrong := describe(differences(expected, actual), " expected, found "):
        raise StoreMismatch(
            f"{store.path}: its ticks are not those asked for ({'; '.join(wrong)}). Ask for what "
            "the store has, or set these in params.yaml's data and run stages.extract again."
        )


def episodes_of_format(store: FeatureStore, format: str) -> list[Episode]:
    """All episodes of the store that were recorded in this format, or in any (`auto`).

    Raises `StoreMismatch` where there is none.
    """
    episodes = [episode for episode in store.episodes if format in ("auto", episode.format)]
    if not episodes:
        formats = ", ".join(sorted({episode.format for episode in store.episodes})) or "none"
        raise StoreMismatch(
            f"{store.path}: expected episodes of the format {format!r}, found {formats}. Name "
            "another, or add such recordings to data.sources and run stages.extract again."
        )
    return episodes


def episodes_of_recordings(store: FeatureStore, recordings: Sequence[Recording]) -> list[Episode]:
    """The store's episode of each recording, in their order and under the sources they have here.

    An episode is known by its format, name and place: the store has paths relative to data.root.
    Raises `StoreMismatch` naming the recordings that the store does not have.
    """
    by_name = defaultdict[tuple[str, str], list[Episode]](list)
    for episode in store.episodes:
        by_name[episode.format, _name(episode.id)].append(episode)
    known: dict[int, Episode] = {}
    absent: list[Path] = []
    for recording in recordings:
        alike = by_name[recording.format, _name(recording.id)]
        same = [episode for episode in alike if _same_place(episode.path, recording.path)]
        known |= {e.index: replace(e, source=recording.source) for e in same}
        absent += [] if same else [recording.path]
    if absent:
        raise StoreMismatch(
            f"{store.path}: expected features of {len(recordings)} recordings, {len(absent)} of "
            f"them are not in it; first: {absent[0]}. Add them to data.sources and run "
            "stages.extract, or leave the store out to see frames."
        )
    return list(known.values())


def _name(id: str) -> str:
    """The id without the parent folders that told it from others of its source."""
    return id.rpartition("/")[2]


def _same_place(stored: str, path: Path) -> bool:
    parts = tuple(part for part in PurePath(stored).parts if part != ".")
    return absolute(path).parts[-len(parts) :] == parts if parts else True
