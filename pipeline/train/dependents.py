"""Which trained policies depend on which store, by what they say of the store they saw."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.base.durable import read_document
from pipeline.base.errors import CheckpointIncomplete
from pipeline.policy.checkpoint import DOCUMENT, SOURCE_KEYS, source_differences
from pipeline.store import FeatureStore
from pipeline.train.identity import recordings_of, source_of
from pipeline.train.run import RUN


@dataclass(frozen=True)
class Trained:
    """A training run, or a checkpoint that was copied out of one."""

    folder: Path
    source: Mapping[str, Any] | None
    """What its store was; None where its document is damaged."""
    recordings: Mapping[str, Any] | None = None
    """Which episodes and rows its store held; a checkpoint alone does not say."""
    held_out: Mapping[str, str] | None = None
    """Of a checkpoint alone: `source/id` of the held-out episodes -> digest of their files."""
    damage: str | None = None

    def depends_on(self, store: FeatureStore) -> str | None:
        """How it depends on a store, for people; None where it does not."""
        if self.source is None or source_differences(self.source, source_of(store)):
            return None
        if self.recordings is not None:
            return "trained on it" if self.recordings == recordings_of(store) else None
        contents = {one.content for one in store.episodes}
        if self.held_out is not None and contents.issuperset(self.held_out.values()):
            return "can be judged on it, has its features and held-out episodes"
        return None


def find_trained(folders: Sequence[Path]) -> list[Trained]:
    """Every run, finished or not, and every single checkpoint at or below these folders."""
    return [one for folder in folders if folder.is_dir() for one in _below(folder)]


def _below(folder: Path) -> Iterator[Trained]:
    names = {path.name for path in folder.iterdir()}
    if RUN in names:
        yield _run(folder)
        return
    if DOCUMENT in names:
        yield _checkpoint(folder)
        return
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.is_symlink():
            yield from _below(path)


def _run(folder: Path) -> Trained:
    try:
        document = read_document(folder / RUN)
        source = {key: document["source"][key] for key in SOURCE_KEYS}
        return Trained(folder, source, recordings=dict(document["decides"]["recordings"]))
    except (CheckpointIncomplete, KeyError, TypeError) as error:
        return Trained(folder, None, damage=f"{folder / RUN}: {error}")


def _checkpoint(folder: Path) -> Trained:
    try:
        document = read_document(folder / DOCUMENT)
        source = {key: document[key] for key in SOURCE_KEYS}
        return Trained(folder, source, held_out=dict(document["held_out_content"]))
    except (CheckpointIncomplete, KeyError, TypeError, ValueError) as error:
        return Trained(folder, None, damage=f"{folder / DOCUMENT}: {error}")
