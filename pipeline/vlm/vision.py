"""The vision tower's forward pass, with every length known beforehand.

Without flash-attention, transformers' own pass attends to one window after the other and asks the
device for the length of each. Here all images of a batch have one grid, so everything that depends
on it is computed once on the host and nothing is read back. Patches are ordered so that windows of
equal length are neighbours, and each length is one batched call.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor, nn
from transformers import AttentionInterface
from transformers.integrations.sdpa_attention import sdpa_attention_forward
from transformers.models.qwen2_5_vl.modeling_qwen2_5_vl import eager_attention_forward
from transformers.vision_utils import get_vision_position_ids, get_vision_window_index

MLP_MULTIPLE = 64
_KEPT = 64
"""Most plans that are kept; batches differ in their number of distinct images."""


@dataclass(frozen=True)
class PatchWindows:
    """The order of patches: by window length, then image, then window."""

    images: int
    lengths: tuple[tuple[int, int], ...]
    """For each window length: windows per image, and patches per window."""
    whole: bool = False
    """Whether a block attends over complete images."""


@dataclass(frozen=True)
class TowerPlan:
    """What the tower needs for a number of images, on its device."""

    order: Int64[Tensor, " token"]
    """The image token at each position: the tower has its own order."""
    place: NDArray[np.int64]
    """(token,) the position of each image token; on the host."""
    windowed: dict[str, Any]
    """Arguments of the blocks that attend within windows."""
    whole: dict[str, Any]
    """Arguments of the blocks that attend within images."""


class VisionTower:
    """Runs the parts of a `Qwen2_5_VisionTransformerPretrainedModel` over images of one grid.

    The result is that of the model, in the order of the plan. Gradients flow, and blocks are
    checkpointed if the model is set so.
    """

    def __init__(self, visual: Any, grid: tuple[int, int]) -> None:
        """`grid` is the rows and columns of patches. Changes the attention that `visual` uses."""
        self.visual = visual
        attention = str(visual.config._attn_implementation)
        self._flash = attention.startswith("flash_attention")
        if attention in _GROUPED:
            visual.config._attn_implementation = _GROUPED[attention]
        self._one = torch.tensor([[1, *grid]])
        index, edges = get_vision_window_index(
            self._one, visual.spatial_merge_size, visual.window_size, visual.patch_size
        )
        sizes = np.diff(edges.numpy()) // visual.spatial_merge_unit
        self._windows = np.split(index.numpy(), np.cumsum(sizes)[:-1])
        positions = get_vision_position_ids(self._one, visual.spatial_merge_size)
        tables = visual.rotary_pos_emb(visual.rotary_pos_emb.inv_freq.cpu(), positions)
        self._rotary = [table.unflatten(0, (-1, visual.spatial_merge_unit)) for table in tables]
        self._plans: dict[int, TowerPlan] = {}

    def plan(self, images: int, device: torch.device) -> TowerPlan:
        """The plan for a pass over this many images; computed once, on the host."""
        if images not in self._plans:
            if len(self._plans) == _KEPT:
                del self._plans[next(iter(self._plans))]
            self._plans[images] = self._planned(images, device)
        return self._plans[images]

    def __call__(
        self, patches: Float[Tensor, "patch value"], plan: TowerPlan
    ) -> Float[Tensor, "token dim"]:
        """The image tokens, in the plan's order."""
        visual = self.visual
        unit = visual.spatial_merge_unit
        hidden = self._embedded(patches)
        hidden = hidden.unflatten(0, (-1, unit)).index_select(0, plan.order).flatten(0, 1)
        inside = plan.order % len(self._rotary[0])
        rotary = tuple(table.index_select(0, inside).flatten(0, 1) for table in self._rotary)
        for number, block in enumerate(visual.blocks):
            lengths = plan.whole if number in visual.fullatt_block_indexes else plan.windowed
            hidden = block(hidden, position_embeddings=rotary, **lengths)
        return visual.merger(hidden)

    def _embedded(self, patches: Float[Tensor, "patch value"]) -> Float[Tensor, "patch dim"]:
        """The patch embedding as one matrix product: its kernel covers the input. Far faster."""
        projection = self.visual.patch_embed.proj
        if type(projection) is not nn.Conv3d:  # it has an adapter
            return self.visual.patch_embed(patches)
        weight = projection.weight.flatten(1)
        return nn.functional.linear(patches.to(weight.dtype), weight)

    def _planned(self, images: int, device: torch.device) -> TowerPlan:
        tokens = sum(map(len, self._windows))
        every = [(image, window) for image in range(images) for window in self._windows]
        if not self._flash:
            every.sort(key=lambda placed: len(placed[1]))  # stable: image and window order stay
        order = np.concatenate([image * tokens + window for image, window in every])
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        self._rotary = [table.to(device) for table in self._rotary]
        lengths = [len(window) * self.visual.spatial_merge_unit for _, window in every]
        windowed, whole = self._spans(images, lengths, device)
        return TowerPlan(sent(torch.from_numpy(order), device), place, windowed, whole)

    def _spans(
        self, images: int, lengths: list[int], device: torch.device
    ) -> tuple[dict[str, Any], ...]:
        """Arguments for blocks that attend within consecutive windows, and within whole images."""
        patches = sum(lengths) // images
        if self._flash:
            windowed, whole = ([0, *accumulate(of)] for of in (lengths, [patches] * images))
            return tuple(
                {
                    "cu_seqlens": torch.tensor(edges, dtype=torch.int32).to(device),
                    "max_seqlen": max(np.diff(edges).tolist()),
                }
                for edges in (windowed, whole)
            )
        counts = tuple((count // images, length) for length, count in Counter(lengths).items())
        return tuple(
            {
                "cu_seqlens": None,
                "max_seqlen": patches,
                "windows": PatchWindows(images, counts, whole),
            }
            for whole in (False, True)
        )


def pad_mlps(visual: Any) -> None:
    """Widen the hidden layer of each block's MLP with zeros, to a multiple of 64; results stay.

    Tensor cores want rows of whole 16 bytes; 3,420 numbers in bfloat16, the real models' width, are
    not, and take a kernel that is 3 times slower. A block with an adapter stays as it is.
    """
    for block in visual.blocks:
        mlp = block.mlp
        layers = (mlp.gate_proj, mlp.up_proj, mlp.down_proj)
        missing = -mlp.down_proj.weight.shape[1] % MLP_MULTIPLE
        if not missing or any(type(layer) is not nn.Linear for layer in layers):
            continue
        for layer in layers[:2]:
            layer.weight = _padded(layer.weight, (0, 0, 0, missing))
            if layer.bias is not None:
                layer.bias = _padded(layer.bias, (0, missing))
        mlp.down_proj.weight = _padded(mlp.down_proj.weight, (0, missing))


def _padded(weight: Tensor, sides: tuple[int, ...]) -> nn.Parameter:
    return nn.Parameter(nn.functional.pad(weight, sides), requires_grad=False)


def tower_attention(visual: Any) -> str:
    """The tower's attention backend, as it is recorded."""
    return str(visual.config._attn_implementation).replace("grouped_flash_", "grouped ")


def sent(tensor: Tensor, device: torch.device) -> Tensor:
    """Send a CPU tensor to a device without waiting."""
    if device.type == "cuda" and not tensor.is_pinned():
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)


def _grouped_attention(
    module: nn.Module,
    query: Float[Tensor, "1 head patch dim"],
    key: Float[Tensor, "1 head patch dim"],
    value: Float[Tensor, "1 head patch dim"],
    attention_mask: None,
    *,
    attend: Callable[..., tuple[Tensor, Any]],
    windows: PatchWindows,
    scaling: float,
    dropout: float,
    **_: object,
) -> tuple[Float[Tensor, "1 patch head dim"], None]:
    """Attention within each window, or each image, by one call of `attend` per length."""
    # With patches first, windows of equal length are one view, without a copy.
    flat = [tensor[0].transpose(0, 1) for tensor in (query, key, value)]
    group = _of_images if windows.whole else _of_windows
    options = {"scaling": scaling, "dropout": dropout, "is_causal": False}
    attended = [
        attend(module, *batched, attention_mask, **options)[0]
        for batched in zip(*(group(tensor, windows) for tensor in flat), strict=True)
    ]
    if windows.whole:
        (images,) = attended
        attended = images.split([count * length for count, length in windows.lengths], dim=1)
    return torch.cat([tensor.flatten(0, 1) for tensor in attended])[None], None


def _slabs(tensor: Float[Tensor, "patch head dim"], windows: PatchWindows) -> Sequence[Tensor]:
    """The patches of each window length."""
    return tensor.split([windows.images * count * length for count, length in windows.lengths])


def _of_windows(tensor: Float[Tensor, "patch head dim"], windows: PatchWindows) -> list[Tensor]:
    """(window, head, patch, dim) of each window length."""
    slabs = zip(_slabs(tensor, windows), windows.lengths, strict=True)
    return [slab.unflatten(0, (-1, length)).transpose(1, 2) for slab, (_, length) in slabs]


def _of_images(tensor: Float[Tensor, "patch head dim"], windows: PatchWindows) -> list[Tensor]:
    """(image, head, patch, dim)"""
    parts = [slab.unflatten(0, (windows.images, -1)) for slab in _slabs(tensor, windows)]
    return [torch.cat(parts, dim=1).transpose(1, 2)]


_GROUPED = {"sdpa": "grouped_flash_sdpa", "eager": "grouped_flash_eager"}
"""transformers keeps windows together only if the name contains "flash"."""

for _kind, _attend in (("sdpa", sdpa_attention_forward), ("eager", eager_attention_forward)):
    AttentionInterface.register(_GROUPED[_kind], partial(_grouped_attention, attend=_attend))
