"""What samples show and say -> the rows among them that differ, each prepared once."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.vlm.feature_spec import FeatureSpec, row_key
from pipeline.vlm.preparation import PreparedRow, Preparer

Frames = Mapping[str, NDArray[np.uint8] | Image.Image]
"""RGB frames (height, width, 3) of one moment by view."""


def distinct_rows(
    preparer: Preparer,
    spec: FeatureSpec,
    images: Sequence[Frames | None],
    instructions: Sequence[str],
) -> tuple[list[PreparedRow], list[int]]:
    """The distinct rows, and of each sample which of them it is; -1 where its frames are None.

    Raises `VLMError` for a view that is not the spec's and for what is not an RGB frame.
    """
    rows: dict[bytes, PreparedRow] = {}
    place: dict[bytes, int] = {}
    row_of: list[int] = []
    for given, instruction in zip(images, instructions, strict=True):
        if given is None:
            row_of.append(-1)
            continue
        frames = {view: _rgb(frame) for view, frame in given.items()}
        key = row_key(spec, preparer.render(instruction, tuple(frames)), frames)
        if key not in rows:
            place[key] = len(rows)
            rows[key] = preparer.prepare(instruction, frames)
        row_of.append(place[key])
    return list(rows.values()), row_of


def _rgb(frame: NDArray[np.uint8] | Image.Image) -> NDArray[np.uint8]:
    return np.asarray(frame.convert("RGB")) if isinstance(frame, Image.Image) else frame
