"""The prompt of a VL row as the model gets it, token by token."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from pipeline.base.config import VLMParams
from pipeline.base.errors import RecordingError
from pipeline.look.recording.facts import EpisodeView, PromptToken, PromptView
from pipeline.vlm.feature_spec import FeatureSpec
from pipeline.vlm.preparation import PreparedRow, Preparer


def view_prompt(view: EpisodeView, vlm: VLMParams, spec: FeatureSpec) -> PromptView:
    """The prompt of the episode's first VL row.

    Loads the checkpoint's tokenizer and settings, no weight. Raises `VLMError` where the checkpoint
    is not there or the instruction holds a control token, and `RecordingError` where the episode
    has no tick, no instruction or a frame that cannot be decoded.
    """
    preparer = Preparer(vlm, spec)
    prepared = preparer.prepare(_instruction(view), _first_frames(view))
    tokens = _tokens(prepared, preparer)
    return PromptView(
        instruction=_instruction(view),
        text=prepared.prompt,
        tokens=tokens,
        image_tokens=dict(Counter(one.view for one in tokens if one.view is not None)),
        special=dict(Counter(one.text for one in tokens if one.kind != "text")),
        pixels=spec.image_size,
    )


def _tokens(prepared: PreparedRow, preparer: Preparer) -> tuple[PromptToken, ...]:
    layout = prepared.layout
    size = layout.grid[0] * layout.grid[1]
    views = {
        place: view for view, start in layout.image_starts for place in range(start, start + size)
    }
    ids: list[int] = prepared.token_ids.tolist()
    described = {token: preparer.describe(token) for token in set(ids)}
    return tuple(
        PromptToken(token, *described[token], views.get(place)) for place, token in enumerate(ids)
    )


def _instruction(view: EpisodeView) -> str:
    if view.instruction is None:
        raise RecordingError(
            f"{view.recording.path}: its instruction cannot be read, so there is no prompt; give "
            f"source {view.recording.source!r} an `instruction`"
        )
    return view.instruction


def _first_frames(view: EpisodeView) -> dict[str, NDArray[np.uint8]]:
    if view.timeline is None:
        raise RecordingError(f"{view.recording.path}: has no tick, so there is no prompt")
    return {
        name: next(iter(camera.read([int(view.timeline.frames[name][0])])))
        for name, camera in view.cameras.items()
    }
