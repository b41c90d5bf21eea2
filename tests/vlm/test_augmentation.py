"""Augmented variants are small, lawful changes that depend on what is shown and on nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pipeline.base.config import AugmentationParams
from pipeline.vlm.augmentation import Augmentation
from pipeline.vlm.feature_spec import AUGMENTATION_VERSION

KEY = bytes(range(16))
PLAIN = Augmentation(0.0, 1.0, (0.0, 0.0), 1.0, 1.0, 1.0)

GOLDEN_DRAW = [
    4.383235060258086,
    0.939893097954117,
    -0.0066152925915543125,
    0.02828732060499131,
    0.8279398402138759,
    0.9828019572951286,
    0.8920166787939391,
]
GOLDEN_PIXELS = [
    [[9, 5, 186], [52, 12, 165], [94, 17, 144]],
    [[10, 49, 176], [53, 55, 155], [95, 61, 135]],
    [[11, 92, 166], [53, 99, 145], [95, 105, 125]],
]


def drawn(variant=1, view="View1", key=KEY, **params):
    return Augmentation.drawn(AugmentationParams(**params), key, view, variant)


def flat(one):
    return [one.rotation_deg, one.side, *one.offset, one.brightness, one.contrast, one.saturation]


@given(
    key=st.binary(min_size=16, max_size=16),
    variant=st.integers(1, 50),
    rotation_deg=st.floats(0, 45),
    crop=st.floats(0.1, 1),
    light=st.floats(0, 1),
)
def test_a_draw_stays_within_the_params(key, variant, rotation_deg, crop, light):
    found = drawn(
        variant,
        key=key,
        rotation_deg=rotation_deg,
        crop=crop,
        brightness=light,
        contrast=light,
        saturation=light,
    )
    assert abs(found.rotation_deg) <= rotation_deg
    assert crop <= found.side <= 1
    assert all(abs(offset) <= (1 - found.side) / 2 for offset in found.offset)
    for factor in (found.brightness, found.contrast, found.saturation):
        assert 1 - light <= factor <= 1 + light


def test_row_view_variant_and_seed_each_draw_anew():
    every = {
        drawn(),
        drawn(variant=2),
        drawn(view="View2"),
        drawn(key=KEY[::-1]),
        drawn(seed=1),
    }
    assert len(every) == 5
    assert drawn() == drawn()


def test_what_a_draw_is_belongs_to_its_version():
    """Changed numbers: raise AUGMENTATION_VERSION, or stores would mix two meanings."""
    assert AUGMENTATION_VERSION == 1
    one = drawn()
    assert flat(one) == pytest.approx(GOLDEN_DRAW, abs=1e-12)
    y, x = np.mgrid[0:60, 0:80]
    frame = np.stack([2 * x, 3 * y, 255 - x - y], axis=-1).astype(np.uint8)
    changed = one.apply(frame)
    # Rounding may differ by a level with Pillow's version.
    assert np.abs(changed[::20, ::30].astype(int) - GOLDEN_PIXELS).max() <= 1


def test_nothing_asked_is_nothing_changed(make_frame):
    frame = make_frame(0)
    none = drawn(rotation_deg=0, crop=1, brightness=0, contrast=0, saturation=0)
    assert none == PLAIN
    assert np.array_equal(none.apply(frame), frame)


def test_a_stretched_frame_turns_as_the_camera_saw_it(make_frame):
    def wide(image):
        return np.asarray(Image.fromarray(image).resize((400, 160), Image.Resampling.BICUBIC))

    frame = make_frame(4, 200, 200)
    turned = replace(PLAIN, rotation_deg=12.0)
    found, expected = turned.apply(wide(frame), widened=2.5), wide(turned.apply(frame))
    assert np.abs(found.astype(int) - expected).mean() < 2
    assert np.abs(turned.apply(wide(frame)).astype(int) - expected).mean() > 10


@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    angle=st.floats(-45, 45),
    side=st.floats(0.05, 1),
    where=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
)
def test_no_size_or_draw_shows_what_the_frame_has_not(height, width, angle, side, where):
    frame = np.full((height, width, 3), (200, 90, 30), np.uint8)
    offset = (where[0] * (1 - side) / 2, where[1] * (1 - side) / 2)
    found = replace(PLAIN, rotation_deg=angle, side=side, offset=offset).apply(frame)
    assert found.shape == frame.shape
    assert np.array_equal(found, frame), "beyond its edge the frame is mirrored, not black"


def test_variant_0_is_the_plain_row_and_all_have_its_layout(extractor, make_frame):
    ours = extractor(variants=3)
    frames = {"View1": make_frame(0), "View2": make_frame(1)}
    key = ours.spec.row_key("prompt", frames)
    rows = ours.preparer.prepare_variants("go", frames, key)
    plain = extractor().preparer.prepare("go", frames)
    assert len(rows) == 3
    assert np.array_equal(rows[0].pixels, plain.pixels)
    assert {row.layout for row in rows} == {plain.layout}
    for a, b in ((0, 1), (0, 2), (1, 2)):
        for view in range(2):
            assert (rows[a].pixels[view] != rows[b].pixels[view]).mean() > 0.5
    (only,) = extractor().preparer.prepare_variants("go", frames, KEY)
    assert np.array_equal(only.pixels, plain.pixels)
