"""Golden rows: a few rows whose decoded frames are kept beside their features.

With them the features can be computed again, on another machine and without a recording.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MOST_GOLDEN = 4
"""Most golden rows in a store."""

Frames = Mapping[str, NDArray[np.uint8]]
"""View -> (height, width, 3) RGB as decoded, before any resize; without missing views."""


@dataclass(frozen=True, eq=False)
class GoldenRow:
    """A VL row with all inputs of its features, and the stored features."""

    key: bytes
    """`row_key` of its feature spec, prompt and frames."""
    instruction: str
    prompt: str
    """The rendered prompt."""
    frames: Frames
    features: NDArray[np.float32]
    """(slot, dim), of the plain frames."""
    slot_valid: NDArray[np.bool_]
    """(slot,)"""


def row_key(spec_digest: str, views: Sequence[str], prompt: str, frames: Frames) -> bytes:
    """16 bytes that differ for every other spec, rendered prompt or frames in view order."""
    digest = hashlib.blake2b(digest_size=16)
    for text in (spec_digest, prompt):
        _add(digest, text.encode())
    for view in views:
        if view in frames:
            frame = np.ascontiguousarray(frames[view])
            _add(digest, f"{view} {frame.shape} {frame.dtype}".encode())
            digest.update(frame.data)
    return digest.digest()


def spread(rows: NDArray[np.int64], views: NDArray[np.int64]) -> NDArray[np.int64]:
    """At most `MOST_GOLDEN` of these rows, evenly spread over those with the most views.

    `views` (row,) is the number of views of each row.
    """
    full = rows[views == views.max(initial=0)]
    places = np.linspace(0, max(0, len(full) - 1), min(MOST_GOLDEN, len(full)))
    return full[np.unique(places.round().astype(np.int64))]


def _add(digest: "hashlib.blake2b", part: bytes) -> None:
    # The length comes first, so that a character moved to the next part changes the key.
    digest.update(len(part).to_bytes(8, "little"))
    digest.update(part)
