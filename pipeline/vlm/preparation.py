"""An instruction and frames -> a row ready for the model, on the CPU, without its weights."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.base.config import VLMParams
from pipeline.base.documents import shown
from pipeline.base.errors import VLMError
from pipeline.vlm.augmentation import Augmentation
from pipeline.vlm.checkpoint_folder import resolve_checkpoint
from pipeline.vlm.feature_spec import FeatureSpec
from pipeline.vlm.processor import PROMPTS, PixelSettings, PromptRenderer, TokenKind, stretch

FramesByView = Mapping[str, NDArray[np.uint8] | Image.Image]
"""View -> RGB frame (height, width, 3), all of one moment."""


@dataclass(frozen=True)
class TokenLayout:
    """Where the images are among a row's tokens; rows of equal layout need no padding."""

    length: int
    """Number of tokens."""
    image_starts: tuple[tuple[str, int], ...]
    """Each present view, in order, and the index of its first image token."""
    grid: tuple[int, int]
    """Rows and columns of image tokens of each view, row-major in the sequence."""

    def image_tokens(self) -> NDArray[np.int64]:
        """Indices (image x token,) of the image tokens, view after view."""
        size = self.grid[0] * self.grid[1]
        starts = np.array([start for _, start in self.image_starts], np.int64)
        return (starts[:, None] + np.arange(size)).reshape(-1)


@dataclass(frozen=True, eq=False)
class PreparedRow:
    """One row ready for the encoder; small enough to wait in a queue."""

    prompt: str
    """The rendered prompt, with one placeholder per image."""
    token_ids: NDArray[np.int64]
    """(token,), each placeholder expanded to one token per merged patch."""
    pixels: NDArray[np.uint8]
    """(image, height, width, 3) RGB at the spec's image size, views in order."""
    layout: TokenLayout


class Preparer:
    """Makes `PreparedRow`s; several threads may use it (the resize releases the GIL)."""

    def __init__(self, vlm: VLMParams, spec: FeatureSpec) -> None:
        """Read the checkpoint's tokenizer and processor settings."""
        folder = resolve_checkpoint(vlm.checkpoint, vlm.revision)
        self._spec = spec
        self._augmentation = vlm.augmentation
        self._renderer = PromptRenderer(folder, vlm.prompt)
        self._settings = PixelSettings.of(vlm)
        # Cached, because an episode repeats its instruction in every row.
        self._rendered = lru_cache(maxsize=4096)(self._renderer.render)
        self._tokens = lru_cache(maxsize=4096)(self._expanded_tokens)

    def render(self, instruction: str, views_present: Sequence[str]) -> str:
        """The prompt of a row that has these views.

        Raises `VLMError` where the instruction contains a control token, or the spec lacks a view.
        """
        prompt = self._rendered(instruction, len(self._ordered(views_present)))
        self._tokens(prompt)  # refuses a prompt that is too long
        return prompt

    def describe(self, token: int) -> tuple[str, TokenKind]:
        """The text of a token of a row and its kind."""
        return self._renderer.describe(token)

    def prepare(self, instruction: str, frames: Mapping[str, NDArray[np.uint8]]) -> PreparedRow:
        """The row of an instruction and its frames (height, width, 3) RGB by view.

        A view of the spec that is not in `frames` is left out of the prompt.
        """
        views = self._ordered(frames)
        prompt = self.render(instruction, views)
        token_ids, starts = self._tokens(prompt)
        size = self._settings.image_size
        pixels = np.empty((len(views), *size, 3), np.uint8)
        for place, view in zip(pixels, views, strict=True):
            place[:] = stretch(_checked(frames[view], view), size)
        layout = TokenLayout(
            len(token_ids), tuple(zip(views, starts, strict=True)), self._settings.merged_grid
        )
        return PreparedRow(prompt, token_ids, pixels, layout)

    def prepare_distinct(
        self, images: Sequence[FramesByView | None], instructions: Sequence[str]
    ) -> tuple[list[PreparedRow], list[int]]:
        """The distinct rows of these samples, and the index of each sample's row.

        The index is -1 for a sample whose frames are None. Raises `VLMError` for a view that the
        spec lacks and for a frame that is not RGB.
        """
        rows: list[PreparedRow] = []
        place: dict[bytes, int] = {}
        row_of: list[int] = []
        for given, instruction in zip(images, instructions, strict=True):
            if given is None:
                row_of.append(-1)
                continue
            frames = {view: _as_array(frame) for view, frame in given.items()}
            key = self._spec.row_key(self.render(instruction, tuple(frames)), frames)
            if key not in place:
                place[key] = len(rows)
                rows.append(self.prepare(instruction, frames))
            row_of.append(place[key])
        return rows, row_of

    def prepare_variants(
        self, instruction: str, frames: Mapping[str, NDArray[np.uint8]], key: bytes
    ) -> tuple[PreparedRow, ...]:
        """The row in each variant of the spec: 0 is plain, as from `prepare`, the others augmented.

        The augmentation depends only on its params, the row's `key`, view and variant. All variants
        have the same layout.
        """
        plain = self.prepare(instruction, frames)
        rows, (height, width) = [plain], self._settings.image_size
        for variant in range(1, self._spec.variants):
            pixels = np.empty_like(plain.pixels)
            for place, image, (view, _) in zip(
                pixels, plain.pixels, plain.layout.image_starts, strict=True
            ):
                # Augmented at the model's size, where images are smallest.
                widened = (width / frames[view].shape[1]) / (height / frames[view].shape[0])
                drawn = Augmentation.drawn(self._augmentation, key, view, variant)
                place[:] = drawn.apply(image, widened)
            rows.append(replace(plain, pixels=pixels))
        return tuple(rows)

    def _ordered(self, views: Sequence[str] | Mapping[str, object]) -> tuple[str, ...]:
        unknown = sorted(set(views) - set(self._spec.views))
        if unknown:
            raise VLMError(
                f"view {', '.join(unknown)} is not in the feature spec, which has "
                f"{', '.join(self._spec.views)}"
            )
        return tuple(view for view in self._spec.views if view in views)

    def _expanded_tokens(self, prompt: str) -> tuple[NDArray[np.int64], tuple[int, ...]]:
        """Token ids with each image's placeholder repeated, and each image's first index."""
        ids = np.array(self._renderer.tokenize(prompt), np.int64)
        is_image = ids == self._renderer.image_token_id
        rows, columns = self._settings.merged_grid
        counts = np.where(is_image, rows * columns, 1)
        if (length := int(counts.sum())) > self._renderer.window:
            why = (
                f"expected at most {self._renderer.window:,} tokens (max_position_embeddings), "
                f"found {length:,}, {rows * columns:,} for each image"
            )
            raise PROMPTS.refusal(shown(prompt), why)
        starts = (np.cumsum(counts) - counts)[is_image]
        token_ids = np.repeat(ids, counts)
        token_ids.flags.writeable = False
        return token_ids, tuple(starts.tolist())


def _as_array(frame: NDArray[np.uint8] | Image.Image) -> NDArray[np.uint8]:
    return np.asarray(frame.convert("RGB")) if isinstance(frame, Image.Image) else frame


def _checked(frame: NDArray[np.uint8], view: str) -> NDArray[np.uint8]:
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise VLMError(
            f"{view}: expected a frame (height, width, 3) of uint8 RGB, found shape "
            f"{frame.shape} of {frame.dtype}"
        )
    return frame
