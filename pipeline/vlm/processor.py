"""What a checkpoint's processor makes of an instruction and of frames: text, tokens and pixels.

The CPU only stretches frames (Pillow), and needs no torch; `extractor` cuts them into patches where
the model is.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.base.config import VLMParams
from pipeline.base.errors import VLMError
from pipeline.vlm.checkpoint_folder import (
    read_config,
    read_json,
    resolve_checkpoint,
    tokenizer_files,
)

_QWEN_IMAGE_TOKEN_ID = 151655
"""What a Qwen2.5-VL config means when it does not say."""

_PART_OF_A_CHARACTER = "\ufffd"

TokenKind = Literal["text", "special", "image"]
"""What the model reads a token as: words, control, or a part of a picture."""


class PromptRenderer:
    """Renders one user turn of a checkpoint's chat template and splits it into tokens.

    Holds the tokenizer, no weights. May be used from several threads.
    """

    def __init__(self, folder: Path, template: str) -> None:
        """Read the tokenizer and chat template of a checkpoint folder.

        Raises `VLMError` where they are missing or do not fit the model's config.
        """
        from transformers import AutoTokenizer  # takes long: types and tokens alone do without

        config = read_config(folder)
        tokenizer_files(folder)
        try:
            self._tokenizer: Any = AutoTokenizer.from_pretrained(
                folder, local_files_only=True, trust_remote_code=False
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise VLMError(f"{folder}: the tokenizer cannot be read: {error}") from error
        self._folder = folder
        self._template = template
        self.chat_template = self._find_chat_template()
        self.image_token_id = int(config.get("image_token_id", _QWEN_IMAGE_TOKEN_ID))
        self._specials = sorted(
            set(self._tokenizer.get_added_vocab()) | set(self._tokenizer.all_special_tokens)
        )
        self._check_vocabulary(config)
        self._refuse_specials(template, "vlm.prompt")

    def render(self, instruction: str, images: int) -> str:
        """The text of one user turn with a placeholder token for each image.

        Raises `VLMError` where the instruction holds a token that the model reads as control.
        """
        self._refuse_specials(instruction, "the instruction")
        before, _, after = self._template.partition("{images}")
        content = [
            *self._text_part(before, instruction),
            *({"type": "image"} for _ in range(images)),
            *self._text_part(after, instruction),
        ]
        text: str = self._tokenizer.apply_chat_template(
            [{"role": "user", "content": content}],
            chat_template=self.chat_template,
            tokenize=False,
            add_generation_prompt=False,
        )
        shown = text.count(self._image_token)
        if shown != images:
            raise VLMError(
                f"{self._folder}: the chat template renders {shown} of {images} images as "
                f"{self._image_token}. Expected the template of a Qwen2.5-VL checkpoint."
            )
        return text

    def tokenize(self, text: str) -> list[int]:
        """The token ids of a rendered prompt, one for each image still."""
        # The Rust tokenizer itself: the Python wrapper around it is not safe among threads.
        encoding = self._tokenizer.backend_tokenizer.encode(text, add_special_tokens=False)
        return encoding.ids

    def describe(self, token: int) -> tuple[str, TokenKind]:
        """The text of a token and its kind; a part of a character as the vocabulary spells it."""
        text: str = self._tokenizer.decode([token], clean_up_tokenization_spaces=False)
        if _PART_OF_A_CHARACTER in text:
            text = self._tokenizer.convert_ids_to_tokens(token)
        if token == self.image_token_id:
            return text, "image"
        return text, "special" if text in self._specials else "text"

    def _text_part(self, part: str, instruction: str) -> list[dict[str, str]]:
        text = part.replace("{instruction}", instruction)
        return [{"type": "text", "text": text}] if text else []

    def _refuse_specials(self, text: str, what: str) -> None:
        for token in self._specials:
            if token in text:
                raise VLMError(
                    f"{what} holds {token!r}, which the model reads as a control token, "
                    f"in {text!r:.200}. Remove it from the recording, data.sources or params."
                )

    def _check_vocabulary(self, config: dict[str, Any]) -> None:
        self._image_token: str = self._tokenizer.convert_ids_to_tokens(self.image_token_id)
        rows = int(config.get("text_config", config).get("vocab_size", 0))
        if self._image_token not in self._specials or len(self._tokenizer) > rows:
            raise VLMError(
                f"{self._folder}: the tokenizer is another checkpoint's: it reads config.json's "
                f"image_token_id {self.image_token_id} as {self._image_token!r}, and has "
                f"{len(self._tokenizer)} tokens of a vocabulary of {rows}"
            )

    def _find_chat_template(self) -> str:
        template, beside = self._tokenizer.chat_template, self._folder / "chat_template.json"
        if not isinstance(template, str) and beside.exists():
            template = read_json(beside).get("chat_template")
        if not isinstance(template, str):
            raise VLMError(
                f"{self._folder}: no chat template in tokenizer_config.json, chat_template.jinja "
                "or chat_template.json. Take the file from the checkpoint's hub page."
            )
        return template


@dataclass(frozen=True)
class PixelSettings:
    """What a checkpoint's image processor does, and the one size that frames are stretched to."""

    resize: tuple[int, int]
    """Height and width asked for."""
    image_size: tuple[int, int]
    """Height and width that the processor makes of it: multiples of patch size x merge size."""
    patch_size: int
    merge_size: int
    temporal_patch_size: int
    rescale_factor: float
    image_mean: tuple[float, ...]
    image_std: tuple[float, ...]

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patches."""
        return self.image_size[0] // self.patch_size, self.image_size[1] // self.patch_size

    @property
    def merged_grid(self) -> tuple[int, int]:
        """Rows and columns of image tokens."""
        return self.grid[0] // self.merge_size, self.grid[1] // self.merge_size

    def document(self) -> dict[str, Any]:
        """The settings as JSON-able values."""
        fields = asdict(self) | {"resample": "bicubic"}
        return {key: list(v) if isinstance(v, tuple) else v for key, v in fields.items()}

    @classmethod
    def of(cls, vlm: VLMParams) -> "PixelSettings":
        """Those of the checkpoint of `vlm` for frames of the size that it asks for."""
        folder = resolve_checkpoint(vlm.checkpoint, vlm.revision)
        return cls.read(folder, (vlm.image_resize_height, vlm.image_resize_width))

    @classmethod
    def read(cls, folder: Path, resize: tuple[int, int]) -> "PixelSettings":
        """The settings of a checkpoint folder for frames asked for at `resize` (height, width)."""
        from transformers import AutoImageProcessor
        from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import smart_resize

        config = folder / "preprocessor_config.json"
        try:
            processor: Any = AutoImageProcessor.from_pretrained(
                folder, local_files_only=True, trust_remote_code=False
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise VLMError(f"{config}: missing or cannot be read: {error}") from error
        kind = type(processor).__name__
        steps = (processor.do_resize, processor.do_rescale, processor.do_normalize)
        if not kind.startswith("Qwen2VLImageProcessor") or not all(steps):
            raise VLMError(
                f"{config}: expected a Qwen2VLImageProcessor with do_resize, do_rescale and "
                f"do_normalize, as in every Qwen2.5-VL, found a {kind} with {steps}"
            )
        try:
            image_size = smart_resize(
                *resize,
                factor=processor.patch_size * processor.merge_size,
                min_pixels=processor.size["shortest_edge"],
                max_pixels=processor.size["longest_edge"],
            )
        except ValueError as error:
            raise VLMError(
                f"vlm.image_resize_height and _width {resize[0]} x {resize[1]}: {error}"
            ) from error
        same = ("patch_size", "merge_size", "temporal_patch_size", "rescale_factor")
        return cls(
            resize=resize,
            image_size=image_size,
            image_mean=tuple(processor.image_mean),
            image_std=tuple(processor.image_std),
            **{name: getattr(processor, name) for name in same},
        )


def stretch(frame: NDArray[np.uint8], image_size: tuple[int, int]) -> NDArray[np.uint8]:
    """The frame (height, width, 3) RGB at `image_size`, by one antialiased bicubic stretch."""
    height, width = image_size
    if frame.shape[:2] == image_size:
        return np.ascontiguousarray(frame)
    image = Image.fromarray(frame).resize((width, height), Image.Resampling.BICUBIC)
    return np.asarray(image)
