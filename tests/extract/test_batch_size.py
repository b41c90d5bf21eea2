"""The batch size grows while that pays, by a clock that the test holds."""

import itertools

import pytest
import torch

from pipeline.base.errors import VLMError
from pipeline.extract.encoder import BatchSize


def settled(seconds_of, device="cpu", batches=200) -> BatchSize:
    """Full batches of rows of 10 tokens, each taking `seconds_of` its size."""
    size = BatchSize("auto", device)
    for _ in range(batches):
        size.note(size.current, 10 * size.current, seconds_of(size.current))
    return size


@pytest.mark.parametrize(
    ("seconds_of", "expected"),
    [
        (lambda rows: rows, 8),  # nothing gained by another row
        (lambda rows: max(rows, 32) + 40 * (rows == 16), 32),  # one size has a hiccup
        (lambda rows: 1.0 + rows, 32),  # 33 -> 32 x 2 + 1: a gain of 1.6 %
        (lambda rows: 1.0, 64),  # the most that a CPU is given
    ],
)
def test_it_doubles_while_that_is_faster(seconds_of, expected):
    size = settled(seconds_of)
    assert size.settled
    assert size.current == expected


def test_a_gpu_is_given_more():
    assert settled(lambda rows: 1.0, "cuda").current == 512


def test_the_first_batch_of_a_size_only_warms_up():
    size = BatchSize("auto")
    for seconds in [0.001] + [1.0] * 3 + [100.0] + [1.0] * 3:
        size.note(size.current, size.current, seconds)
    assert size.current == 32
    assert not size.settled


def test_one_quiet_batch_of_three_is_enough():
    """The others are slowed by what else the machine does, by a different amount each."""
    slowed = itertools.count(1)
    size = BatchSize("auto")
    for _ in range(4):  # 8, 16, and past it two sizes that gain nothing
        size.note(size.current, size.current, 0.0)  # warms up
        for number in range(3):
            took = max(size.current, 16)
            slower = 1 if number == 1 else 1 + next(slowed)
            size.note(size.current, size.current, took * slower)
    assert (size.current, size.settled) == (16, True)


def test_a_batch_of_an_earlier_size_says_nothing():
    size = BatchSize("auto")
    for _ in range(4):
        size.note(8, 8, 1.0)
    for _ in range(10):
        size.note(8, 8, 0.001)
    assert size.current == 16


def test_a_number_stays():
    size = BatchSize(6)
    for _ in range(20):
        size.note(6, 6, 1.0)
    assert (size.current, size.settled) == (6, True)


def test_out_of_memory_halves_and_settles(capsys):
    size = BatchSize("auto")
    for seconds in [1.0] * 4 + [2.0] * 4:  # 16 rows are no faster than 8
        size.note(size.current, size.current, seconds)
    error = torch.OutOfMemoryError("no room")
    size.halve(32, error)
    assert (size.current, size.settled) == (8, True), "the best that was measured"
    size.halve(8, error)
    assert (size.current, size.settled) == (4, True)
    assert "going on with batches of 4" in capsys.readouterr().err
    with pytest.raises(VLMError, match="out of memory with a single row"):
        size.halve(1, error)
