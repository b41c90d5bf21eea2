"""The action expert that follows a learned flow from noise to the chunk (Lipman et al. 2023)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from pipeline.policy.denoiser import DrawingExpert, Source, gain, pull
from pipeline.policy.expert import (
    Chunk,
    Context,
    Generators,
    Guide,
    Losses,
    StepMask,
    standard_normal,
    uniform,
)

Solver = Literal["euler", "rk4"]
Velocity = Callable[[Tensor, float], Tensor]

_STAGES: dict[Solver, tuple[tuple[float, ...], tuple[float, ...]]] = {
    # The place of each stage within the step, and its weight; each stage builds on the one before.
    "euler": ((0.0,), (1.0,)),
    "rk4": ((0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)),
}


def integrate(velocity: Velocity, start: Tensor, steps: int, solver: Solver) -> Tensor:
    """Where dx/dt = velocity(x, t) takes `start` from t = 0 to 1 in equal steps.

    Explicit Runge-Kutta methods of order 1 and 4 (Butcher 2016, section 23).
    """
    nodes, weights = _STAGES[solver]
    x, width = start, 1 / steps
    for index in range(steps):
        slope, change = torch.zeros_like(x), torch.zeros_like(x)
        for node, weight in zip(nodes, weights, strict=True):
            slope = velocity(x + node * width * slope, (index + node) * width)
            change = change + weight * slope
        x = x + width * change
    return x


class BetaTimes(nn.Module):
    """Times t in [0, 1] whose noise share 1 - t has the distribution Beta(1.5, 1).

    So noisy times are drawn more often (pi0, Black et al. 2024). Uniform numbers go through a table
    of the distribution's quantiles, exact to 1/4096 in probability: `torch.distributions.Beta`
    takes no generator.
    """

    quantiles: Tensor

    def __init__(self) -> None:
        from scipy.special import betaincinv  # slow to import; only used here

        super().__init__()
        grid = torch.linspace(0, 1, 4097, dtype=torch.float64, device="cpu")
        table = torch.from_numpy(betaincinv(1.5, 1.0, grid.numpy()))
        self.register_buffer("quantiles", table.float(), persistent=False)

    def forward(self, drawn: Float[Tensor, " batch"]) -> Float[Tensor, " batch"]:
        """The times for uniform numbers in [0, 1)."""
        place = drawn * (len(self.quantiles) - 1)
        below = place.long()
        return 1 - torch.lerp(self.quantiles[below], self.quantiles[below + 1], place - below)


class FlowMatchingActionExpert(DrawingExpert):
    """Conditional flow matching of the chunk given the context, on straight paths.

    Noise at t = 0 and the chunk at t = 1 are joined by x_t = (1 - t) noise + t chunk (Lipman et
    al. 2023, eq. 22 with no noise left at the end); the network learns the velocity chunk - noise,
    and `act` follows it in `sampling_steps` steps of `solver`.
    """

    def __init__(
        self,
        *,
        horizon: int = 8,
        action_dim: int = 7,
        dim: int = 512,
        layers: int = 4,
        heads: int = 8,
        dropout: float = 0.1,
        draws: int = 1,
        sampling_steps: int = 10,
        solver: Solver = "euler",
        groups: Sequence[str] | None = None,
        group_weights: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(
            horizon, action_dim, dim, layers, heads, dropout, draws, groups, group_weights
        )
        self.sampling_steps = sampling_steps
        self.solver: Solver = solver
        self.times = BetaTimes()

    def drawn_loss(
        self, context: Context, chunk: Chunk, valid: StepMask, generator: Generator | None
    ) -> Losses:
        """The grouped squared error of the velocity at drawn times."""
        noise = standard_normal(chunk.shape, chunk.device, generator)
        time = self.times(uniform(len(chunk), chunk.device, generator))
        share = time.view(-1, 1, 1)
        noisy = (1 - share) * noise + share * chunk
        return self.grouped(self.denoiser(noisy, time, context, valid), chunk - noise, valid)

    def denoise(
        self, noise: Chunk, context: Source, generator: Generators, guide: Guide | None
    ) -> Chunk:
        """Where the flow takes the noise; a guide corrects the velocity."""

        def velocity(x: Tensor, time: float) -> Tensor:
            return self.denoiser(x, x.new_full(x.shape[:1], time), context)

        def guided(x: Tensor, time: float) -> Tensor:
            assert guide is not None
            with torch.enable_grad():
                x = x.detach().requires_grad_()
                towards = velocity(x, time)
                clean = x + (1 - time) * towards
            return towards.detach() + gain(time, 1 - time) * pull(clean, x, guide)

        followed = velocity if guide is None else guided
        return integrate(followed, noise, self.sampling_steps, self.solver)
