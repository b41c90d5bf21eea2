"""How features are extracted without this project: row by row, batched, and at best.

Each decodes with the project's own reader and stretches to the same size, prepares in line with
transformers' image processor and the checkpoint's tokenizer, and takes the mean over the last
layer's real tokens after the final norm. Without torchvision, that is the processor's Pillow kind.
"""

import time
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.lib.format import open_memmap
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from transformers import AutoImageProcessor, AutoTokenizer

from benchmarks.workload import Frames, Workload
from pipeline.vlm.processor import PromptRenderer

Row = tuple[str, Frames]


class PlainWays:
    """The contenders; each writes every feature of the workload under `folder`."""

    preparing_s: float
    """Seconds of the last call that went into decoding and preprocessing."""

    def __init__(self, whole: Any, workload: Workload, folder: Path) -> None:
        """`whole` is a `Qwen2_5_VLForConditionalGeneration` on its device."""
        vlm = workload.params.vlm
        self._whole, self._workload, self._folder = whole, workload, folder
        self._device = whole.device
        self._renderer = PromptRenderer(Path(vlm.checkpoint), vlm.prompt)
        self._processor: Any = AutoImageProcessor.from_pretrained(
            vlm.checkpoint, trust_remote_code=False
        )
        self._tokenizer: Any = AutoTokenizer.from_pretrained(
            vlm.checkpoint, padding_side="right", trust_remote_code=False
        )
        self._image_token = self._tokenizer.convert_ids_to_tokens(self._renderer.image_token_id)
        self.preparing_s = 0.0
        folder.mkdir(parents=True, exist_ok=True)

    def with_head(self, batch_size: int) -> None:
        """The seeds' loop: the whole model, every layer kept, one `torch.save` a feature."""
        self.preparing_s, done = 0.0, 0
        for inputs in self._batches(batch_size):
            with torch.inference_mode():
                output = self._whole(**inputs, output_hidden_states=True)
                features = _mean(output.hidden_states[-1], inputs["attention_mask"]).cpu()
            for feature in features:
                torch.save(feature.clone(), self._folder / f"{done:06d}.pt")
                done += 1

    def without_head(self, batch_size: int) -> None:
        """The best plain way: the inner model alone, batched, into one array on disk."""
        self.preparing_s, done = 0.0, 0
        rows, dim = len(self._workload.missing), self._workload.survey.spec.dim
        array = open_memmap(self._folder / "features.npy", "w+", np.float32, (rows, dim))
        # Frames have the right size by then: to resize them again would change no pixel.
        for inputs in self._batches(batch_size, do_resize=False):
            with torch.inference_mode():
                hidden = self._whole.model(**inputs, use_cache=False).last_hidden_state
                features = _mean(hidden, inputs["attention_mask"]).cpu()
            array[done : done + len(features)] = features.numpy()
            done += len(features)
        array.flush()

    def saved(self) -> NDArray[np.float32]:
        """Features (row, dim) that `with_head` wrote."""
        return np.stack([torch.load(file).numpy() for file in sorted(self._folder.glob("*.pt"))])

    def array(self) -> NDArray[np.float32]:
        """Features (row, dim) that `without_head` wrote."""
        return np.load(self._folder / "features.npy")

    def _batches(self, size: int, **processing: Any) -> Iterator[dict[str, Tensor]]:
        rows = self._workload.read()
        while True:
            begun = time.perf_counter()
            batch = list(islice(rows, size))
            if not batch:
                return
            inputs = self._prepared(batch, processing)
            self.preparing_s += time.perf_counter() - begun
            yield inputs

    def _prepared(self, rows: Sequence[Row], processing: dict[str, Any]) -> dict[str, Tensor]:
        """What transformers' own processor gives, which itself needs torchvision."""
        height, width = self._workload.survey.spec.image_size
        images = [
            Image.fromarray(frames[view]).resize((width, height), Image.Resampling.BICUBIC)
            for _, frames in rows
            for view in sorted(frames)
        ]
        seen = self._processor(images=images, return_tensors="pt", **processing)
        merged = int(seen["image_grid_thw"][0].prod()) // self._processor.merge_size**2
        texts = [
            self._renderer.render(instruction, len(frames)).replace(
                self._image_token, self._image_token * merged
            )
            for instruction, frames in rows
        ]
        tokens = self._tokenizer(texts, padding=True, return_tensors="pt")
        ids = tokens["input_ids"]
        inputs = {
            "input_ids": ids,
            "attention_mask": tokens["attention_mask"],
            "mm_token_type_ids": (ids == self._renderer.image_token_id).int(),
            "pixel_values": seen["pixel_values"].to(self._whole.dtype),
            "image_grid_thw": seen["image_grid_thw"],
        }
        return {name: tensor.to(self._device) for name, tensor in inputs.items()}


def _mean(
    hidden: Float[Tensor, "row token dim"], real: Float[Tensor, "row token"]
) -> Float[Tensor, "row dim"]:
    weights = real.unsqueeze(-1).float()
    return (hidden.float() * weights).sum(dim=1) / weights.sum(dim=1)
