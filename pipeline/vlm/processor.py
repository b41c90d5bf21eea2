"""A checkpoint's processor: it turns an instruction and frames into text, tokens and pixels.

The CPU only stretches frames (Pillow), without torch; `qwen` cuts them into patches on the
model's device.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import ConfigDict, Field, JsonValue

from pipeline.base.config import VLMParams
from pipeline.base.documents import Border, Document, shown
from pipeline.base.errors import VLMError
from pipeline.vlm.checkpoint_folder import (
    VLMS,
    read_config,
    resolve_checkpoint,
    tokenizer_files,
)

PROMPTS = Border(
    VLMError,
    "Change the instruction in the recording, data.sources or vlm.prompt; fewer data.views and "
    "smaller images make a prompt shorter, too.",
)
_PART_OF_A_CHARACTER = "\ufffd"

_TOKENIZERS = r"^(Qwen2Tokenizer(Fast)?|PreTrainedTokenizerFast|TokenizersBackend)$"

TokenKind = Literal["text", "special", "image"]
"""What a token is for the model: words, control, or a part of an image."""


class _TokenizerConfig(Document):
    tokenizer_class: Annotated[str, Field(pattern=_TOKENIZERS)] | None = None
    fast_tokenizer_files: None = None
    """Files, at any path, that would be read instead of tokenizer.json."""


class PromptRenderer:
    """Renders one user turn of a checkpoint's chat template and splits it into tokens.

    It holds the tokenizer and no weights. Several threads may use it.
    """

    def __init__(self, folder: Path, template: str) -> None:
        """Read the tokenizer and chat template of a checkpoint folder.

        Raises `VLMError` where they are missing or do not fit the model's config.
        """
        from transformers import AutoTokenizer  # slow to import; types and tokens need none

        config = read_config(folder)
        tokenizer_files(folder)
        if (path := folder / "tokenizer_config.json").exists():
            VLMS.read_json(path, _TokenizerConfig)
        what = "its config.json, tokenizer.json or tokenizer_config.json cannot be read"
        with VLMS.foreign(folder, what):
            self._tokenizer: Any = AutoTokenizer.from_pretrained(
                folder, local_files_only=True, trust_remote_code=False
            )
            added = {*self._tokenizer.get_added_vocab(), *self._tokenizer.all_special_tokens}
            self._specials = sorted(filter(None, added))
            self._image_token = self._tokenizer.convert_ids_to_tokens(config.image_token_id)
        self._folder = folder
        self._template = template
        self.chat_template = self._find_chat_template()
        self.image_token_id = config.image_token_id
        self.window = config.text_config.max_position_embeddings
        self._check_vocabulary(config.text_config.vocab_size)
        self._refuse_specials(template, "vlm.prompt")

    def render(self, instruction: str, images: int) -> str:
        """The text of one user turn with a placeholder token for each image.

        Raises `VLMError` where the instruction contains a control token.
        """
        self._refuse_specials(instruction, "the instruction")
        text = self._rendered(instruction, images)
        rendered = text.count(self._image_token)
        if rendered != images:
            why = f"the chat template renders {rendered} of {images} images as {self._image_token}"
            raise VLMS.refusal(self._folder, why)
        return text

    def tokenize(self, text: str) -> list[int]:
        """The token ids of a rendered prompt, still with one per image."""
        # The Rust tokenizer itself, because its Python wrapper is not thread-safe.
        with PROMPTS.foreign(shown(text), "cannot be cut into tokens"):
            return self._tokenizer.backend_tokenizer.encode(text, add_special_tokens=False).ids

    def describe(self, token: int) -> tuple[str, TokenKind]:
        """The text of a token (for a part of a character, its vocabulary entry) and its kind."""
        text: str = self._tokenizer.decode([token], clean_up_tokenization_spaces=False)
        if _PART_OF_A_CHARACTER in text:
            text = self._tokenizer.convert_ids_to_tokens(token)
        if token == self.image_token_id:
            return text, "image"
        return text, "special" if text in self._specials else "text"

    def _rendered(self, instruction: str, images: int) -> str:
        before, _, after = self._template.partition("{images}")
        content = [
            *self._text_part(before, instruction),
            *({"type": "image"} for _ in range(images)),
            *self._text_part(after, instruction),
        ]
        with VLMS.foreign(self._folder, "the chat template cannot be rendered"):
            return self._tokenizer.apply_chat_template(
                [{"role": "user", "content": content}],
                chat_template=self.chat_template,
                tokenize=False,
                add_generation_prompt=False,
            )

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

    def _check_vocabulary(self, rows: int) -> None:
        if self._image_token not in self._specials or len(self._tokenizer) > rows:
            raise VLMS.refusal(
                self._folder,
                "the tokenizer is another checkpoint's: it reads config.json's image_token_id "
                f"{self.image_token_id} as {self._image_token!r}, and has {len(self._tokenizer)} "
                f"tokens of a vocabulary of {rows}",
            )

    def _find_chat_template(self) -> str:
        template, beside = self._tokenizer.chat_template, self._folder / "chat_template.json"
        if not isinstance(template, str) and beside.exists():
            template = VLMS.read_json(beside, dict[str, JsonValue]).get("chat_template")
        if not isinstance(template, str):
            raise VLMError(
                f"{self._folder}: no chat template in tokenizer_config.json, chat_template.jinja "
                "or chat_template.json. Take the file from the checkpoint's hub page."
            )
        return template


@dataclass(frozen=True)
class PixelSettings:
    """The settings of a checkpoint's image processor, and the size of stretched frames."""

    resize: tuple[int, int]
    """Requested height and width."""
    image_size: tuple[int, int]
    """The processor's height and width for it: multiples of patch size x merge size."""
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
        """The settings of the checkpoint and the image size of `vlm`."""
        folder = resolve_checkpoint(vlm.checkpoint, vlm.revision)
        return cls.read(folder, (vlm.image_resize_height, vlm.image_resize_width))

    @classmethod
    def read(cls, folder: Path, resize: tuple[int, int]) -> "PixelSettings":
        """The settings of a checkpoint folder for the requested size `resize` (height, width)."""
        from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import smart_resize

        settings = _read_image_processor(folder)
        try:
            image_size = smart_resize(
                *resize,
                factor=settings.patch_size * settings.merge_size,
                min_pixels=settings.size.shortest_edge,
                max_pixels=settings.size.longest_edge,
            )
        except ValueError as error:
            raise VLMError(
                f"vlm.image_resize_height and _width {resize[0]} x {resize[1]}: {error}"
            ) from error
        same = settings.model_dump(exclude={"size"})
        return cls(resize, image_size, **same)


_Pixels = Annotated[int, Field(gt=0, lt=2**31)]
_Scale = Annotated[float, Field(gt=0)]


class _Size(Document):
    model_config = ConfigDict(from_attributes=True)

    shortest_edge: _Pixels
    longest_edge: _Pixels


class _ImageProcessor(Document):
    """The settings of transformers' image processor, which itself accepts any value."""

    model_config = ConfigDict(from_attributes=True)

    size: _Size
    patch_size: _Pixels
    merge_size: _Pixels
    temporal_patch_size: _Pixels
    rescale_factor: _Scale
    image_mean: Annotated[tuple[float, float, float], Field(strict=False)]
    image_std: Annotated[tuple[_Scale, _Scale, _Scale], Field(strict=False)]


class _ProcessorConfig(Document):
    image_processor: dict[str, JsonValue] | None = None


def _read_image_processor(folder: Path) -> _ImageProcessor:
    """The settings of a checkpoint's image processor.

    Raises `VLMError` where it does something else than `qwen.patchify`, or its patch sizes are
    not those of the model.
    """
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

    vision, path = read_config(folder).vision_config, folder / "processor_config.json"
    document = VLMS.read_json(path, _ProcessorConfig).image_processor if path.exists() else None
    if document is None:
        path = folder / "preprocessor_config.json"
        document = VLMS.read_json(path, dict[str, JsonValue])
    with VLMS.foreign(path, "cannot be read"):
        processor: Any = Qwen2VLImageProcessorPil.from_dict(document)
        kind = str(document.get("image_processor_type", "Qwen2VLImageProcessor"))
        processor.image_processor_type = kind.removesuffix("Fast").removesuffix("Pil")
        expected = {
            "image_processor_type": "Qwen2VLImageProcessor",
            "do_resize": True,
            "do_rescale": True,
            "do_normalize": True,
            "resample": Image.Resampling.BICUBIC,
            "patch_size": vision.patch_size,
            "merge_size": vision.spatial_merge_size,
            "temporal_patch_size": vision.temporal_patch_size,
        }
        for name, value in expected.items():
            if (actual := getattr(processor, name)) != value:
                raise VLMS.refusal(path, f"expected {name} {value}, found {shown(actual)}")
    return VLMS.parse(processor, _ImageProcessor, path)


def stretch(frame: NDArray[np.uint8], image_size: tuple[int, int]) -> NDArray[np.uint8]:
    """The frame (height, width, 3) RGB at `image_size`, by one antialiased bicubic stretch."""
    height, width = image_size
    if frame.shape[:2] == image_size:
        return np.ascontiguousarray(frame)
    image = Image.fromarray(frame).resize((width, height), Image.Resampling.BICUBIC)
    return np.asarray(image)
