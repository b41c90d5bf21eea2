"""Which episodes of a store a data set is of."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePath

from pipeline.base.errors import StoreMismatch
from pipeline.data import Recording
from pipeline.data.reader import absolute
from pipeline.store import Episode, FeatureStore


def check_store(
    store: FeatureStore, vlm_reuse_count: int, action_hz: float | None, action_rotation: str
) -> None:
    """Raise `StoreMismatch` where a store's ticks are others than these settings ask for."""
    rotations = {"rx": "rotvec", "da": "euler_delta"}
    names = store.streams["action"]["names"]
    found = next((kind for name, kind in rotations.items() if name in names), "neither")
    wanted: dict[str, tuple[object, object]] = {
        "vlm_reuse_count": (vlm_reuse_count, store.vlm_reuse_count),
        "action_hz": (action_hz, store.action_hz),
    }
    if action_rotation != "auto":
        wanted["action_rotation"] = (action_rotation, found)
    wrong = [
        f"{name}: expected {asked}, found {there}"
        for name, (asked, there) in wanted.items()
        if asked != there
    ]
    if wrong:
        raise StoreMismatch(
            f"{store.path}: its ticks are not those asked for ({'; '.join(wrong)}). Ask for what "
            "the store has, or set these in params.yaml's data and run stages.extract again."
        )


def episodes_of_format(store: FeatureStore, format: str) -> list[Episode]:
    """All episodes of the store that were recorded in this format, or in any (`auto`).

    Raises `StoreMismatch` where there is none.
    """
    found = [one for one in store.episodes if format in ("auto", one.format)]
    if not found:
        has = ", ".join(sorted({one.format for one in store.episodes})) or "no episode"
        raise StoreMismatch(
            f"{store.path}: expected episodes of the format {format!r}, found {has}. Name another "
            "format, or add such recordings to data.sources and run stages.extract again."
        )
    return found


def episodes_of_recordings(store: FeatureStore, recordings: Sequence[Recording]) -> list[Episode]:
    """The store's episode of each recording, in their order and under the sources they have here.

    An episode is known by its format, name and place: the store has paths relative to data.root.
    Raises `StoreMismatch` naming the recordings that the store does not have.
    """
    by_name: dict[tuple[str, str], list[Episode]] = {}
    for episode in store.episodes:
        by_name.setdefault((episode.format, _name(episode.id)), []).append(episode)
    found: dict[int, Episode] = {}
    absent: list[Path] = []
    for recording in recordings:
        candidates = by_name.get((recording.format, _name(recording.id)), [])
        match = [one for one in candidates if _same_place(one.path, recording.path)]
        if not match:
            absent.append(recording.path)
        for episode in match:
            found[episode.index] = replace(episode, source=recording.source)
    if absent:
        raise StoreMismatch(
            f"{store.path}: expected features of {len(recordings)} recordings, {len(absent)} of "
            f"them are not in it; first: {absent[0]}. Add them to data.sources and run "
            "stages.extract, or leave the store out to see frames."
        )
    return list(found.values())


def _name(id: str) -> str:
    """The id without the parent folders that told it from others of its source."""
    return id.rpartition("/")[2]


def _same_place(stored: str, path: Path) -> bool:
    parts = tuple(part for part in PurePath(stored).parts if part != ".")
    return absolute(path).parts[-len(parts) :] == parts if parts else True
