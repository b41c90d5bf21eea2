"""Rows -> batches -> features: grouping, one batch ahead, out of memory, what is not finite."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch

from pipeline.base.errors import NumericsError, VLMError
from pipeline.extract.encoder import Encoder
from pipeline.extract.rows import ReadyRow
from pipeline.vlm.preparation import PreparedRow, TokenLayout

K = 3


@dataclass
class FakePending:
    """Features that are looked at only when they are asked for."""

    vlm: "FakeVLM"
    values: torch.Tensor
    model_s: float
    done: bool

    def result(self) -> tuple[torch.Tensor, None]:
        self.vlm.log.append(f"result {len(self.values)}")
        if (bad := (self.values == 255).nonzero()).numel():
            raise NumericsError(f"row {int(bad[0])} of the batch: expected finite features")
        features = self.values[:, None, None] + torch.tensor([0.0, 0.5])[:, None]
        return features.to(self.vlm.dtype), None


@dataclass
class FakeVLM:
    """Says of each row its pixel value in both slots; refuses more rows than it has memory for.

    A batch takes `overhead_s` and a second a row.
    """

    device = torch.device("cpu")
    room: int = 10**6
    dtype: torch.dtype = torch.float32
    overhead_s: float = 0.0
    synchronous: bool = False
    batches: list[int] = field(default_factory=list)
    log: list[str] = field(default_factory=list)

    def submit(self, rows: list[PreparedRow]) -> FakePending:
        self.batches.append(len(rows))
        self.log.append(f"submit {len(rows)}")
        if len(rows) > self.room:
            raise torch.OutOfMemoryError("too many")
        values = torch.tensor([float(row.pixels.flat[0]) for row in rows])
        return FakePending(self, values, self.overhead_s + len(rows), self.synchronous)

    def encode(self, rows: list[PreparedRow]) -> Any:
        return self.submit(rows).result()


def ready(row: int, values: list[int], length: int = 1) -> ReadyRow:
    layout = TokenLayout(length, (), (1, 1))
    plain = PreparedRow("p", np.zeros(length, np.int64), np.zeros((1, 1, 1, 3), np.uint8), layout)
    variants = tuple(
        dataclasses.replace(plain, pixels=np.full((1, 1, 1, 3), value, np.uint8))
        for value in values
    )
    return ReadyRow(row, bytes(16), variants, f"recording, VL row {row}")


def encoder_of(vlm: FakeVLM, batch_size: Any, variants: int = K) -> Encoder:
    return Encoder(vlm, batch_size, variants)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("batch_size", "room", "passes"),
    [
        (6, 99, [6, 6, 3]),
        (2, 99, [2, 1] * 5),  # less than a row's variants: a row takes two passes
        (12, 4, [12, 6, 3, 3, 3, 3, 3]),  # out of memory: 12 -> 6 -> 3
        (12, 2, [12, 6, 3, 1, 1, 1, *[1] * 12]),
    ],
)
def test_any_batch_size_gives_the_rows_variant_after_variant(batch_size, room, passes):
    vlm = FakeVLM(room)
    rows = [ready(row, [10 * row, 10 * row + 1, 10 * row + 2]) for row in range(5)]
    found = {}
    for batch, features in encoder_of(vlm, batch_size).encoded(rows):
        assert features.shape == (len(batch), K * 2, 1)
        found |= {one.row: features[i, :, 0].tolist() for i, one in enumerate(batch)}
    assert found == {
        row: [10 * row + variant + half for variant in range(K) for half in (0, 0.5)]
        for row in range(5)
    }
    assert vlm.batches == passes


def test_one_batch_is_ahead_of_what_is_handed_out():
    vlm = FakeVLM()
    encoder = encoder_of(vlm, 2, variants=1)
    encoded = encoder.encoded(ready(row, [row]) for row in range(6))
    next(encoded)
    assert vlm.log == ["submit 2", "submit 2", "result 2"]
    assert encoder.model_s == 2
    assert len(list(encoded)) == 2
    assert vlm.log[3:] == ["submit 2", "result 2", "result 2"]
    assert encoder.model_s == 6


def test_what_is_done_is_not_held_back():
    vlm = FakeVLM(synchronous=True)
    encoded = encoder_of(vlm, 2, variants=1).encoded(ready(row, [row]) for row in range(6))
    next(encoded)
    assert vlm.log == ["submit 2", "result 2"]
    assert len(list(encoded)) == 2


def test_rows_of_one_shape_stand_together_and_few_wait():
    vlm = FakeVLM()
    rows = [ready(row, [row], length=row % 3 + 1) for row in range(9)]
    batches = [[one.row for one in rows] for rows, _ in encoder_of(vlm, 3, 1).encoded(rows)]
    assert batches == [[0, 3, 6], [1, 4, 7], [2, 5, 8]]
    taken = []

    def counted():
        for row in range(30):
            taken.append(row)
            yield ready(row, [row], length=row + 1)

    encoded = encoder_of(FakeVLM(), 2, 1).encoded(counted())
    next(encoded)
    assert len(taken) <= 2 * 4 + 1, "many shapes: a batch goes before it is full"
    assert sum(len(rows) for rows, _ in encoded) == 29


def test_bfloat16_is_stored_as_its_bits():
    encoder = encoder_of(FakeVLM(dtype=torch.bfloat16), 2)
    ((_, bits),) = encoder.encoded([ready(0, [1, 2, 3])])
    assert bits.dtype == np.uint16
    values = torch.from_numpy(bits).view(torch.bfloat16)[0, :, 0]
    assert values.tolist() == [1.0, 1.5, 2.0, 2.5, 3.0, 3.5]


def test_no_room_for_a_single_variant_is_an_error():
    with pytest.raises(VLMError, match="out of memory with a single row"):
        list(encoder_of(FakeVLM(0), 8).encoded([ready(0, [1, 2, 3])]))


def test_a_feature_that_is_not_finite_names_row_and_variant_and_spares_the_others():
    encoder = encoder_of(FakeVLM(), 9)
    rows = [ready(0, [1, 2, 3]), ready(1, [4, 5, 255]), ready(2, [6, 7, 8])]
    handed_out = []
    with pytest.raises(NumericsError, match="recording, VL row 1, variant 2: row 0 of the"):
        handed_out += [one.row for batch, _ in encoder.encoded(rows) for one in batch]
    encoded = encoder_of(FakeVLM(), 9).encoded(rows)
    assert [one.row for one in next(encoded)[0]] == [0]


def test_a_batch_that_is_not_full_says_nothing_about_its_size():
    encoder = encoder_of(FakeVLM(overhead_s=100.0), "auto", 1)
    for _ in range(9):
        assert len(list(encoder.encoded([ready(0, [1]), ready(1, [2])]))) == 1
    assert encoder.size.current == 8
