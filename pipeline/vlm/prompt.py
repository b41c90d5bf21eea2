"""An instruction and its views -> the text and the tokens that the model reads."""

from pathlib import Path
from typing import Any, Literal

from pipeline.base.errors import VLMError
from pipeline.vlm.checkpoint_folder import read_config, read_json, tokenizer_files

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
        found = text.count(self._image_token)
        if found != images:
            raise VLMError(
                f"{self._folder}: the chat template renders {found} of {images} images as "
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
        image_token = self._tokenizer.convert_ids_to_tokens(self.image_token_id)
        if image_token not in self._specials:
            raise VLMError(
                f"{self._folder}: config.json says image_token_id {self.image_token_id}, which the "
                f"tokenizer reads as {image_token!r}. The tokenizer belongs to another checkpoint."
            )
        self._image_token: str = image_token
        rows = int(config.get("text_config", config).get("vocab_size", 0))
        if len(self._tokenizer) > rows:
            raise VLMError(
                f"{self._folder}: the tokenizer has {len(self._tokenizer)} tokens, the model's "
                f"vocabulary {rows}. The tokenizer belongs to another checkpoint."
            )

    def _find_chat_template(self) -> str:
        if isinstance(self._tokenizer.chat_template, str):
            return self._tokenizer.chat_template
        beside = self._folder / "chat_template.json"
        if beside.exists():
            template = read_json(beside).get("chat_template")
            if isinstance(template, str):
                return template
        raise VLMError(
            f"{self._folder}: no chat template in tokenizer_config.json, chat_template.jinja or "
            "chat_template.json. Take the file from the checkpoint's hub page."
        )
