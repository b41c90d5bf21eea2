import pytest
import torch

from pipeline.base.errors import ConfigError
from pipeline.policy.attention import TransformerLayer, masked_mean


def test_heads_that_do_not_divide_the_width_are_refused():
    with pytest.raises(ConfigError, match="30 wide cannot have 8 heads"):
        TransformerLayer(30, 8)


def test_masked_mean_counts_valid_tokens_only():
    tokens = torch.tensor([[[9.0], [1.0], [3.0]], [[9.0], [9.0], [9.0]]])
    valid = torch.tensor([[False, True, True], [False, False, False]])
    assert masked_mean(tokens, valid).tolist() == [[2.0], [0.0]]


class TestModulation:
    def test_closed_gates_leave_only_the_context(self):
        layer, tokens = TransformerLayer(16, 2, cross=True), torch.randn(2, 5, 16)
        context, modulation = torch.randn(2, 3, 16), torch.randn(2, 6, 16)
        modulation[:, [2, 5]] = -1.0
        assert layer.cross_attention is not None
        assert layer.cross_norm is not None
        taken = layer.cross_attention(layer.cross_norm(tokens), context)
        found = layer(tokens, None, context, modulation)
        torch.testing.assert_close(found, tokens + taken)

    def test_shift_and_scale_act_behind_the_norm(self):
        layer, tokens = TransformerLayer(16, 2), torch.randn(2, 5, 16)
        modulation = torch.randn(2, 6, 16)
        first, second = modulation.unsqueeze(2).chunk(2, dim=1)
        normed = layer.self_norm(tokens) * (1 + first[:, 1]) + first[:, 0]
        expected = tokens + layer.self_attention(normed, normed) * (1 + first[:, 2])
        normed = layer.feed_forward[0](expected) * (1 + second[:, 1]) + second[:, 0]
        expected = expected + layer.feed_forward[1:](normed) * (1 + second[:, 2])
        torch.testing.assert_close(layer(tokens, modulation=modulation), expected)
