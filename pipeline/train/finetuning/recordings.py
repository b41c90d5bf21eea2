"""The recordings that a store was extracted from, opened again and compared with it."""

from collections.abc import Sequence
from contextlib import closing

from tqdm import tqdm

from pipeline.base.commands import command
from pipeline.base.config import Params
from pipeline.base.digests import ContentDigests, ledger_path
from pipeline.base.errors import RecordingError, StoreMismatch
from pipeline.data import Opened, Recording, content_digest, open_recordings
from pipeline.store import Episode, FeatureStore, episode_name
from pipeline.train.training_data import list_differences
from pipeline.vlm.feature_spec import FeatureSpec, feature_spec

_SHOWN = 5


def find_recordings(store: FeatureStore, params: Params) -> tuple[Recording, ...]:
    """The recording of each episode of the store, in its order, by source and id.

    Only the store's views are kept. Reads metadata only. Raises `StoreMismatch` naming the
    episodes that `data.sources` no longer have.
    """
    opened = open_recordings(params.data.sources, params.data.root, store.spec["views"])
    known = {(recording.source, recording.id): recording for recording in opened.recordings}
    missing = [episode for episode in store.episodes if (episode.source, episode.id) not in known]
    if missing:
        _refuse(store, [(episode, _why_missing(episode, opened)) for episode in missing])
    return tuple(known[episode.source, episode.id] for episode in store.episodes)


def check_recordings(
    store: FeatureStore, recordings: Sequence[Recording], digests: ContentDigests
) -> None:
    """Raise `StoreMismatch` where a recording is not what it was when the store was extracted.

    `recordings` are those of `find_recordings`. Files whose digest is not known yet are read.
    """
    changed: list[tuple[Episode, str]] = []
    pairs = list(zip(store.episodes, recordings, strict=True))
    for episode, recording in tqdm(pairs, "check", unit="episode", disable=None, leave=False):
        try:
            if content_digest(recording, digests.of) != episode.content:
                changed.append((episode, f"the files in {recording.path} changed since extraction"))
            elif recording.instruction != episode.instruction:
                before, now = repr(episode.instruction), repr(recording.instruction)
                changed.append((episode, f"its instruction was {before} at extraction, {now} now"))
        except RecordingError as error:
            changed.append((episode, str(error)))
    if changed:
        _refuse(store, changed)


def check_spec(store: FeatureStore, params: Params, digests: ContentDigests) -> FeatureSpec:
    """The store's feature spec, after a check that `vlm` gives the same.

    Raises `StoreMismatch` with the entries that differ, and `VLMError` where the checkpoint cannot
    be used.
    """
    stored = store.spec
    spec = feature_spec(params.vlm, stored["storage_dtype"], stored["views"], digests.of)
    if spec.digest != stored["digest"]:
        raise StoreMismatch(
            f"{store.path}: tuning begins with the model whose features the store holds, but its "
            f"feature spec is not that of vlm (store -> vlm):\n"
            f"{list_differences(stored, spec.attrs())}\n"
            "Set vlm to what the store was extracted with, name another store in "
            f"train_head.store, or extract one with these params: {command('extract')}"
        )
    return spec


def known_digests(store: FeatureStore) -> "closing[ContentDigests]":
    """The ledger of digests that extraction keeps beside a store; closed at the end of a `with`."""
    return closing(ContentDigests(ledger_path(store.path)))


def _why_missing(episode: Episode, opened: Opened) -> str:
    for bad in opened.bad:
        if bad.source == episode.source and bad.where.name == episode.id.rpartition("/")[2]:
            return bad.reason
    return f"no source has it; it was extracted from {episode.path}, relative to data.root"


def _refuse(store: FeatureStore, wrong: Sequence[tuple[Episode, str]]) -> None:
    lines = "\n".join(f"  {episode_name(episode)}: {why}" for episode, why in wrong[:_SHOWN])
    raise StoreMismatch(
        f"{store.path}: expected the recordings that the store was extracted from, but of its "
        f"{len(store.episodes)} episodes {len(wrong)} cannot be found as they were, the first:\n"
        f"{lines}\nPut the recordings back (data.root, data.sources), or extract a store of what "
        f"is there now: {command('extract')}"
    )
