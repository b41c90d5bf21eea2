"""`QwenVLAUnified`: a policy with a vision-language model in front, as the research code named it.

Features come from the model (images and an instruction), from a cache, or for each sample from
either. `Policy` and `pipeline.vlm.live.LiveVLM` do the work; `LiveVLM` is imported when a model is
loaded.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.base.config import FusionStrategy, ModelType, TrainHeadParams, TuningParams, VLMParams
from pipeline.base.errors import ConfigError, ObservationError
from pipeline.base.observation import Observation
from pipeline.policy.live_policy import LivePolicy
from pipeline.policy.normalization import ChannelStatistics, Normalization
from pipeline.policy.observation import LiveObservation, PolicyShape, check_axes
from pipeline.policy.policy import Policy
from pipeline.vlm.feature_spec import feature_shape

if TYPE_CHECKING:
    from pipeline.vlm.live import LiveVLM
    from pipeline.vlm.preparation import FramesByView, PreparedRow, Preparer
else:  # a model that only ever sees cached features needs no transformers
    FramesByView = PreparedRow = Preparer = Any
    LiveVLM = nn.Module

_SEED_PARTS: Mapping[str, Mapping[str, Any]] = {
    "sensor_encoder": {
        "channels": (512, 1024, 1024, 1024),
        "layers": 2,
        "heads": 8,
        "output_dim": 1024,
    },
    "state_encoder": {"dim": 256, "layers": 2, "heads": 8, "output_dim": 512},
    "expert": {"dim": 512, "layers": 4, "heads": 8},
    "diffusion": {"prediction": "epsilon"},
}
"""Sizes of the research code's parts; params.yaml has leaner defaults."""

_ACTION_GROUPS = ("translation",) * 3 + ("rotation",) * 3 + ("gripper",)


class QwenVLAUnified(LivePolicy[LiveVLM]):
    """Qwen2.5-VL, encoders, fusion and action expert as one `Trainable` module.

    `vlm` is None until images need it or `load_vlm` is called, so cached features need no
    checkpoint. Unless `finetune_vl` is none, `parameters()` also loads it, for the optimizer.
    """

    def __init__(
        self,
        model_type: ModelType = "flow_matching",
        fusion_strategy: FusionStrategy = "concat",
        *,
        vl_model_name: str = "Qwen/Qwen2.5-VL-3B-Instruct",
        finetune_vl: Literal["none", "lora", "full"] = "none",
        lora_r: int = 16,
        lora_alpha: int = 32,
        lora_dropout: float = 0.05,
        image_resize_height: int = 360,
        image_resize_width: int = 640,
        action_dim: int = 7,
        sensor_channels: int = 1026,
        state_dim: int = 12,
        views: Sequence[str] = ("View1", "View2", "View3", "View4", "View5"),
        prompt: str = "{instruction}\n{images}\n{instruction}",
        pooling: Sequence[str] = ("mean",),
        feature_dim: int | None = None,
        normalization: Normalization | None = None,
        vlm: Mapping[str, Any] | None = None,
        tuning: Mapping[str, Any] | None = None,
        **head: Any,
    ) -> None:
        """Build the policy; `vlm`, `tuning` and `head` are further params of those sections.

        `head` takes the keys of `train_head`: `sensor_enabled` and `robot_state_enabled` (True),
        `horizon` (8), `sensor_window` (65 readings), `sensor_window_s` (0.1), `state_window` (100),
        `state_window_s` (1.0) and all others. A part such as `sensor_encoder` keeps the research
        code's sizes for the keys that `head` does not name.

        `feature_dim` is the width of the checkpoint's hidden states: by default that of the
        checkpoint's folder, and 2048 (Qwen2.5-VL-3B) for a hub id. Seven action channels are three
        translations, three rotations and the gripper; any other number are all `other`. Values are
        checked as the params of the same name are (`ValidationError`).

        WARNING: without `normalization` every stream is used as it is. Physical units (degrees,
        millimetres, raw A-scans) train badly: pass the `pipeline.policy.normalization` of the data.
        """
        seen = {
            "checkpoint": vl_model_name,
            "prompt": prompt,
            "pooling": tuple(pooling),
            "image_resize_height": image_resize_height,
            "image_resize_width": image_resize_width,
        }
        lora = {"lora_r": lora_r, "lora_alpha": lora_alpha, "lora_dropout": lora_dropout}
        vlm_params = VLMParams.model_validate({**seen, **(vlm or {})})
        tuned = TuningParams.model_validate({"method": finetune_vl, **lora, **(tuning or {})})
        kinds = {"model_type": model_type, "fusion_strategy": fusion_strategy}
        params = TrainHeadParams.model_validate({**kinds, **_with_seed_parts(head)})
        if params.feature_history > 1:
            raise ConfigError("feature_history: a live model gives one row a tick, set it to 1")
        names = tuple(sorted(views))
        slots, width = feature_shape(vlm_params, names)
        groups = _ACTION_GROUPS if action_dim == len(_ACTION_GROUPS) else ("other",) * action_dim
        sizes = (slots, feature_dim or width, sensor_channels, state_dim, action_dim)
        shape = PolicyShape(*sizes, action_groups=groups, views=len(names))
        policy = Policy(params, shape, normalization or no_normalization(shape))
        load = partial(_load, vlm_params, tuned, names, shape)
        super().__init__(policy, load, tuned=tuned.method != "none")
        self.vlm_params, self.tuning = vlm_params, tuned

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the preparer, whose caches cannot be pickled; it is made again."""
        return {name: value for name, value in self.__dict__.items() if name != "_preparer"}

    def forward(
        self,
        images: Sequence[FramesByView | None] | None = None,
        text: Sequence[str] | None = None,
        features: Any = None,
        sensor: Any = None,
        state: Any = None,
        actions: Any = None,
        *,
        action_valid: Any = None,
        generator: torch.Generator | None = None,
        **validity: Any,
    ) -> Tensor:
        """The loss where `actions` are given, else an action chunk (batch, horizon, action).

        `images` are the frames of each sample, `text` its instruction; a sample whose frames are
        None keeps its cached `features` (batch, slot, dim). `sensor` (batch, window, channel),
        `state` (batch, window, dim) and `actions` (batch, horizon, action) are in physical units,
        tensors or arrays; a stream that is not given is missing. `slot_valid` (batch, slot) marks
        valid slots, `sensor_valid` and `state_valid` (batch,) count the valid readings at the end
        of a window; without them all are valid. `feature_age` (batch,), `view_age` (batch, view),
        `sensor_age` and `state_age` (batch, window) are in s. A chunk is computed without dropout
        in `train()` mode too, and the mode stays. Raises `ObservationError` for a shape that does
        not fit, and where nothing is given.
        """
        streams = {"features": features, "sensor": sensor, "state": state}
        observation = self.observe(images, text, **streams, **validity)
        if actions is None:
            return self.act(observation, generator)
        device, batch = observation.features.device, len(observation.features)
        steps = {"batch": batch, "horizon": self.policy.params.horizon}
        action = torch.as_tensor(actions, dtype=torch.float32, device=device)
        channels = self.policy.shape.action_dim
        check_axes("actions", action, {**steps, "channel": channels}, "the streams")
        if action_valid is None:
            action_valid = torch.ones(action.shape[:2], dtype=torch.bool)
        valid = torch.as_tensor(action_valid, device=device)
        check_axes("action_valid", valid, steps, "the streams")
        return self.loss(observation, action, valid.bool(), generator)[0]

    def observe(
        self,
        images: Sequence[FramesByView | None] | None = None,
        text: Sequence[str] | None = None,
        **streams: Any,
    ) -> LiveObservation:
        """The observation of the arguments of `forward`; equal frames and text share a row."""
        if unknown := streams.keys() - Observation.__dataclass_fields__.keys():
            raise TypeError(f"unexpected arguments: {', '.join(sorted(unknown))}")
        rows: list[PreparedRow] = []
        row_of = [] if images is None else [-1] * len(images)
        if images is not None and any(frames is not None for frames in images):
            if text is None or isinstance(text, str) or len(text) != len(images):
                wanted = f"expected {len(images)} instructions, one for each of images"
                raise ObservationError(f"text: {wanted}, found {text!r}")
            rows, row_of = self._preparer.prepare_distinct(images, text)
        return self.policy.observe(streams, rows, row_of)

    @cached_property
    def _preparer(self) -> Preparer:
        from pipeline.vlm.preparation import Preparer

        return Preparer(self.vlm_params, self.load_vlm().spec)


def no_normalization(shape: PolicyShape) -> Normalization:
    """Statistics of this shape under which every stream stays as it is."""
    sizes = shape.channels.items()
    return Normalization(**{n: ChannelStatistics(np.zeros(s), np.ones(s), 0) for n, s in sizes})


def _with_seed_parts(head: Mapping[str, Any]) -> dict[str, Any]:
    """`head` with the research code's sizes for the keys of each part that it does not name."""
    named = {name: head[name] for name in _SEED_PARTS if isinstance(head.get(name), Mapping)}
    merged = {name: {**_SEED_PARTS[name], **part} for name, part in named.items()}
    return {**_SEED_PARTS, **head, **merged}


def _load(
    vlm: VLMParams, tuning: TuningParams, views: Sequence[str], shape: PolicyShape, device: str
) -> LiveVLM:
    """The model of a checkpoint; `VLMError` where it cannot be used or is of another width."""
    from pipeline.vlm.live import LiveVLM, live_spec

    model = LiveVLM.load(vlm, live_spec(vlm, views), tuning, device)
    model.check_shape(shape.slots, shape.feature_dim)
    return model


class QwenVLAWithSensorDiffusion(QwenVLAUnified):
    """The unified model with the diffusion expert."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__("diffusion", **arguments)


class QwenVLAWithSensor(QwenVLAUnified):
    """The unified model with the regression expert on a frozen vision-language model."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__("regression", **arguments)


class Not_freeze_QwenVLAWithSensor(QwenVLAUnified):  # noqa: N801 (the research code's name)
    """The unified model with the regression expert, in which every weight learns."""

    def __init__(self, **arguments: Any) -> None:
        arguments.setdefault("finetune_vl", "full")
        super().__init__("regression", **arguments)
