"""Check a whole store: metadata, files, the checksum of every row."""

import time
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.errors import StoreIncomplete
from pipeline.base.text import capped, size
from pipeline.store.chunks import UNSEALED, check_metadata, damages
from pipeline.store.documents import StoreAttributes, mend
from pipeline.store.paths import find_attributes, read_plan
from pipeline.store.reader import FeatureStore
from pipeline.store.schema import ARRAY_NAMES, FEATURES, ArraySpec, check_agreement, read_spec


@dataclass(frozen=True)
class Verification:
    """What was checked in a store, and everything that is wrong with it.

    `rows` counts the feature rows; `bytes` those of chunk files, with padding. Each of `issues`
    names a file and what is wrong with it.
    """

    store: Path
    rows: int
    bytes: int
    seconds: float
    issues: tuple[str, ...]

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.issues

    def lines(self) -> list[str]:
        """For people: everything that is wrong; a long list is cut."""
        return capped(list(self.issues), "faults")

    def summary(self) -> str:
        """For people: how much was checked, and how fast."""
        return (
            f"{self.store}: checked {self.rows} feature rows, {size(self.bytes)} of files, in "
            f"{self.seconds:.1f} s ({self.bytes / 1e9 / max(self.seconds, 1e-9):.2f} GB/s)"
        )


def verify(path: Path) -> Verification:
    """Everything that is wrong with a finished store, which is only read.

    Raises `StoreIncomplete` where there is no finished store, or one that lost its plan, and
    `StoreMismatch` where it is an archive or of another schema.
    """
    begun, issues, specs, seal = time.monotonic(), list[str](), dict[str, ArraySpec](), None
    attributes = find_attributes(path)
    read_plan(path)  # without a plan, nothing in the store can be kept

    def note(error: StoreIncomplete) -> None:
        issues.append(str(error).removesuffix(f". {mend(path)}"))

    for name in ARRAY_NAMES:
        try:
            specs[name] = read_spec(path, name)
        except StoreIncomplete as error:
            note(error)
    try:
        parsed = StoreAttributes.of(path, attributes)
        seal = parsed.seal
        if seal is None:
            issues.append(f"{path / 'zarr.json'}: {UNSEALED}")
        if not issues:
            check_metadata(path)
            check_agreement(path, parsed, specs)
    except StoreIncomplete as error:
        note(error)
    issues += [f"{file}: {what}" for file, what in damages(path, specs.values(), seal)]
    if not issues:
        try:
            store = FeatureStore.open(path)
            store.array("tick/vl_row")  # checks the positions that ticks hold
            _ = store.episodes, store.golden
        except StoreIncomplete as error:
            note(error)
    return Verification(
        store=path,
        rows=specs[FEATURES].shape[0] if FEATURES in specs else 0,
        bytes=sum(spec.chunk_count * spec.chunk_bytes for spec in specs.values()),
        seconds=time.monotonic() - begun,
        issues=tuple(issues),
    )
