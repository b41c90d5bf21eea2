"""The policy: encoders, fusion and action expert, from physical units to physical units."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import ObservationError
from pipeline.base.observation import Observation
from pipeline.base.packing import unpack
from pipeline.base.provenance import CLOCK_SLACK_S
from pipeline.policy.diffusion import DiffusionActionExpert
from pipeline.policy.encoders import build_encoders
from pipeline.policy.expert import (
    ActionExpert,
    Chunk,
    Context,
    Generators,
    Guide,
    Losses,
    StepMask,
    uniform,
)
from pipeline.policy.flow_matching import FlowMatchingActionExpert
from pipeline.policy.fusion import build_fusion
from pipeline.policy.normalization import ChannelStatistics, Normalization
from pipeline.policy.observation import (
    AGES,
    VALIDITY,
    LiveObservation,
    build_observation,
    stream_of,
)
from pipeline.policy.regression import RegressionActionExpert
from pipeline.policy.robot_state import Anchoring, RelativeActions, expand
from pipeline.policy.shape import PolicyShape

EXPERTS: dict[str, type[ActionExpert]] = {
    "regression": RegressionActionExpert,
    "diffusion": DiffusionActionExpert,
    "flow_matching": FlowMatchingActionExpert,
}
"""The class of each `train_head.model_type`."""

_LARGEST = 10.0
"""Inputs are clipped to so many deviations from the training mean: a channel that rested in
training and moves later must not drown the others."""


class Trainable(nn.Module, ABC):
    """The interface of every module that is trained or evaluated."""

    @abstractmethod
    def loss(
        self,
        observation: Observation,
        action: Chunk,
        action_valid: StepMask,
        generator: Generator | None = None,
    ) -> Losses:
        """The scalar to minimise and its detached parts by name; `action` is physical."""

    @abstractmethod
    def sample(
        self,
        observation: Observation,
        samples: int = 1,
        generator: Generators = None,
        guide: Guide | None = None,
    ) -> Float[Tensor, "sample batch horizon action"]:
        """Action chunks in physical units, float32.

        With a guide, also in physical units, they continue its chunk; only a `stochastic` policy
        takes a guide.
        """

    def act(
        self, observation: Observation, generator: Generators = None, guide: Guide | None = None
    ) -> Chunk:
        """One sample: an action chunk in physical units, float32."""
        return self.sample(observation, 1, generator, guide)[0]

    @property
    @abstractmethod
    def stochastic(self) -> bool:
        """Whether two samples differ; if not, any number of samples costs as much as one."""

    @abstractmethod
    def parameter_table(self) -> list[tuple[str, int]]:
        """The number of parameters of each part."""


class Normalizer(nn.Module):
    """Physical units to zero mean and unit variance per channel, and back, in float32.

    The statistics are buffers that move with the module but stay out of its state dict: they
    travel in the checkpoint's JSON.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, statistics: ChannelStatistics) -> None:
        super().__init__()
        for name, value in (("mean", statistics.mean), ("scale", statistics.scale)):
            self.register_buffer(name, torch.tensor(value, dtype=torch.float32), persistent=False)

    def normalize(self, values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """The normalised values; trailing axes are the statistics' channels, any float dtype."""
        return (values.to(self.mean.dtype) - self.mean).div_(self.scale)

    def invert(self, values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Physical units from normalised values, any float dtype."""
        return values.to(self.mean.dtype) * self.scale + self.mean


class Policy(Trainable):
    """Encoders of the streams that are both present and enabled, a fusion and an expert.

    Raises `ConfigError` where no stream is left. The state dict has the weights and the noise
    schedule; the statistics, which must fit the shape, travel in the checkpoint's JSON.
    """

    feature_spec: Mapping[str, Any] | None = None
    """The spec of the features that it was trained on; None without a checkpoint."""

    def __init__(
        self, params: TrainHeadParams, shape: PolicyShape, normalization: Normalization
    ) -> None:
        super().__init__()
        self.params, self.shape = params, shape
        self.encoders, tokens = build_encoders(params, shape)
        statistics = {name: getattr(normalization, name) for name in self.encoders}
        if "features" in statistics:
            statistics["features"] = statistics["features"].at(shape.statistics_of * shape.history)
        self.normalizers = nn.ModuleDict({n: Normalizer(fit) for n, fit in statistics.items()})
        self.action_normalizer = Normalizer(normalization.relative or normalization.action)
        expert = params.expert
        self.fusion = build_fusion(params.fusion_strategy, tokens, expert.dim, expert.heads)
        self.expert = build_expert(params, shape)
        self.anchoring = Anchoring(shape.anchors, shape.kinds)
        self.relative = RelativeActions(shape.relative, shape.kinds)
        self.drop_rates = {name: float(getattr(params, f"drop_{name}")) for name in self.encoders}

    @property
    def stochastic(self) -> bool:
        """Whether the expert draws its chunks."""
        return self.expert.stochastic

    def context(
        self, observation: Observation, validity: Mapping[str, Tensor] | None = None
    ) -> Context:
        """The context of the expert; by default from every valid part of the observation."""
        validity = validity or self._validity(observation)
        windows = {
            name: self._encode_window(name, observation, valid)
            for name, valid in validity.items()
            if name != "features"
        }
        if "features" not in validity:
            return self.fusion(windows)
        features = self._encode_features(observation, validity["features"], windows.get("state"))
        return self.fusion({"features": features, **windows})

    def loss(
        self,
        observation: Observation,
        action: Chunk,
        action_valid: StepMask,
        generator: Generator | None = None,
    ) -> Losses:
        """The scalar to minimise and its detached parts by action group; `action` is physical.

        While training, streams of some samples are dropped at the rates of `train_head.drop_*`
        (`drop_streams`). `generator` draws these and the expert's noise.
        """
        validity = self._validity(observation)
        if self.training and any(self.drop_rates.values()):
            validity = drop_streams(validity, self.drop_rates, generator)
        target = self._learned(action, observation)
        context = self.context(observation, validity)
        return self.expert.loss(context, target, action_valid, generator)

    def _learned(self, action: Chunk, observation: Observation) -> Chunk:
        """Physical chunks as the expert learns them: their origins moved, normalised."""
        moved = self.relative.from_absolute(action, observation)
        return self.action_normalizer.normalize(self.anchoring.from_frame(moved, observation))

    @torch.inference_mode(False)  # guidance differentiates, which inference mode forbids
    @torch.no_grad()
    def sample(
        self,
        observation: Observation,
        samples: int = 1,
        generator: Generators = None,
        guide: Guide | None = None,
    ) -> Float[Tensor, "sample batch horizon action"]:
        """Action chunks in physical units, float32; call `eval()` first to silence dropout.

        The context is computed once. Where the policy is not stochastic, all samples are the same.
        All samples of a batch share the guide, which is in physical units.
        """
        context = self.context(observation)
        repeats = samples if self.stochastic else 1
        if guide is not None:
            learned = self._learned(guide.chunk, observation)
            guide = Guide(learned, guide.weight).repeat(repeats)
        chunks = self.expert.act(context.repeat(repeats, 1, 1), generator, guide)
        physical = self.action_normalizer.invert(chunks).unflatten(0, (repeats, context.shape[0]))
        physical = self.anchoring.from_tick(physical, observation)
        physical = self.relative.to_absolute(physical, observation)
        return physical.expand(samples, -1, -1, -1)

    def observe(
        self, streams: Mapping[str, Any], rows: Sequence[Any] = (), row_of: Sequence[int] = ()
    ) -> LiveObservation:
        """The observation of these streams on the policy's device; other streams are missing.

        `streams` has fields of `Observation` as tensors or arrays, or None. A stream without an
        encoder is left out. Raises `ObservationError` where no stream is left, and as
        `build_observation`.
        """
        device = next(self.parameters()).device
        given = {
            name: torch.as_tensor(value, device=device)
            for name, value in streams.items()
            if value is not None and stream_of(name) in self.encoders
        }
        if not rows and given.keys().isdisjoint(VALIDITY):
            raise ObservationError(
                f"expected images or at least one of {', '.join(self.encoders)}, found none of them"
            )
        return build_observation(self.shape, self.params, given, device, rows, row_of)

    def parameter_table(self) -> list[tuple[str, int]]:
        """The number of parameters of each encoder, of `fusion` and of `expert`, in this order."""
        parts = {**dict(self.encoders.items()), "fusion": self.fusion, "expert": self.expert}
        return [(name, sum(p.numel() for p in part.parameters())) for name, part in parts.items()]

    def _encode_features(
        self, observation: Observation, valid: Tensor, state: Tensor | None
    ) -> Float[Tensor, "batch token width"]:
        """The tokens of the slots that `valid` marks; `state` is the state's token."""
        values = self._normalized("features", unpack(observation.features))
        ages = observation.feature_age, observation.view_age
        return self.encoders["features"](values, valid, *ages, state)

    def _encode_window(
        self, stream: str, observation: Observation, valid: Tensor
    ) -> Float[Tensor, "batch 1 width"]:
        """The token of the newest `valid` readings of a stream."""
        values, ages = getattr(observation, stream), getattr(observation, AGES[stream])
        if stream == "state":
            if self.params.anchored:  # the older readings tell the motion since a frame
                newest = min(values.shape[1], self.params.state_window)
                values, ages = values[:, -newest:], ages[:, -newest:]
                oldest_s = (self.params.state_window_s or torch.inf) + CLOCK_SLACK_S
                older = (ages > oldest_s).sum(dim=1)
                valid = (valid.clamp(max=newest) - older).clamp(min=0)
            values = expand(values, self.shape.kinds)
        return self.encoders[stream](self._normalized(stream, values), valid, ages).unsqueeze(1)

    def _normalized(self, stream: str, values: Tensor) -> Tensor:
        normalizer = self.normalizers[stream]
        assert isinstance(normalizer, Normalizer)
        return normalizer.normalize(values).clamp_(-_LARGEST, _LARGEST)

    def _validity(self, observation: Observation) -> dict[str, Tensor]:
        return {name: getattr(observation, VALIDITY[name]) for name in self.encoders}


def build_expert(params: TrainHeadParams, shape: PolicyShape) -> ActionExpert:
    """The action expert of `train_head.model_type`, with the params of its section."""
    own = getattr(params, params.model_type, None)
    return EXPERTS[params.model_type](
        horizon=params.horizon,
        action_dim=shape.action_dim,
        groups=shape.action_groups,
        group_weights={str(name): weight for name, weight in params.group_weights.items()},
        **params.expert.model_dump(),
        **({} if own is None else own.model_dump()),
    )


def drop_streams(
    validity: Mapping[str, Tensor], rates: Mapping[str, float], generator: Generator | None = None
) -> dict[str, Tensor]:
    """The validity of each stream, 0 for a random share `rates[stream]` of the samples.

    Modality dropout (Neverova et al. 2016, "ModDrop") teaches a policy to use the streams it has.
    Streams are dropped independently, but a sample never loses all of its streams: one of them,
    with equal probability, is then kept. So with rates p and q of two streams, the first is missing
    from p - pq/2 of the samples that have both.
    """
    device = next(iter(validity.values())).device
    present = torch.stack([v.reshape(len(v), -1).gt(0).any(dim=1) for v in validity.values()], 1)
    limits = torch.tensor([rates[name] for name in validity], device=device)
    draw = uniform(present.numel(), device, generator).view(present.shape)
    dropped = draw < limits
    # Below its limit a draw is uniform, so relative to it all streams are alike.
    relative = (draw / limits.clamp(min=torch.finfo(limits.dtype).tiny)).masked_fill(~present, -1.0)
    last = torch.zeros_like(present).scatter(1, relative.argmax(dim=1, keepdim=True), True)
    blind = ~(present & ~dropped).any(dim=1, keepdim=True)
    dropped = dropped & ~(blind & last)
    return {
        name: valid.masked_fill(gone.view(-1, *[1] * (valid.ndim - 1)), 0)
        for (name, valid), gone in zip(validity.items(), dropped.unbind(dim=1), strict=True)
    }


def describe_size(policy: Policy) -> str:
    """A line for the user: the number of parameters, by part."""
    parameters = policy.parameter_table()
    counts = ", ".join(f"{name} {count:,}" for name, count in parameters)
    return f"parameters: {sum(count for _, count in parameters):,} ({counts})"
