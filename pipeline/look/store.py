"""A store's page: coverage, reuse and health of its features, and what it was made of.

Recordings have a page of their own; this page shows what only a store has. The store is never
changed, and little memory is used: only arrays of a few bytes for each tick or VL row are read
whole; of the features, one slot of `inspect.points` VL rows is read at a time.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from pipeline.base.arrays import non_finite, widen
from pipeline.base.channels import named
from pipeline.base.config import InspectParams, setting
from pipeline.base.errors import Issue, Severity, StoreIncomplete
from pipeline.base.printed_commands import command
from pipeline.base.text import Table, counted, duration, size
from pipeline.look.page.blocks import (
    Block,
    Issues,
    Outline,
    Report,
    Section,
    Text,
    next_steps,
)
from pipeline.store import FEATURES, KEY_BYTES, Episode, FeatureStore, check_trailers
from pipeline.store.documents import extract_command
from pipeline.store.gather import WIDE
from pipeline.store.proofs import storage_note
from pipeline.vlm.slots import slot_name

NOTHING = "Nothing looks wrong: every check passed."
EPISODES = 100
"""The most episodes in the table; if there are more, it has the first."""
DEAD = 1e-3
"""A slot is dead if the spread of its numbers is below this share of their size."""
_TINY = 1e-30


@dataclass(frozen=True)
class Coverage:
    """One episode: how long it is, and which streams its ticks see."""

    episode: Episode
    seconds: float
    """From the first tick to the last."""
    covered: Mapping[str, float]
    """`sensor`, `state`, and each view -> share of the episode's ticks that see it, 0 to 1."""

    def issue(self, kind: str, stream: str, message: str, severity: Severity = "warning") -> Issue:
        """An issue of this episode."""
        return Issue(
            severity=severity, kind=kind, message=message,
            source=self.episode.source, episode=self.episode.id, stream=stream,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class FeatureHealth:
    """Whether the features of some VL rows vary and are finite, by slot; of plain frames only."""

    rows: NDArray[np.int64]
    """(row,) ascending, in the store."""
    names: tuple[str, ...]
    """(slot,) the names of the slots."""
    variation: NDArray[np.float64]
    """(slot,) the median over its numbers of standard deviation / root mean square: 0 = dead."""
    broken: NDArray[np.bool_]
    """(row, slot) valid, but NaN or infinite."""


@dataclass(frozen=True, eq=False)
class StoreView:
    """A store and everything that its page shows."""

    store: FeatureStore
    episodes: tuple[Coverage, ...]
    ages: Mapping[str, NDArray[np.float32]]
    """`newest frame` and each view -> (tick,) s since its frame was captured; NaN without one."""
    distinct_rows: int
    """VL rows that differ in their frames, prompt or feature spec."""
    features: FeatureHealth
    bytes: int
    """Size on the disk."""
    issues: tuple[Issue, ...]
    """An issue without an episode is about the whole store."""


def inspect_store(path: str | Path, params: InspectParams) -> StoreView:
    """Everything that the page shows of a finished store.

    Checks the checksums of metadata and of every narrow array, and looks at the features of
    `params.points` VL rows; stages.verify checks the rest. Raises `StoreIncomplete` where the store
    is not there, unfinished, damaged or without an episode, `StoreMismatch` where it is an archive
    or follows another schema; each says what to run.
    """
    store = FeatureStore.open(path)
    check_trailers(store.path, but=tuple(WIDE.values()))
    if not (total := len(store.array("vl/time"))):
        raise StoreIncomplete(f"{path}: has no VL row. Run {extract_command(store.path)}.")
    count = min(total, params.points)
    rows = np.arange(count, dtype=np.int64) * total // count
    episodes = tuple(read_coverage(store, episode) for episode in store.episodes)
    ages, health = read_ages(store), measure_features(store, rows)
    keys = np.ascontiguousarray(store.array("vl/key")).view(f"V{KEY_BYTES}").ravel()
    issues = (
        *find_coverage_issues(episodes),
        *find_feature_issues(health, episodes),
    )
    files = (file.stat() for file in store.path.rglob("*") if file.is_file())
    taken = sum(status.st_blocks * 512 for status in files)
    return StoreView(store, episodes, ages, len(np.unique(keys)), health, taken, issues)


def store_report(view: StoreView) -> Report:
    """The page of a store; the same store gives the same page."""
    store, episodes = view.store, view.episodes
    rate = "as recorded" if store.action_hz is None else f"at {store.action_hz:g} Hz"
    reuse = store.vlm_reuse_count
    often = "each of them" if reuse == 1 else f"one in {reuse}"
    total, note = len(store.array("vl/time")), storage_note(store.attrs)
    return Report(
        title=f"Store: {store.path.name}",
        verdict=(
            f"{counted(len(view.issues), 'finding')} to look at before training"
            if view.issues
            else "Ready to train on: nothing looks wrong"
        ),
        summary=(
            f"Ticks {rate}, features of the model (a VL row) at {often}; feature spec "
            f"`{store.spec['digest']}`."
        ),
        tiles=[
            ("episodes", f"{len(episodes):,}"),
            ("length", duration(sum(episode.seconds for episode in episodes))),
            ("ticks", f"{store.ticks:,}"),
            ("VL rows", f"{total:,}"),
            ("on the disk", size(view.bytes)),
            ("findings", f"{len(view.issues):,}"),
        ],
        sections=(
            Section("What looks wrong", [Issues(view.issues, NOTHING), _checked(view, total)]),
            Section("Coverage", [_source_table(episodes), _episode_table(episodes)]),
            Section("Reuse of the features", _reuse_blocks(view, total)),
            Section(
                "What it was made of",
                [
                    *([Text(f"Its {note}.")] if note else []),
                    Outline("Feature spec", store.spec),
                    Outline(
                        "Computed with", {"environments of VL rows": store.attrs["environment"]}
                    ),
                ],
            ),
            next_steps(
                "Look at each finding above; `vla-cache verify` reads every row."
                * bool(view.issues),
                "`vla-cache probe` says which layers and poolings predict the action.",
                "`vla-cache train_head` trains a policy, `vla-cache evaluate` judges it.",
            ),
        ),
    )


def _checked(view: StoreView, total: int) -> Text:
    verify = command("verify", setting("verify.store", view.store.path))
    return Text(
        "Metadata, clocks and offsets give the checksums that were written with them. Looked at: "
        f"the features of {len(view.features.rows):,} of {total:,} VL rows (`inspect.points`), "
        f"plain frames only; `{verify}` reads every byte."
    )


def read_coverage(store: FeatureStore, episode: Episode) -> Coverage:
    """Which streams and views the ticks of an episode see."""
    ticks = slice(episode.ticks.start, episode.ticks.stop)
    time = store.array("tick/time")[ticks]
    seen = {
        "sensor": store.array("tick/sensor_end")[ticks] > episode.readings.start,
        "state": store.array("tick/state_end")[ticks] > episode.states.start,
    }
    shown = np.isfinite(store.array("vl/frame_time")[store.array("tick/vl_row")[ticks]])
    seen |= dict(zip(store.streams["views"], shown.T, strict=True))
    if not len(time):
        return Coverage(episode, 0.0, dict.fromkeys(seen, 0.0))
    covered = {name: float(there.mean()) for name, there in seen.items()}
    return Coverage(episode, float(np.ptp(time)), covered)


def _source_table(episodes: Sequence[Coverage]) -> Table:
    """A row for each source."""
    parts: dict[str, list[Coverage]] = defaultdict(list)
    for part in episodes:
        parts[part.episode.source].append(part)
    rows: list[tuple[object, ...]] = []
    for name, part in parts.items():
        own = [coverage.episode for coverage in part]
        seconds = round(sum(coverage.seconds for coverage in part), 1)
        kinds = ("ticks", "vl_rows", "readings", "states")
        counts = [sum(len(getattr(episode, kind)) for episode in own) for kind in kinds]
        formats = ", ".join(sorted({episode.format for episode in own}))
        instructions = len({episode.instruction for episode in own})
        rows.append((name, formats, instructions, len(own), seconds, *counts))
    heads = ("source", "format", "instructions", "episodes", "length [s]", "ticks", "VL rows")
    return Table((*heads, "sensor readings", "state readings"), rows)


def _episode_table(episodes: Sequence[Coverage]) -> Table:
    """A row for each episode."""
    caption = "Ticks see all streams and views, none of one (no …), or one in a share of them."
    if len(episodes) > EPISODES:
        caption += f" The first {EPISODES} of {len(episodes)} episodes."
    heads = ("source", "episode", "instruction", "ticks", "length [s]", "VL rows", "ticks see")
    rows: list[tuple[object, ...]] = []
    for part in episodes[:EPISODES]:
        own = part.episode
        counts = len(own.ticks), round(part.seconds, 2), len(own.vl_rows)
        lacking = [
            # A partial share is never rounded to all or none.
            f"{min(max(share, 0.01), 0.99):.0%} {name}" if share else f"no {name}"
            for name, share in part.covered.items()
            if share < 1
        ]
        rows.append((own.source, own.id, own.instruction, *counts, ", ".join(lacking) or "all"))
    return Table(heads, rows, caption)


def find_coverage_issues(episodes: Sequence[Coverage]) -> Iterator[Issue]:
    """Streams and views that an episode lacks and others have, and missing instructions."""
    there = {name for part in episodes for name, share in part.covered.items() if share}
    for part in episodes:
        # An episode without a tick has no stream to miss.
        for name, share in part.covered.items() if len(part.episode.ticks) else ():
            stream = name if name in ("sensor", "state") else f"view {name}"
            if name in there and not share:
                yield part.issue("missing", stream, "no tick sees it; other episodes have it")
            elif 0 < share < 1:
                yield part.issue("partly missing", stream, f"only {share:.0%} of the ticks see it")
        if not part.episode.instruction.strip():
            message = "the prompt names no task; set `instruction` of its data source"
            yield part.issue("no instruction", "instruction", message)


def read_ages(store: FeatureStore) -> dict[str, NDArray[np.float32]]:
    """`newest frame` and each view -> (tick,) age in s: the tick's time minus the frame's."""
    shown = store.array("vl/frame_time")[store.array("tick/vl_row")]
    ages = (store.array("tick/time")[:, None] - shown).astype(np.float32)
    newest = store.feature_age(np.arange(store.ticks)).astype(np.float32)
    return {"newest frame": newest} | dict(zip(store.streams["views"], ages.T, strict=True))


def _reuse_blocks(view: StoreView, total: int) -> list[Block]:
    """Ages of the features, and how many rows occur twice."""
    rows = [
        (name, *np.nanquantile(age, (0.01, 0.5, 0.99, 1.0)).tolist())
        for name, age in view.ages.items()
        if np.isfinite(age).any()
    ]
    variants = view.store.variants
    augmented = f" Each is there {variants} times: plain and augmented." if variants > 1 else ""
    return [
        Text("The policy is given the age of the newest frame as `feature_age`."),
        Table(("age [s] of", "1 %", "median", "99 %", "oldest"), rows),
        Text(
            f"{view.distinct_rows:,} of {total:,} VL rows differ in their frames or prompt."
            f"{augmented}"
        ),
    ]


def measure_features(store: FeatureStore, rows: NDArray[np.int64]) -> FeatureHealth:
    """Variation and finiteness of these rows, slot after slot."""
    slots = store.feature_shape[0]
    variation = np.full(slots, np.nan)
    broken = np.zeros((len(rows), slots), np.bool_)
    for slot in tqdm(range(slots), desc="look at features", unit="slot", disable=None):
        values = widen(store.array(FEATURES)[rows, slot]).astype(np.float32, copy=False)
        valid = store.array("vl/slot_valid")[rows, slot] != 0
        broken[:, slot] = valid & non_finite(values).any(axis=1)
        variation[slot] = _variation(values[valid & ~broken[:, slot]])
    # Variants repeat the names.
    names = tuple(slot_name(document) for document in store.attrs["slots"][:slots])
    return FeatureHealth(rows, names, variation, broken)


def _variation(values: NDArray[np.float32]) -> float:
    """The median over numbers of spread / size, so huge constant numbers do not hide the others."""
    if len(values) < 2:
        return np.nan
    spread = values.std(axis=0, dtype=np.float64)
    size = np.sqrt(spread**2 + values.mean(axis=0, dtype=np.float64) ** 2)
    return float(np.median(spread / np.maximum(size, _TINY)))


def find_feature_issues(health: FeatureHealth, episodes: Sequence[Coverage]) -> Iterator[Issue]:
    """Dead slots, and features that are not finite."""
    if dead := np.flatnonzero(health.variation < DEAD).tolist():
        message = f"{named(health.names, dead)}: the same in all VL rows looked at"
        yield Issue(severity="warning", kind="dead slot", message=message, stream=FEATURES)
    for part in episodes:
        rows = part.episode.vl_rows
        own = health.broken[(rows.start <= health.rows) & (health.rows < rows.stop)]
        if len(row := np.nonzero(own)[0]):
            slot = own[row[0]].argmax()
            message = f"{len(np.unique(row))} VL row(s) are NaN or infinite, the first in slot "
            message += f"{health.names[slot]}; training refuses them: extract them anew"
            yield part.issue("not finite", FEATURES, message, severity="error")
