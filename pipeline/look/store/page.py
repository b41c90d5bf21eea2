"""A store -> its page: what is in it, what looks wrong, and what it was made of."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.config import InspectParams
from pipeline.base.errors import StoreIncomplete
from pipeline.base.format import duration, size
from pipeline.base.issue import Issue
from pipeline.base.table import Table
from pipeline.look.page.blocks import Document, Issues, Report, Section, Text
from pipeline.look.store import channels, episodes, features, rows
from pipeline.look.store.channels import StreamSummary
from pipeline.look.store.episodes import EpisodeCoverage
from pipeline.look.store.features import FeatureNorms
from pipeline.look.store.rows import Ages, Duplicates
from pipeline.store import FeatureStore, check_trailers
from pipeline.store.gather import WIDE
from pipeline.store.repair_hints import extract_command
from pipeline.store.schema import read_specs

METADATA = "metadata"
_NOTHING = "Nothing looks wrong: every check passed."


@dataclass(frozen=True, eq=False)
class StoreView:
    """A store as one looks at it; times are seconds since the first tick of their episode."""

    store: FeatureStore
    episodes: tuple[EpisodeCoverage, ...]
    ages: Ages
    sizes: Mapping[str, int]
    """Bytes on the disk, as `read_sizes` gives them."""
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
    sizes = read_sizes(store.path)
    return StoreView(store, coverage, age, sizes, norms, same, statistics, issues)


def store_report(view: StoreView) -> Report:
    """The page of a store, by what `inspect_store` found; the same store gives the same page."""
    store = view.store
    rate = "as recorded" if store.action_hz is None else f"at {store.action_hz:g} Hz"
    reuse = store.vlm_reuse_count
    often = "each of them" if reuse == 1 else f"one in {reuse}"
    documents = (
        Document("Feature spec", store.spec),
        Document("Streams", store.streams),
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
            Section("Size", [tabulate_sizes(store.path, view.sizes)]),
            Section("Features", features.show_features(view.features, view.episodes)),
            Section("Duplicates", rows.show_duplicates(view.duplicates, view.episodes)),
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
        ("on the disk", size(sum(view.sizes.values()))),
        ("findings", f"{len(view.issues):,}"),
    ]


def _checked(view: StoreView) -> Text:
    looked_at, total = len(view.features.sampled.rows), view.features.sampled.total
    which = f"all {total:,}" if looked_at == total else f"{looked_at:,} of {total:,}"
    command = f"python -m stages.verify --set verify.store={view.store.path}"
    words = f"Metadata, clocks, offsets and the features of {which} VL rows give the checksums"
    return Text(f"{words} that were written with them; `{command}` reads every byte.")


def read_sizes(path: Path) -> dict[str, int]:
    """Bytes of the blocks that the files of each array take: values, padding and trailers.

    The largest first; `metadata` are all files that are no chunk. Together they are all files below
    `path`.
    """
    sizes: dict[str, int] = defaultdict(int)
    for file in path.rglob("*"):
        if file.is_file():
            # The first two folders of a chunk's path name its array.
            owner = "/".join(file.relative_to(path).parts[:2])
            sizes[METADATA if file.name == "zarr.json" else owner] += file.stat().st_blocks * 512
    return dict(sorted(sizes.items(), key=lambda item: -item[1]))


def tabulate_sizes(path: Path, sizes: Mapping[str, int]) -> Table:
    """A row an array of the store at `path`."""
    specs, total = read_specs(path), sum(sizes.values())
    lines: list[tuple[object, ...]] = []
    for name, taken in sizes.items():
        spec, held = specs.get(name), ("", "", 0)
        if spec is not None:
            shape = " × ".join(f"{count:,}" for count in spec.shape)
            held = shape, spec.attributes.get("dtype", spec.dtype.name), spec.chunk_count
        lines.append((name, *held, taken / 2**20, 100 * taken / total))
    heads = ("array", "shape", "dtype", "chunks", "on the disk [MiB]", "share [%]")
    return Table(heads, lines, "Bytes on the disk by array.")
