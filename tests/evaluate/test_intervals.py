"""The bootstrap over groups: what it covers, what it draws together, where there is nothing."""

import numpy as np

from pipeline.evaluate.intervals import bootstrap_means, interval


def test_the_interval_covers_the_mean_about_as_often_as_it_promises() -> None:
    generator = np.random.default_rng(3)
    covered = 0
    for seed in range(200):
        sums = generator.normal(1.0, 2.0, (40, 1))
        low, high = interval(bootstrap_means(sums, np.ones((40, 1)), 500, seed))
        covered += bool(low[0] <= 1.0 <= high[0])
    assert 0.88 <= covered / 200 <= 0.99


def test_a_draw_is_the_ratio_of_its_sums_so_long_groups_weigh_more() -> None:
    sums, counts = np.array([[2.0], [90.0]]), np.array([[1.0], [10.0]])
    draws = bootstrap_means(sums, counts, 400)
    assert {round(float(value), 9) for value in draws[:, 0]} == {2.0, round(92 / 11, 9), 9.0}


def test_equal_seeds_draw_equal_groups_so_differences_are_paired() -> None:
    first = np.arange(12.0)[:, None]
    counts = np.ones((12, 1))
    apart = bootstrap_means(first + 0.5, counts) - bootstrap_means(first, counts)
    assert np.allclose(apart, 0.5)
    together = bootstrap_means(np.hstack([first, first + 0.5]), counts)
    assert np.array_equal(together[:, :1], bootstrap_means(first, counts))


def test_a_figure_that_no_drawn_group_counts_is_no_number_and_others_stay() -> None:
    sums, counts = np.array([[1.0, 0.0], [3.0, 0.0]]), np.array([[1.0, 0.0], [1.0, 0.0]])
    low, high = interval(bootstrap_means(sums, counts))
    assert (low[0], high[0]) == (1.0, 3.0)
    assert np.isnan(low[1])
    assert np.isnan(high[1])
