import pytest
import torch

from pipeline.errors import ConfigError
from pipeline.models.attention import TransformerLayer, masked_mean, right_aligned


def test_heads_that_do_not_divide_the_width_are_refused() -> None:
    with pytest.raises(ConfigError, match="30 wide cannot have 8 heads"):
        TransformerLayer(30, 8)


def test_invalid_tokens_are_never_attended_to() -> None:
    layer = TransformerLayer(16, 2)
    tokens = torch.randn(2, 5, 16)
    valid = torch.tensor([[False, False, True, True, True], [True] * 5])
    changed = tokens.clone()
    changed[0, :2] = 100.0
    torch.testing.assert_close(layer(tokens, valid)[0, 2:], layer(changed, valid)[0, 2:])


def test_right_aligned_marks_the_last_readings() -> None:
    mask = right_aligned(torch.tensor([0, 1, 3]), 3)
    assert mask.tolist() == [[False] * 3, [False, False, True], [True] * 3]


def test_masked_mean_counts_valid_tokens_only() -> None:
    tokens = torch.tensor([[[9.0], [1.0], [3.0]], [[9.0], [9.0], [9.0]]])
    valid = torch.tensor([[False, True, True], [False, False, False]])
    assert masked_mean(tokens, valid).tolist() == [[2.0], [0.0]]
