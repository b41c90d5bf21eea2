"""Weights of a pooling are those of the mean that it stands for."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.config import VLMParams
from pipeline.vlm.pooling import batch_weights, pool, token_weights
from pipeline.vlm.preparation import TokenLayout
from pipeline.vlm.slots import Slot, slots_of


@given(
    grid=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    rows=st.integers(1, 14),
    columns=st.integers(1, 24),
    start=st.integers(0, 5),
)
def test_grid_is_adaptive_average_pooling(grid, rows, columns, start):
    vlm = VLMParams(checkpoint="any", pooling=("grid",), grid=grid)
    slots = slots_of(vlm, 1, ["View1"], (rows, columns))
    assert [slot.cell for slot in slots] == list(np.ndindex(*grid))
    layout = TokenLayout(start + rows * columns + 3, (("View1", start),), (rows, columns))
    tokens = torch.randn(layout.length, 5, generator=torch.Generator().manual_seed(0))
    cells = torch.tensor(token_weights(slots, layout)) @ tokens
    plane = tokens[start : start + rows * columns].T.reshape(5, rows, columns)
    expected = torch.nn.functional.adaptive_avg_pool2d(plane, grid).flatten(1).T
    torch.testing.assert_close(cells, expected, atol=1e-5, rtol=1e-5)


@given(
    grid=st.tuples(st.integers(1, 5), st.integers(1, 5)),
    present=st.sets(st.sampled_from(["View1", "View2"])),
)
def test_weights_sum_to_one_or_to_nothing(grid, present):
    size = grid[0] * grid[1]
    starts = tuple((view, 2 + i * (size + 2)) for i, view in enumerate(sorted(present)))
    layout = TokenLayout(4 + len(starts) * (size + 2), starts, grid)
    slots = (
        Slot(0, True, "mean"),
        Slot(0, True, "image_mean"),
        Slot(0, True, "text_mean"),
        Slot(0, True, "last"),
        Slot(0, True, "view_mean", "View1"),
        Slot(0, True, "view_mean", "View2"),
    )
    sums = torch.tensor(token_weights(slots, layout)).sum(dim=1)
    expected = [1, bool(present), 1, 1, "View1" in present, "View2" in present]
    torch.testing.assert_close(sums, torch.tensor(expected, dtype=torch.float32))


def test_padding_never_enters_even_when_it_is_infinite():
    layouts = [TokenLayout(3, (), (1, 1)), TokenLayout(5, (), (1, 1))]
    slots = (Slot(0, True, "mean"), Slot(0, True, "last"))
    hidden = torch.randn(2, 5, 4, dtype=torch.float32).to(torch.bfloat16)
    hidden[0, 3:] = torch.inf
    real = torch.tensor([[True] * 3 + [False] * 2, [True] * 5])
    pooled = pool(hidden, batch_weights(slots, layouts, 5), real)
    assert pooled.dtype == torch.float32
    torch.testing.assert_close(pooled[0, 0], hidden[0, :3].float().mean(0))
    assert torch.equal(pooled[0, 1], hidden[0, 2].float())
    torch.testing.assert_close(pooled[1, 0], hidden[1].float().mean(0))
