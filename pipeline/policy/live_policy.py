"""A policy with a model in front that computes the features of some or all samples."""

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.base.observation import Observation
from pipeline.policy.expert import Chunk, Generators, Guide, Losses, StepMask
from pipeline.policy.observation import LiveObservation, with_features
from pipeline.policy.policy import Policy, Trainable

Model = TypeVar("Model", bound=nn.Module)


class LivePolicy(Trainable, Generic[Model]):
    """A policy and, in front of it, a model `rows -> (features, valid)`.

    The model computes the features of a `LiveObservation`; any other goes to the policy as it is.
    """

    policy: Policy
    vlm: Model | None
    """The model, or None while it is not loaded."""

    def __init__(self, policy: Policy, load: Callable[[str], Model], tuned: bool) -> None:
        """`load(device)` loads the model where it is needed before `vlm` is set.

        A `tuned` model has parameters that learn, so it is loaded before its weights are read.
        """
        super().__init__()
        self.policy = policy
        self.register_module("vlm", None)
        self._load, self._tuned = load, tuned

    def load_vlm(self) -> Model:
        """The model; the first time it is loaded, onto the policy's device."""
        if self.vlm is None:
            self.vlm = self._load(str(next(self.policy.parameters()).device))
            self.vlm.train(self.training)
        return self.vlm

    def named_parameters(
        self, prefix: str = "", recurse: bool = True, remove_duplicate: bool = True
    ) -> Iterator[tuple[str, nn.Parameter]]:
        """All parameters, those of a tuned model included, so that an optimizer sees them."""
        if self._tuned:
            self.load_vlm()
        return super().named_parameters(prefix, recurse, remove_duplicate)

    def state_dict(self, *arguments: Any, **named: Any) -> dict[str, Any]:
        """Weights of the policy and of a tuned model; a frozen model has its own checkpoint."""
        if self._tuned:
            self.load_vlm()
        state = super().state_dict(*arguments, **named)
        return {
            name: value for name, value in state.items() if self._tuned or ".vlm." not in f".{name}"
        }

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Load the weights of `state_dict()`, whether or not a model was loaded there or here."""
        if self._tuned:
            self.load_vlm()
        elif self.vlm is not None:
            frozen = {f"vlm.{name}": value for name, value in self.vlm.state_dict().items()}
            state_dict = {**frozen, **state_dict}
        return super().load_state_dict(state_dict, strict, assign)

    def loss(
        self,
        observation: Observation,
        action: Chunk,
        action_valid: StepMask,
        generator: torch.Generator | None = None,
    ) -> Losses:
        """As `Policy.loss`; gradients of live samples reach a model that learns."""
        return self.policy.loss(self._seen(observation), action, action_valid, generator)

    @torch.no_grad()
    def sample(
        self,
        observation: Observation,
        samples: int = 1,
        generator: Generators = None,
        guide: Guide | None = None,
    ) -> Float[Tensor, "sample batch horizon action"]:
        """As `Policy.sample`, but without dropout in any mode; the model runs once.

        Equal generators give equal samples. Every part keeps its mode.
        """
        with self._evaluating():
            return self.policy.sample(self._seen(observation), samples, generator, guide)

    @property
    def stochastic(self) -> bool:
        """Whether two samples differ."""
        return self.policy.stochastic

    def parameter_table(self) -> list[tuple[str, int]]:
        """The number of parameters of each part of the policy, and of the model where loaded."""
        table = self.policy.parameter_table()
        if self.vlm is not None:
            for kind, learns in (("learning", True), ("frozen", False)):
                sizes = (p.numel() for p in self.vlm.parameters() if p.requires_grad == learns)
                table.append((f"vlm, {kind}", sum(sizes)))
        return table

    @contextmanager
    def _evaluating(self) -> Generator[None]:
        modes = {part: part.training for part in self.modules()}
        self.eval()
        try:
            yield
        finally:
            for part in self.modules():
                # A model that was loaded meanwhile gets the mode of the whole.
                part.training = modes.get(part, modes[self])

    def _seen(self, observation: Observation) -> Observation:
        """The observation with the features of its live samples computed."""
        if isinstance(observation, LiveObservation) and observation.rows:
            return with_features(observation, *self.load_vlm()(observation.rows))
        return observation
