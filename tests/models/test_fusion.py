import torch

from pipeline.models import ConcatFusion


def test_context_shape_and_every_encoder_matters() -> None:
    fusion = ConcatFusion({"features": 6, "sensor": 4}, 16, tokens=3)
    encoded = {"features": torch.randn(2, 6), "sensor": torch.randn(2, 4)}
    context = fusion(encoded)
    assert context.shape == (2, 3, 16)
    for name, vector in encoded.items():
        changed = fusion(encoded | {name: torch.randn_like(vector)})
        assert (changed - context).abs().max() > 1e-2


def test_no_encoder_drowns_the_others_by_its_scale() -> None:
    fusion = ConcatFusion({"features": 6, "sensor": 4}, 16)
    encoded = {"features": torch.randn(2, 6), "sensor": torch.randn(2, 4)}
    loud = encoded | {"sensor": 1e4 * encoded["sensor"]}
    torch.testing.assert_close(fusion(encoded), fusion(loud), atol=1e-3, rtol=1e-3)
