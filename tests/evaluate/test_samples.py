"""What several samples say beside one, against values worked out by hand."""

import numpy as np
import pytest

from pipeline.evaluate.evaluation import BEST, MEAN, SampledChunks

CHUNKS = np.array([[[[0.0, 9.0], [0.0, 9.0]]], [[[4.0, 9.0], [2.0, 9.0]]]], np.float32)
"""Two samples of one tick, two steps, two dimensions of which the second never varies."""
RECORDED = np.array([[[1.0, 0.0], [1.0, 0.0]]], np.float32)
SCALE = np.array([2.0, 0.0])


def taken(valid: list[bool], chunks: np.ndarray = CHUNKS) -> SampledChunks:
    sampled = SampledChunks(SCALE)
    sampled(chunks, RECORDED, np.array([valid]))
    return sampled


def test_the_mean_and_the_best_of_two() -> None:
    chunks = taken([True, True]).chunks()
    assert chunks[MEAN][0, :, 0].tolist() == [2.0, 1.0]
    assert chunks[BEST][0, :, 0].tolist() == [0.0, 0.0]


def test_what_lies_beyond_the_end_picks_no_best() -> None:
    reversed_end = CHUNKS.copy()
    reversed_end[0, 0, 1, 0] = 1e9
    assert taken([True, False], reversed_end).chunks()[BEST][0, 0, 0] == 0.0


def test_the_energy_score_by_hand() -> None:
    """Distances in std over sqrt(2): (0, 0), (2, 1) to (0.5, 0.5), and to each other."""
    distance = (np.hypot(0.5, 0.5) + np.hypot(1.5, 0.5)) / 2
    expected = (distance - np.hypot(2, 1) / 2) / np.sqrt(2)
    assert taken([True, True]).energy() == pytest.approx([expected])
    first = (0.5 + 1.5) / 2 - 2 / 2
    assert taken([True, False]).energy() == pytest.approx([first])


def test_the_energy_score_is_lowest_for_the_distribution_that_was_recorded_from() -> None:
    rng = np.random.default_rng(0)

    def score(spread: float) -> float:
        sampled = SampledChunks(np.ones(2))
        recorded = rng.normal(size=(1000, 1, 2))
        chunks = spread * rng.normal(size=(6, 1000, 1, 2))
        sampled(chunks, recorded, np.ones((1000, 1), bool))
        return float(sampled.energy().mean())

    assert score(1.0) < min(score(0.3), score(2.0))


def test_of_one_sample_there_is_nothing_to_say() -> None:
    sampled = taken([True, True], CHUNKS[:1])
    assert sampled.chunks() == {} and len(sampled.energy()) == 0
