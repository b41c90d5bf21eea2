"""The physics: what is measured follows from the geometry, and stays hidden where it must."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.simulation.arm import euler_actions, orientation
from pipeline.simulation.expert import ALIGNED_MM, REACTION_TICKS
from pipeline.simulation.insertion import MAX_TICKS, InsertionObservation, NeedleInsertion
from pipeline.simulation.layout import WORKSPACE_MM, InsertionLayout, draw_layout
from pipeline.simulation.needle_sensor import BIN_MM
from pipeline.simulation.rendering import VIEWS, render

STILL = np.zeros(7)


def down(step_mm: float) -> NDArray[np.float64]:
    """An action that only descends."""
    return np.array([0, 0, -step_mm, 0, 0, 0, 1.0])


def calm(seed: int = 0) -> InsertionLayout:
    """An episode in which nobody pushes the phantom."""
    return replace(draw_layout(seed), push_times_s=np.zeros(0))


def follow(insertion: NeedleInsertion) -> Iterator[InsertionObservation]:
    """The demonstrator's episode from here on."""
    while not insertion.finished:
        yield insertion.step(insertion.expert_action())


def peak_bin(observation: InsertionObservation) -> int:
    """The brightest bin of the newest A-scan."""
    return int(observation.sensor[-1, 1:].argmax())


def test_same_seed_and_actions_give_the_same_bits() -> None:
    runs: list[list[InsertionObservation]] = []
    for _ in range(2):
        insertion = NeedleInsertion()
        runs.append([insertion.reset(3), *follow(insertion)])
    for first, second in zip(*runs, strict=True):
        np.testing.assert_array_equal(first.sensor, second.sensor)
        np.testing.assert_array_equal(first.state, second.state)
        np.testing.assert_array_equal(render("View2", first.scene), render("View2", second.scene))


def test_observing_again_changes_nothing() -> None:
    insertion = NeedleInsertion()
    first = insertion.reset(1)
    action = insertion.expert_action()
    np.testing.assert_array_equal(insertion.observe().sensor, first.sensor)
    np.testing.assert_array_equal(insertion.expert_action(), action)


def test_a_scan_peaks_at_the_tip_to_tissue_distance() -> None:
    insertion = NeedleInsertion()
    observation = insertion.start(calm())
    while insertion.contact.distance_mm[-1] > 0.3:
        # Held still: an A-scan is up to four readings old.
        observation = insertion.step(STILL)
        distance = insertion.knots[-1].pose[2] - insertion.knots[-1].surface_mm
        assert abs(peak_bin(observation) * BIN_MM - distance) <= 2 * BIN_MM
        insertion.step(down(0.17))
    assert peak_bin(observation) < 150


def test_the_layer_is_the_second_peak_until_it_is_the_only_one() -> None:
    insertion = NeedleInsertion()
    layout = calm()
    surface, depth = layout.surfaces_mm[0], layout.tissue.layer_depth_mm
    start = layout.start_pose.copy()
    start[2] = surface + 1.0
    observation = insertion.start(replace(layout, start_pose=start))
    behind = observation.sensor[-1, 1:].copy()
    behind[: int(1.0 / BIN_MM) + 60] = 0
    # The layer stands on a slope of scattered light, which pulls its peak towards the tip.
    assert abs(behind.argmax() * BIN_MM - (1.0 + depth)) < 0.05
    while not insertion.inside:
        insertion.step(down(0.2))
    observation = insertion.step(STILL)
    inside = observation.sensor[-1, 1:].copy()
    inside[:150] = 0
    assert abs(inside.argmax() * BIN_MM - insertion.contact.layer_mm[-1]) < 0.05


def test_beyond_the_range_nothing_is_seen() -> None:
    layout = calm()
    start = layout.start_pose.copy()
    start[2] = layout.surfaces_mm[0] + 8.0
    scan = NeedleInsertion().start(replace(layout, start_pose=start)).sensor[-1, 1:]
    assert np.ptp(scan) <= 4


def test_force_rises_on_contact_drops_at_puncture_and_grows_with_depth() -> None:
    insertion = NeedleInsertion()
    insertion.start(calm())
    force, depth, inside = [], [], []
    for _ in range(60):
        observation = insertion.step(down(0.12))
        force.append(insertion.contact.force_n.copy())
        now = insertion.knots[-1]
        before = insertion.knots[-2]
        part = np.arange(1, 66) / 65
        depth.append(now.surface_mm - (before.pose[2] + part * (now.pose[2] - before.pose[2])))
        inside.append(insertion.contact.inside.copy())
        # The gauge reads the true force but for noise and a slow drift of 20 mN.
        assert np.abs(observation.sensor[:, 0] - insertion.contact.force_n).max() < 0.08
    f, d, i = (np.concatenate(rows) for rows in (force, depth, inside))
    assert (f[d <= 0] == 0).all() and (d <= 0).any()
    pressing = f[(d > 0) & ~i]
    assert (np.diff(pressing) > 0).all() and pressing[-1] < insertion.layout.tissue.puncture_n
    assert f[i][0] < 0.7 * pressing[-1]
    assert (np.diff(f[i]) > 0).all()
    assert (np.diff(i.astype(int)) >= 0).all()


def test_a_needle_pulled_out_must_puncture_again() -> None:
    insertion = NeedleInsertion()
    insertion.start(calm())
    while not insertion.inside:
        insertion.step(down(0.2))
    while insertion.inside:
        insertion.step(down(-0.2))
    assert insertion.contact.force_n[-1] == 0
    while insertion.contact.distance_mm[-1] > 0:
        insertion.step(down(0.2))
    insertion.step(down(0.05))
    assert not insertion.inside and insertion.contact.force_n[-1] > 0


def twins(
    first: InsertionLayout, second: InsertionLayout
) -> Iterator[tuple[NeedleInsertion, NeedleInsertion]]:
    """Both episodes under the demonstrator's actions in the first, tick by tick."""
    one, other = NeedleInsertion(), NeedleInsertion()
    one.start(first)
    other.start(second)
    yield one, other
    while not one.finished:
        action = one.expert_action()
        one.step(action)
        other.step(action)
        yield one, other


@pytest.mark.parametrize("seed", [0, 4, 11])
def test_depth_does_not_show_in_images_or_state(seed: int) -> None:
    layout = draw_layout(seed)
    deeper = replace(
        layout,
        surfaces_mm=layout.surfaces_mm - 0.7,
        tissue=replace(layout.tissue, layer_depth_mm=layout.tissue.layer_depth_mm + 0.5),
    )
    sensed = False
    for tick, (one, other) in enumerate(twins(layout, deeper)):
        # From here on tissue that is nearer is no longer pushed.
        if one.contact.distance_mm[-1] < 1.2:
            break
        sensed |= not np.array_equal(one.observe().sensor, other.observe().sensor)
        np.testing.assert_array_equal(one.observe().state, other.observe().state)
        if tick % 4 == 0:
            for view in VIEWS:
                np.testing.assert_array_equal(
                    render(view, one.observe().scene), render(view, other.observe().scene)
                )
    assert sensed and tick > 5


@pytest.mark.parametrize("seed", [0, 4, 11])
def test_lateral_target_does_not_show_in_sensor_or_state(seed: int) -> None:
    layout = draw_layout(seed)
    mirrored = replace(layout, targets_mm=-layout.targets_mm)
    seen = 0
    for one, other in twins(layout, mirrored):
        first, second = one.observe(), other.observe()
        np.testing.assert_array_equal(first.sensor, second.sensor)
        np.testing.assert_array_equal(first.state, second.state)
        seen += not np.array_equal(render("View2", first.scene), render("View2", second.scene))
    assert seen == len(one.knots) - 1


def test_start_and_target_say_nothing_of_each_other() -> None:
    layouts = [draw_layout(seed) for seed in range(400)]
    targets = np.stack([layout.targets_mm[0] for layout in layouts])
    starts = np.stack([layout.start_pose for layout in layouts])
    heights = np.array([layout.surfaces_mm[0] for layout in layouts])
    clearance = starts[:, 2] - heights
    for known in starts.T[:3]:
        for hidden in (*targets.T, clearance):
            assert abs(np.corrcoef(known, hidden)[0, 1]) < 0.15


@pytest.mark.parametrize("seed", range(12))
def test_the_demonstrator_ends_at_the_layer_under_the_mark(seed: int) -> None:
    insertion = NeedleInsertion()
    insertion.reset(seed)
    for _ in follow(insertion):
        pass
    last = insertion.knots[-1]
    offset = last.target_mm - (last.pose[:2] - insertion.layout.bench_mm)
    if len(insertion.knots) <= MAX_TICKS:
        assert insertion.inside and abs(insertion.contact.layer_mm[-1]) < 0.1
        assert np.hypot(*offset) < 2 * ALIGNED_MM
        upright = orientation(insertion.layout.upright_deg)
        assert (orientation(last.pose[3:]) * upright.inv()).magnitude() < np.deg2rad(1.5)
    places = np.stack([knot.target_mm for knot in insertion.knots])
    assert (np.abs(places) <= WORKSPACE_MM).all()


def test_most_episodes_end_in_time_and_most_phantoms_are_pushed() -> None:
    ended, pushed = 0, 0
    for seed in range(100, 120):
        insertion = NeedleInsertion()
        insertion.reset(seed)
        for _ in follow(insertion):
            pass
        ended += insertion.inside
        pushed += not np.array_equal(insertion.knots[0].target_mm, insertion.knots[-1].target_mm)
    assert ended >= 17 and pushed >= 17


def test_the_demonstrator_reacts_to_a_push_only_after_its_reaction_time() -> None:
    layout = replace(draw_layout(2), push_times_s=np.array([0.65]))
    unpushed = replace(layout, push_times_s=np.zeros(0))
    one, other = NeedleInsertion(), NeedleInsertion()
    one.start(layout)
    other.start(unpushed)
    differs = []
    for _ in range(20):
        first, second = one.expert_action(), other.expert_action()
        differs.append(not np.array_equal(first, second))
        one.step(first)
        other.step(second)
    moved = [
        not np.array_equal(a.target_mm, b.target_mm)
        for a, b in zip(one.knots, other.knots, strict=True)
    ]
    # Knot 0 precedes the first observation, action 0 follows knot 1.
    assert differs.index(True) + 1 - moved.index(True) == REACTION_TICKS


@pytest.mark.parametrize("seed", [1, 2])
def test_both_rotation_conventions_lead_to_the_same_episode(seed: int) -> None:
    by_vector, by_angles = NeedleInsertion("rotvec"), NeedleInsertion("euler_delta")
    by_vector.reset(seed)
    by_angles.reset(seed)
    for _ in range(15):
        by_vector.step(by_vector.expert_action())
        action = by_angles.expert_action()
        by_angles.step(action)
        poses = np.stack([knot.pose for knot in by_angles.knots[-2:]])
        np.testing.assert_allclose(euler_actions(poses)[0], action, atol=1e-6)
    np.testing.assert_allclose(by_vector.knots[-1].pose, by_angles.knots[-1].pose, atol=1e-9)


def test_positions_between_ticks_are_what_was_passed() -> None:
    insertion = NeedleInsertion()
    insertion.reset(5)
    for _ in follow(insertion):
        pass
    times = np.array([0.3, 0.35, 0.4])
    poses = insertion.poses(times)
    np.testing.assert_allclose(poses[1], (poses[0] + poses[2]) / 2)
    np.testing.assert_allclose(poses[2], insertion.knots[4].pose)
    scene = insertion.scene(0.35)
    np.testing.assert_allclose(scene.needle_mm, poses[1, :2] - insertion.layout.bench_mm)
