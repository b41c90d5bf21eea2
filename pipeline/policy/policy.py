"""The policy: encoders, fusion and action expert, from physical units to physical units."""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pipeline.base.config import TrainHeadParams
from pipeline.base.errors import CheckpointMismatch
from pipeline.policy.building import build_encoders, build_expert
from pipeline.policy.fusion import build_fusion
from pipeline.policy.normalizer import Normalizer, Statistics, StreamStatistics
from pipeline.policy.observation import Observation, PolicyShape, drop_streams, stream_validity


@runtime_checkable
class Trainable(Protocol):
    """What every module that is trained or judged can do; each is an `nn.Module`."""

    def loss(
        self,
        observation: Observation,
        action: Float[Tensor, "batch horizon action"],
        action_valid: Bool[Tensor, "batch horizon"],
        generator: torch.Generator | None = None,
    ) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """The scalar to minimise and its detached parts by name; `action` is physical."""
        ...

    def sample(
        self,
        observation: Observation,
        samples: int = 1,
        generator: torch.Generator | None = None,
    ) -> Float[Tensor, "sample batch horizon action"]:
        """Action chunks in physical units, float32."""
        ...

    @property
    def stochastic(self) -> bool:
        """Whether two samples differ."""
        ...

    def parameter_table(self) -> list[tuple[str, int]]:
        """The number of parameters of each part."""
        ...


class Policy(nn.Module):
    """Encoders of the streams that are both present and enabled, fusion, expert.

    Raises `ConfigError` where no stream is left, `CheckpointMismatch` where the statistics do not
    fit the shape. The state dict holds weights and noise schedule; the statistics travel beside it.
    """

    feature_spec: Mapping[str, Any] | None = None
    """What the features are that it was trained on, where a checkpoint says so."""

    def __init__(
        self, params: TrainHeadParams, shape: PolicyShape, normalization: StreamStatistics
    ) -> None:
        super().__init__()
        self.params, self.shape = params, shape
        self.encoders, tokens = build_encoders(params, shape)
        self.normalizers = nn.ModuleDict(
            {name: Normalizer(_fitting(normalization, name, shape)) for name in self.encoders}
        )
        self.action_normalizer = Normalizer(_fitting(normalization, "action", shape))
        expert = params.expert
        self.fusion = build_fusion(params.fusion_strategy, tokens, expert.dim, expert.heads)
        self.expert = build_expert(params, shape)
        self.drop_rates = {name: float(getattr(params, f"drop_{name}")) for name in self.encoders}

    @property
    def stochastic(self) -> bool:
        """Whether two samples differ; else any number of them costs one."""
        return self.expert.stochastic

    def context(self, observation: Observation) -> Float[Tensor, "batch token dim"]:
        """What the expert attends to."""
        return self._context(observation, self._validity(observation))

    def loss(
        self,
        observation: Observation,
        action: Float[Tensor, "batch horizon action"],
        action_valid: Bool[Tensor, "batch horizon"],
        generator: torch.Generator | None = None,
    ) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """The scalar to minimise and its detached parts by action group; `action` is physical.

        While training, streams of some samples go missing at the rates of `train_head.drop_*`;
        see `drop_streams`. `generator` draws these and what the expert draws.
        """
        validity = self._validity(observation)
        if self.training and any(self.drop_rates.values()):
            validity = drop_streams(validity, self.drop_rates, generator)
        target = self.action_normalizer.normalize(action)
        context = self._context(observation, validity)
        return self.expert.loss(context, target, action_valid, generator)

    @torch.no_grad()
    def sample(
        self,
        observation: Observation,
        samples: int = 1,
        generator: torch.Generator | None = None,
    ) -> Float[Tensor, "sample batch horizon action"]:
        """Action chunks in physical units, float32; call `eval()` first to silence dropout.

        The context is computed once. Where the policy is not stochastic all samples are one.
        """
        context = self.context(observation)
        repeats = samples if self.stochastic else 1
        chunks = self.expert.act(context.repeat(repeats, 1, 1), generator)
        physical = self.action_normalizer.invert(chunks).unflatten(0, (repeats, len(context)))
        return physical.expand(samples, -1, -1, -1)

    def act(
        self, observation: Observation, generator: torch.Generator | None = None
    ) -> Float[Tensor, "batch horizon action"]:
        """One sample: an action chunk in physical units, float32."""
        return self.sample(observation, 1, generator)[0]

    def parameter_table(self) -> list[tuple[str, int]]:
        """The number of parameters of each part."""
        return [
            (name, sum(p.numel() for p in part.parameters())) for name, part in self.parts.items()
        ]

    @property
    def parts(self) -> dict[str, nn.Module]:
        """Encoders by stream, `fusion`, `expert`: in the order in which they work."""
        return {**dict(self.encoders.items()), "fusion": self.fusion, "expert": self.expert}

    def encode(
        self, stream: str, observation: Observation, valid: Tensor
    ) -> Float[Tensor, "batch token width"]:
        """The tokens of a stream, of which only what `valid` counts or marks is looked at."""
        normalizer, encoder = self.normalizers[stream], self.encoders[stream]
        assert isinstance(normalizer, Normalizer)
        values = normalizer.normalize(getattr(observation, stream))
        if stream == "features":
            return encoder(values, valid, observation.feature_age)
        return encoder(values, valid).unsqueeze(1)

    def _context(self, observation: Observation, validity: Mapping[str, Tensor]) -> Tensor:
        return self.fusion(
            {name: self.encode(name, observation, valid) for name, valid in validity.items()}
        )

    def _validity(self, observation: Observation) -> dict[str, Tensor]:
        return {name: stream_validity(observation, name) for name in self.encoders}


def _fitting(normalization: StreamStatistics, name: str, shape: PolicyShape) -> Statistics:
    expected = {
        "features": (shape.slots, shape.feature_dim),
        "sensor": (shape.sensor_channels,),
        "state": (shape.state_dim,),
        "action": (shape.action_dim,),
    }[name]
    statistics: Statistics | None = getattr(normalization, name)
    found = None if statistics is None else statistics.mean.shape
    if statistics is None or found != expected:
        raise CheckpointMismatch(
            f"normalisation of {name}: expected statistics of shape {expected}, found {found}. "
            "Train again: python -m stages.train_head"
        )
    return statistics
