"""The tensors that the parts of a policy hand on, by name."""

from collections.abc import Iterator, Sequence

from jaxtyping import Bool, Float
from torch import Generator, Tensor

Context = Float[Tensor, "batch token dim"]
"""What an action expert attends to."""

Chunk = Float[Tensor, "batch horizon action"]
"""Action chunks: the steps of a horizon, one value a channel."""

TokenMask = Bool[Tensor, "batch token"]
"""Which tokens of a context, or of any other sequence, are real."""

StepMask = Bool[Tensor, "batch horizon"]
"""Which steps of a chunk are real."""

Losses = tuple[Float[Tensor, ""], dict[str, Tensor]]
"""The scalar to minimise, and its detached parts by name."""

Generators = Generator | Sequence[Generator] | Iterator[Tensor] | None
"""What draws a batch: one generator for all of it, one a sample, or the device's own; or the noise
itself, in the order in which a sampler asks for it."""
