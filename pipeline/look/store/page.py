"""A store -> its page: what is in it, what looks wrong, and what it was made of."""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.base.config import InspectParams
from pipeline.base.errors import StoreIncomplete
from pipeline.base.format import duration, size
from pipeline.base.issue import Issue
from pipeline.look.page.blocks import Block, Document, Issues, Report, Section, Text
from pipeline.look.store.ages import Ages, find_age_issues, read_ages, show_ages
from pipeline.look.store.channels import (
    StreamSummary,
    find_channel_issues,
    show_channels,
    summarize_streams,
)
from pipeline.look.store.duplicates import (
    Duplicates,
    find_duplicate_issues,
    find_duplicates,
    show_duplicates,
)
from pipeline.look.store.episodes import (
    EpisodeCoverage,
    find_episode_issues,
    read_coverage,
    show_coverage,
)
from pipeline.look.store.features import (
    FeatureNorms,
    check_rows,
    find_feature_issues,
    look_at_features,
    sample_rows,
    show_features,
)
from pipeline.look.store.sizes import ArraySize, read_sizes, tabulate_sizes
from pipeline.store import FeatureStore
from pipeline.store.chunks import ChunkFiles
from pipeline.store.gather import WIDE
from pipeline.store.metadata import check_metadata
from pipeline.store.repair_hints import extract_command
from pipeline.store.schema import read_specs

_CHANNELS = 16
"""Of a stream, that its description names."""


@dataclass(frozen=True, eq=False)
class StoreView:
    """A store as one looks at it; times are seconds since the first tick of their episode."""

    store: FeatureStore
    episodes: tuple[EpisodeCoverage, ...]
    ages: Ages
    sizes: tuple[ArraySize, ...]
    features: FeatureNorms
    duplicates: Duplicates
    statistics: tuple[StreamSummary, ...]
    issues: tuple[Issue, ...]
    """One of the whole store names no episode."""


def inspect_store(path: str | Path, params: InspectParams) -> StoreView:
    """Everything that is said of a finished store; it is only read.

    In bounded memory, whatever its size: whole only what is a few bytes a tick or VL row, evenly
    spread samples of all that is wide, of features `params.points` VL rows at most. The checksums
    of these rows are checked, and those of metadata and of every narrow array; the rest is for
    stages.verify.

    Raises `StoreIncomplete` where it is not there, unfinished, damaged or without an episode,
    `StoreMismatch` where it is an archive or follows another schema, each saying what to run.
    """
    store = _open_checked(Path(path))
    sampled = sample_rows(store, params.points)
    check_rows(store, sampled.rows)
    episodes, age, statistics = read_coverage(store), read_ages(store), summarize_streams(store)
    features, duplicates = look_at_features(store, sampled), find_duplicates(store)
    issues = [
        *find_episode_issues(store, episodes),
        *find_age_issues(store, episodes, age),
        *find_channel_issues(statistics),
        *find_feature_issues(features, episodes),
        *find_duplicate_issues(duplicates, episodes),
    ]
    sizes = read_sizes(store.path)
    return StoreView(store, episodes, age, sizes, features, duplicates, statistics, tuple(issues))


def _open_checked(path: Path) -> FeatureStore:
    """A finished store with something in it, of which all but the wide arrays is as it was written.

    All that is said of a store rests on its metadata and its narrow arrays.
    """
    store = FeatureStore.open(path)
    check_metadata(path)
    for name, spec in read_specs(path).items():
        if name not in WIDE.values():
            with closing(ChunkFiles(path, spec, writable=False)) as files:
                files.check()
    if not len(store.array("vl/time")):
        raise StoreIncomplete(
            f"{path}: expected VL rows to look at, found none. Run {extract_command(path)}."
        )
    return store


def store_report(view: StoreView) -> Report:
    """The page of a store, by what `inspect_store` found; the same store gives the same page."""
    store = view.store
    rate = "as recorded" if store.action_hz is None else f"at {store.action_hz:g} Hz"
    reuse = store.vlm_reuse_count
    return Report(
        title=f"Store: {store.path.name}",
        summary=(
            f"Ticks {rate}, features of the model (a VL row) at "
            f"{'each of them' if reuse == 1 else f'one in {reuse}'}; feature spec "
            f"`{store.spec['digest']}`. Times count from the first tick of their episode."
        ),
        tiles=_tiles(view),
        sections=(
            Section("What looks wrong", [_issues(view), _checked(view)]),
            Section("Coverage", show_coverage(view.episodes)),
            Section("Age of the features", show_ages(view.ages)),
            Section("Size", [tabulate_sizes(view.sizes)]),
            Section("Features", show_features(view.features, view.episodes)),
            Section("Duplicates", show_duplicates(view.duplicates, view.episodes)),
            Section("Channels", show_channels(view.statistics)),
            Section("What it was made of", _documents(store)),
        ),
    )


def _tiles(view: StoreView) -> list[tuple[str, str]]:
    return [
        ("episodes", f"{len(view.episodes):,}"),
        ("length", duration(sum(episode.seconds for episode in view.episodes))),
        ("ticks", f"{view.store.ticks:,}"),
        ("VL rows", f"{view.features.sampled.total:,}"),
        ("on the disk", size(sum(array.disk_bytes for array in view.sizes))),
        ("findings", f"{len(view.issues):,}"),
    ]


def _issues(view: StoreView) -> Issues:
    return Issues(
        view.issues,
        "Nothing: clocks have no gaps, every stream is where others of its kind are, channels "
        "move, features follow the scene, and no recording is there twice.",
    )


def _checked(view: StoreView) -> Text:
    looked_at, total = len(view.features.sampled.rows), view.features.sampled.total
    rows = f"all {total:,}" if looked_at == total else f"{looked_at:,} of {total:,}"
    command = f"python -m stages.verify --set verify.store={view.store.path}"
    return Text(
        f"Metadata, clocks, offsets and the features of {rows} VL rows give the checksums that "
        "were written with them. Those of sensor, state and actions were not read"
        f"{'' if looked_at == total else ', nor those of the other rows'}: `{command}` reads every "
        "byte."
    )


def _documents(store: FeatureStore) -> list[Block]:
    computed = {
        f"VL rows {entry['rows'][0]} to {entry['rows'][1] - 1}": {
            name: value for name, value in entry.items() if name != "rows"
        }
        for entry in store.attrs["environment"]
    }
    streams = {
        name: document if name == "views" else _stream(document)
        for name, document in store.streams.items()
    }
    return [
        Document("Feature spec", store.spec),
        Document("Streams", streams),
        Document("Computed with", computed),
    ]


def _stream(document: Mapping[str, Any]) -> dict[str, Any]:
    """Channels with their units; of a thousand, the first."""
    pairs = list(zip(document["names"], document["units"], strict=True))
    channels = {name: unit or "no unit" for name, unit in pairs[:_CHANNELS]}
    if len(pairs) > _CHANNELS:
        channels["…"] = f"{len(pairs) - _CHANNELS:,} more"
    kind = {"kind": document["kind"]} if "kind" in document else {}
    return {**kind, "channels": channels}
