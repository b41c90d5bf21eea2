"""A store -> its page: what is in it, what looks wrong, and what it was made of."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.base.commands import command
from pipeline.base.config import InspectParams, setting
from pipeline.base.errors import StoreIncomplete
from pipeline.base.format import duration, size
from pipeline.base.issue import Issue
from pipeline.look.page.blocks import Document, Issues, Report, Section, Text
from pipeline.look.store import channels, episodes, features, rows
from pipeline.look.store.channels import StreamSummary
from pipeline.look.store.episodes import EpisodeCoverage
from pipeline.look.store.features import FeatureNorms
from pipeline.look.store.rows import Ages, Duplicates
from pipeline.store import FeatureStore, check_trailers
from pipeline.store.gather import WIDE
from pipeline.store.repair_hints import extract_command

_NOTHING = "Nothing looks wrong: every check passed."


@dataclass(frozen=True, eq=False)
class StoreView:
    """A store as one looks at it; times are seconds since the first tick of their episode."""

    store: FeatureStore
    episodes: tuple[EpisodeCoverage, ...]
    ages: Ages
    bytes: int
    """On the disk."""
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
    store = FeatureStore.open(path)
    check_trailers(store.path, but=tuple(WIDE.values()))
    if not len(store.array("vl/time")):
        raise StoreIncomplete(f"{path}: has no VL row. Run {extract_command(store.path)}.")
    sampled = features.sample_rows(store, params.points)
    features.check_rows(store, sampled.rows)
    coverage = tuple(episodes.read_coverage(store, episode) for episode in store.episodes)
    age, statistics = rows.read_ages(store), channels.summarize_streams(store)
    norms, same = features.look_at_features(store, sampled), rows.find_duplicates(store)
    issues = (
        *episodes.find_episode_issues(store, coverage),
        *rows.find_age_issues(store, coverage, age),
        *channels.find_channel_issues(statistics),
        *features.find_feature_issues(norms, coverage),
        *rows.find_duplicate_issues(same, coverage),
    )
    files = (file.stat() for file in store.path.rglob("*") if file.is_file())
    taken = sum(status.st_blocks * 512 for status in files)
    return StoreView(store, coverage, age, taken, norms, same, statistics, issues)


def store_report(view: StoreView) -> Report:
    """The page of a store, by what `inspect_store` found; the same store gives the same page."""
    store = view.store
    rate = "as recorded" if store.action_hz is None else f"at {store.action_hz:g} Hz"
    reuse = store.vlm_reuse_count
    often = "each of them" if reuse == 1 else f"one in {reuse}"
    documents = (
        Document("Feature spec", store.spec),
        Document("Computed with", {"environments of VL rows": store.attrs["environment"]}),
    )
    return Report(
        title=f"Store: {store.path.name}",
        summary=(
            f"Ticks {rate}, features of the model (a VL row) at {often}; feature spec "
            f"`{store.spec['digest']}`. Times count from the first tick of their episode."
        ),
        tiles=_tiles(view),
        sections=(
            Section("What looks wrong", [Issues(view.issues, _NOTHING), _checked(view)]),
            Section("Coverage", episodes.show_coverage(view.episodes)),
            Section("Age of the features", rows.show_ages(view.ages)),
            Section("Features", features.show_features(view.features, view.episodes)),
            Section("Duplicates", rows.show_duplicates(view.duplicates)),
            Section("Channels", channels.show_channels(view.statistics)),
            Section("What it was made of", documents),
        ),
    )


def _tiles(view: StoreView) -> list[tuple[str, str]]:
    return [
        ("episodes", f"{len(view.episodes):,}"),
        ("length", duration(sum(episode.seconds for episode in view.episodes))),
        ("ticks", f"{view.store.ticks:,}"),
        ("VL rows", f"{view.features.sampled.total:,}"),
        ("on the disk", size(view.bytes)),
        ("findings", f"{len(view.issues):,}"),
    ]


def _checked(view: StoreView) -> Text:
    looked_at, total = len(view.features.sampled.rows), view.features.sampled.total
    which = f"all {total:,}" if looked_at == total else f"{looked_at:,} of {total:,}"
    verify = command("verify", setting("verify.store", view.store.path))
    words = f"Metadata, clocks, offsets and the features of {which} VL rows give the checksums"
    return Text(f"{words} that were written with them; `{verify}` reads every byte.")
