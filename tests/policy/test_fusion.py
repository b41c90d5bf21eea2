"""What every fusion guarantees for every subset of streams, and what each does on its own."""

import pytest
import torch

from pipeline.policy.fusion import GatedFusion, NoFusion, build_fusion

DIM, HEADS = 16, 2
STRATEGIES = ("concat", "cross_attention", "gated", "none")
SHAPES = {"features": (5, 12), "sensor": (1, 6), "state": (1, 8)}
SUBSETS = [("features",), ("sensor", "state"), tuple(SHAPES)]


@pytest.fixture(params=SUBSETS, ids="+".join)
def streams(request):
    return request.param


@pytest.fixture(params=STRATEGIES)
def strategy(request):
    return request.param


@pytest.fixture
def fusion(strategy, streams):
    return build_fusion(strategy, {name: SHAPES[name] for name in streams}, DIM, HEADS)


@pytest.fixture
def encoded(streams):
    return {name: torch.randn(3, *SHAPES[name]) for name in streams}


class TestFusionContract:
    def test_shape(self, fusion, encoded, strategy, streams):
        felt = len(set(streams) - {"features"})
        tokens = {
            "concat": 4,
            "gated": 4,
            "cross_attention": 4 + felt,
            "none": felt + 5 * ("features" in streams),
        }
        context = fusion(encoded)
        assert context.shape == (3, tokens[strategy], DIM)
        assert context.dtype == torch.float32

    def test_every_token_of_every_stream_reaches_the_context(self, fusion, encoded):
        context = fusion(encoded)
        for name, tokens in encoded.items():
            for token in range(tokens.shape[1]):
                changed = tokens.clone()
                changed[:, token] = torch.randn_like(changed[:, token])
                moved = (fusion(encoded | {name: changed}) - context).abs()
                assert moved.amax(dim=(1, 2)).min() > 1e-3, (name, token)

    def test_no_stream_drowns_the_others_by_its_scale(self, fusion, encoded, strategy):
        """Where several tokens are projected together, what counts is their mean and bias."""
        context = fusion(encoded)
        for name, tokens in encoded.items():
            loud = fusion(encoded | {name: 1e4 * tokens})
            assert torch.isfinite(loud).all()
            assert (loud - context).abs().max() < 2.0
            if name != "features" or strategy in ("cross_attention", "none"):
                torch.testing.assert_close(loud, context, atol=1e-3, rtol=1e-3)


class TestGates:
    @pytest.fixture
    def fusion(self):
        return GatedFusion(SHAPES, DIM)

    @pytest.fixture
    def encoded(self):
        return {name: torch.randn(3, *shape) for name, shape in SHAPES.items()}

    def test_each_depends_on_every_stream(self, fusion, encoded):
        before = fusion.gates(fusion.vectors(encoded))
        for name, tokens in encoded.items():
            after = fusion.gates(fusion.vectors(encoded | {name: torch.randn_like(tokens)}))
            assert all((after[gate] - before[gate]).abs().max() > 1e-3 for gate in SHAPES)

    def test_a_closed_gate_shuts_its_stream_out(self, fusion, encoded):
        torch.nn.init.zeros_(fusion.gate.weight)
        with torch.no_grad():
            fusion.gate.bias[DIM : 2 * DIM] = -200.0
        context = fusion(encoded)
        silent = fusion(encoded | {"sensor": torch.randn_like(encoded["sensor"])})
        heard = fusion(encoded | {"state": torch.randn_like(encoded["state"])})
        assert torch.equal(silent, context)
        assert (heard - context).abs().max() > 1e-2

    def test_the_unit_is_that_of_the_paper(self, fusion, encoded):
        seen = []
        fusion.read_out.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
        fusion(encoded)
        x, gates = fusion.vectors(encoded), fusion.gates(fusion.vectors(encoded))
        expected = sum(gates[name] * fusion.content[name](x[name]).tanh() for name in SHAPES)
        torch.testing.assert_close(seen[0], expected)


def test_without_fusion_a_token_stays_itself_and_knows_its_stream():
    fusion = NoFusion({"sensor": (1, 6), "state": (1, 6)}, DIM)
    one = torch.randn(1, 1, 6)
    context = fusion({"sensor": one, "state": one})
    changed = fusion({"sensor": one, "state": one + torch.randn(6)})
    assert torch.equal(changed[:, 0], context[:, 0])
    for project in fusion.tokens.projects.values():
        torch.nn.init.ones_(project.weight)
    same = fusion({"sensor": one, "state": one})
    assert (same[:, 0] - same[:, 1]).abs().max() > 1e-3
