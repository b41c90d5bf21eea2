"""The prompt of a VL row as the model gets it, token by token."""

from collections import Counter
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.config import VLMParams
from pipeline.errors import RecordingError
from pipeline.inspection.facts import EpisodeView, PromptToken, PromptView
from pipeline.vlm.checkpoint_folder import resolve_checkpoint
from pipeline.vlm.feature_spec import FeatureSpec
from pipeline.vlm.preparation import PreparedRow, Preparer
from pipeline.vlm.prompt import PromptRenderer

_PART_OF_A_CHARACTER = "\ufffd"


class _TokenReader(PromptRenderer):
    """Also reads tokens back."""

    def texts(self, ids: Sequence[int]) -> list[str]:
        """The text of each token; one that is a part of a character as the vocabulary spells it."""
        return [self._text(one) for one in ids]

    def kind(self, token: int, text: str) -> Literal["text", "special", "image"]:
        """Whether the model reads a token as words, as control, or as a part of a picture."""
        if token == self.image_token_id:
            return "image"
        return "special" if text in self._specials else "text"

    def _text(self, token: int) -> str:
        text: str = self._tokenizer.decode([token], clean_up_tokenization_spaces=False)
        return (
            self._tokenizer.convert_ids_to_tokens(token) if _PART_OF_A_CHARACTER in text else text
        )


def view_prompt(view: EpisodeView, vlm: VLMParams, spec: FeatureSpec) -> PromptView:
    """The prompt of the episode's first VL row.

    Loads the checkpoint's tokenizer and settings, no weight. Raises `VLMError` where the checkpoint
    is not there or the instruction holds a control token, and `RecordingError` where the episode
    has no tick, no instruction or a frame that cannot be decoded.
    """
    prepared = Preparer(vlm, spec).prepare(_instruction(view), _first_frames(view))
    reader = _TokenReader(resolve_checkpoint(vlm.checkpoint, vlm.revision), vlm.prompt)
    tokens = _tokens(prepared, reader)
    return PromptView(
        instruction=_instruction(view),
        text=prepared.prompt,
        tokens=tokens,
        image_tokens=dict(Counter(one.view for one in tokens if one.view is not None)),
        special=dict(Counter(one.text for one in tokens if one.kind != "text")),
        pixels=spec.image_size,
    )


def _tokens(prepared: PreparedRow, reader: _TokenReader) -> tuple[PromptToken, ...]:
    layout = prepared.layout
    size = layout.grid[0] * layout.grid[1]
    views = {
        place: view for view, start in layout.image_starts for place in range(start, start + size)
    }
    ids: list[int] = prepared.token_ids.tolist()
    named = dict(zip(distinct := sorted(set(ids)), reader.texts(distinct), strict=True))
    return tuple(
        PromptToken(token, named[token], reader.kind(token, named[token]), views.get(place))
        for place, token in enumerate(ids)
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
