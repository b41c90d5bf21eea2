"""The three views show where needle and target stand, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.simulation.insertion import NeedleInsertion, Scene
from pipeline.simulation.rendering import HEIGHT, WIDTH, photograph, render

SCENE = Scene(np.array([-5.0, -3.0]), np.array([0.4, 0.3]), np.array([5.0, 2.0]), 1.0)


def middle(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean x and y of the pixels that are set."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()]) + 0.5


def red(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return (image[..., 0] > 180) & (image[..., 1] < 80)


def blue(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return (image[..., 2] > 110) & (image[..., 0] < 60)


@pytest.mark.parametrize("x", [-6.0, -2.0, 6.0])
@pytest.mark.parametrize("y", [-4.0, 0.0, 4.0])
def test_the_mark_and_the_hub_stand_where_they_are(x: float, y: float) -> None:
    needle = np.array([9.0 if x < 0 else -9.0, 0.0])
    scene = replace(SCENE, target_mm=np.array([x, y]), needle_mm=needle)
    centre = np.array([WIDTH, HEIGHT]) / 2
    above, side = render("View2", scene), render("View1", scene)
    np.testing.assert_allclose(middle(red(above)), centre + 8 * np.array([x, -y]), atol=1)
    hub = scene.needle_mm + scene.lean_mm
    np.testing.assert_allclose(middle(blue(above)), centre + 8 * hub * [1, -1], atol=1)
    for mask, place in ((red(side), scene.target_mm), (blue(side), hub)):
        assert abs(middle(mask)[0] - (centre[0] + 10 * place.sum() / np.sqrt(2))) < 1


def test_the_hand_eye_view_shows_the_offset_alone() -> None:
    # Below the needle's tip the shaft would hide a part of the mark.
    offset = np.array([-6.0, 3.0])
    centre = np.array([WIDTH, HEIGHT]) / 2
    for needle in (np.array([-1.0, -1.0]), np.array([2.0, 1.0])):
        image = render("View5", replace(SCENE, needle_mm=needle, target_mm=needle + offset))
        np.testing.assert_allclose(middle(red(image)), centre + 7 * offset * [1, -1], atol=1)


def test_the_side_view_does_not_show_depth_into_the_image() -> None:
    aside = np.array([1.5, -1.5])
    needle, target = SCENE.needle_mm + aside, SCENE.target_mm - aside
    nearer = replace(SCENE, needle_mm=needle, target_mm=target)
    np.testing.assert_array_equal(render("View1", SCENE), render("View1", nearer))


def test_a_frame_is_the_image_with_noise_that_favours_no_side() -> None:
    insertion = NeedleInsertion()
    insertion.reset(5, "full")
    frame = photograph("View2", insertion, 0.0)
    noise = frame.astype(float) - render("View2", insertion.scene(0.0))
    assert noise.mean() == pytest.approx(0, abs=0.05)
    assert noise.std() == pytest.approx(2, abs=0.1)
    assert (photograph("View2", insertion, 0.0) == frame).all()
