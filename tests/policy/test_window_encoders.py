"""What all window encoders guarantee, and what each of them does on its own."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from pipeline.base.errors import ConfigError
from pipeline.policy.ages import at_even_ages, even_ages
from pipeline.policy.attention import right_aligned
from pipeline.policy.encoders import (
    ForceAwareSensorEncoder,
    HalvingBlock,
    RobotStateEncoder,
    SensorEncoder,
)

CHANNELS, WINDOW, OUTPUT = 9, 13, 24
ENCODERS: dict[str, Callable[[], nn.Module]] = {
    "sensor": lambda: SensorEncoder(CHANNELS, WINDOW, (16, 32), 1, 2, OUTPUT),
    "force-aware sensor": lambda: ForceAwareSensorEncoder(CHANNELS, WINDOW, (16, 32), 1, 2, OUTPUT),
    "state": lambda: RobotStateEncoder(CHANNELS, WINDOW, 16, 1, 2, OUTPUT, patch=4),
}


@pytest.fixture(params=ENCODERS)
def encoder(request):
    return ENCODERS[request.param]()


def learned(encoder: nn.Module, name: str) -> list[nn.Parameter]:
    """The parameters of this name in every branch, in the order in which branches are joined."""
    return [p for path, p in encoder.named_parameters() if path.split(".")[-1] == name]


def windows(batch: int = 14) -> Tensor:
    return torch.randn(batch, WINDOW, CHANNELS)


class TestWindowEncoderContract:
    def test_padding_never_reaches_the_output(self, encoder):
        values, valid = windows(), torch.arange(14)
        changed = values.clone()
        for row, real in enumerate(valid.tolist()):
            changed[row, : WINDOW - real] = torch.nan if row % 2 else 7.0
        assert torch.equal(encoder(values, valid), encoder(changed, valid))

    def test_padding_never_reaches_a_gradient(self, encoder):
        values = windows().requires_grad_()
        encoder(values, torch.arange(14)).square().sum().backward()
        assert values.grad is not None
        reached = values.grad.abs().sum(dim=-1) > 0
        expected = torch.arange(WINDOW) >= WINDOW - torch.arange(14).unsqueeze(-1)
        assert torch.equal(reached, expected)

    def test_every_real_reading_counts_but_the_number_of_batch_mates_does_not(self, encoder):
        values, valid = windows(), torch.arange(14)
        together = encoder(values, valid)
        # The reading of this age is real in the rows that have so many.
        for age in range(1, WINDOW + 1):
            changed = values.clone()
            changed[:, WINDOW - age] += 1.0
            differs = (encoder(changed, valid) != together).any(dim=-1)
            assert torch.equal(differs, valid >= age)
        alone = torch.cat([encoder(values[i : i + 1], valid[i : i + 1]) for i in range(14)])
        torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-4)

    def test_a_missing_stream_is_a_learned_embedding(self, encoder):
        encoded = encoder(windows(3), torch.tensor([0, 13, 0]))
        missing = learned(encoder, "missing")
        assert torch.equal(encoded[0], torch.cat(missing))
        assert torch.equal(encoded[0], encoded[2])
        encoded.square().sum().backward()
        for embedding in missing:
            assert embedding.grad is not None
            assert embedding.grad.abs().min() > 0

    def test_valid_defaults_to_all(self, encoder):
        values = windows(2)
        assert torch.equal(encoder(values), encoder(values, torch.tensor([13, 13])))

    def test_bf16_autocast_is_finite_and_near_float32(self, encoder):
        values, valid = windows(), torch.arange(14)
        exact = encoder(values, valid)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            rough = encoder(values, valid)
            rough.float().sum().backward()
        assert torch.isfinite(rough).all()
        torch.testing.assert_close(rough.float(), exact, atol=0.05, rtol=0.05)
        assert all(torch.isfinite(p.grad).all() for p in encoder.parameters() if p.grad is not None)


@pytest.mark.parametrize("real", [1, 8])
def test_a_halving_block_sees_padding_as_the_end_of_the_signal(real):
    block = HalvingBlock(CHANNELS, 16)
    values = torch.randn(2, WINDOW, CHANNELS)
    short, _ = block(values[:, -real:], torch.ones(2, real, dtype=torch.bool))
    mask = right_aligned(torch.tensor([real, real]), WINDOW)
    padded, valid = block(values.masked_fill(~mask.unsqueeze(-1), 0.0), mask)
    torch.testing.assert_close(padded[:, -short.shape[1] :], short)
    assert not padded[~valid].any()


def test_sensor_encoder_takes_any_window_and_channel_count():
    for window, channels in ((1, 1), (2, 6), (3, 1), (16, 6)):
        encoder = SensorEncoder(channels, window, (8, 8), 1, 2, 5)
        assert encoder(torch.randn(2, window, channels)).shape == (2, 5)


@pytest.mark.parametrize("length", [5, 130])
def test_windows_of_another_length_are_resampled_without_leaks(length, encoder):
    values, valid = torch.randn(3, length, CHANNELS), torch.tensor([0, length // 2, length])
    changed = values.clone()
    changed[0] = float("nan")
    changed[1, : length - length // 2] = float("nan")
    assert torch.equal(encoder(values, valid), encoder(changed, valid))


def recorded(rate_hz: float, span_s: float, begun_s: float = 0.0) -> tuple[Tensor, Tensor]:
    """Windows (1, reading, channel) of slow waves at a rate, and the ages of their readings."""
    count = int(span_s * rate_hz + 1e-6)
    age = (begun_s + torch.arange(count - 1, -1, -1) / rate_hz)[None]
    phase = torch.linspace(0, 3, CHANNELS)
    return torch.sin(2 * torch.pi * 0.4 * (age[..., None] - phase)), age


class TestAges:
    def test_a_signal_recorded_at_two_rates_gives_the_same_context(self):
        """But for a twentieth: what interpolation misses of a wave of 2.5 s read at 10 Hz."""
        for kind in (SensorEncoder, ForceAwareSensorEncoder, RobotStateEncoder):
            encoder = kind(CHANNELS, 100, output_dim=OUTPUT, span_s=1.0).eval()
            contexts = []
            for rate_hz in (10, 100, 650):
                values, age = recorded(rate_hz, 1.0)
                contexts.append(encoder(values, torch.tensor([values.shape[1]]), age))
            still = encoder(torch.zeros_like(values), torch.tensor([values.shape[1]]), age)
            size = (contexts[1] - still).norm()
            for context in contexts:
                assert (context - contexts[1]).norm() < 0.05 * size

    def test_by_their_order_alone_they_differ(self):
        encoder = SensorEncoder(CHANNELS, 100, (16, 32), 1, 2, OUTPUT, span_s=None)
        (slow, _), (fast, _) = recorded(10, 1.0), recorded(100, 1.0)
        contexts = [encoder(values[:, -10:]) for values in (slow, fast)]
        assert (contexts[0] - contexts[1]).norm() > 0.1 * contexts[1].norm()

    def test_a_stalled_stream_differs_from_a_fresh_one(self, encoder):
        values = windows(1)[:, -3:]
        age = torch.tensor([[0.002, 0.001, 0.0]])
        fresh = encoder(values, torch.tensor([3]), age)
        stalled = encoder(values, torch.tensor([3]), age + 0.05)
        assert (fresh - stalled).abs().max() > 1e-3

    def test_a_gap_is_no_reading(self):
        valid, age = torch.ones(1, 20, dtype=torch.bool), torch.arange(19.0, -1, -1)[None] / 20
        valid[0, 8:14] = False
        _, stands = at_even_ages(torch.zeros(1, 20, 1), valid, age, 20, 1.0)
        assert stands[0].tolist() == [True] * 9 + [False] * 4 + [True] * 7

    @pytest.mark.parametrize(("readings", "real"), [(7, 1), (26, 5), (300, 7)])
    def test_a_constant_stays_constant_beside_padding(self, readings, real):
        valid = torch.arange(readings)[None] >= readings - real
        values = torch.where(valid[..., None], 5.0, float("nan")).expand(1, readings, 2)
        age = even_ages(readings, 1.0, values)[None]
        placed, stands = at_even_ages(values, valid, age, 13, 1.0)
        torch.testing.assert_close(placed[stands], torch.full_like(placed[stands], 5.0))
        assert stands[0, -1]
        assert not placed[~stands].any()
        assert bool(stands[0, 0]) == (real == readings)


def test_state_patches_know_which_readings_are_real():
    """A reading of zeros is the mean state, not padding."""
    encoder = RobotStateEncoder(CHANNELS, WINDOW, 16, 1, 2, OUTPUT, patch=4)
    zeros = torch.zeros(2, WINDOW, CHANNELS)
    encoded = encoder(zeros, torch.tensor([1, 3]))
    assert (encoded[0] - encoded[1]).abs().max() > 1e-3


def test_default_sizes_are_the_seeds():
    with torch.device("meta"):
        sensor, state = SensorEncoder(), RobotStateEncoder()
    assert [tuple(block.down.weight.shape) for block in sensor.blocks] == [
        (512, 2 * 1026),
        (1024, 2 * 512),
        (1024, 2 * 1024),
        (1024, 2 * 1024),
    ]
    assert sum(p.numel() for p in sensor.parameters()) == 35457024
    assert sum(p.numel() for p in state.parameters()) == 2020096


class TestForce:
    """Channel 0, one of 1,026."""

    def test_its_branch_hears_nothing_else_and_the_other_never_hears_it(self):
        encoder = ForceAwareSensorEncoder(CHANNELS, WINDOW, (16, 32), 1, 2, OUTPUT)
        values = windows(2)
        before = encoder(values)
        force, scan = values.clone(), values.clone()
        force[..., 0] += 1.0
        scan[..., 1:] += torch.randn_like(scan[..., 1:])
        own = OUTPUT // 4
        assert torch.equal(encoder(force)[:, own:], before[:, own:])
        assert torch.equal(encoder(scan)[:, :own], before[:, :own])
        assert (encoder(force)[:, :own] - before[:, :own]).abs().max() > 1e-2
        assert (encoder(scan)[:, own:] - before[:, own:]).abs().max() > 1e-2

    @pytest.mark.parametrize(("channels", "output"), [(1, 8), (9, 1)])
    def test_no_room_for_two_branches_is_refused(self, channels, output):
        with pytest.raises(ConfigError, match=r"force_aware.*kind: joint"):
            ForceAwareSensorEncoder(channels, WINDOW, (16, 32), 1, 2, output)

    def test_default_sizes_are_the_seeds_and_a_quarter_for_force(self):
        with torch.device("meta"):
            encoder = ForceAwareSensorEncoder()
        assert encoder.scan.blocks[0].down.weight.shape == (512, 2 * 1025)
        assert encoder.force.blocks[0].down.weight.shape == (128, 2)
        assert encoder.force.missing.shape == (256,)
        assert encoder.scan.missing.shape == (768,)
        assert sum(p.numel() for p in encoder.parameters()) == 36892672
