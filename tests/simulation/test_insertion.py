"""The physics: what is measured follows from the geometry, and stays hidden where it must."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.base.config import Level
from pipeline.simulation.arm import LAG_S, ArmMotion, orientation
from pipeline.simulation.demonstrator import NOT_ALIGNED_MM, REACTION_TICKS, expert_motion
from pipeline.simulation.insertion import (
    AT_LAYER_MM,
    FORCE_LIMIT_N,
    HOLD_TICKS,
    INSERTED,
    MAX_TICKS,
    MISS_MM,
    OVERSHOOT_MM,
    TICK_S,
    NeedleInsertion,
    Progress,
)
from pipeline.simulation.insertion_layout import WORKSPACE_MM, InsertionLayout, draw_layout
from pipeline.simulation.needle_sensor import BIN_MM
from pipeline.simulation.rendering import VIEWS, render

STILL = np.zeros(7)


def down(step_mm: float) -> NDArray[np.float64]:
    """An action that only descends."""
    return np.array([0, 0, -step_mm, 0, 0, 0, 1.0])


def calm(seed: int = 0) -> InsertionLayout:
    """An episode in which nobody pushes the phantom."""
    return replace(draw_layout(seed), push_times_s=np.zeros(0))


def begun(layout: InsertionLayout) -> NeedleInsertion:
    """An episode of this layout, at its beginning."""
    insertion = NeedleInsertion()
    insertion.start(layout)
    return insertion


def demonstrated(seed: int, level: Level = "full") -> NeedleInsertion:
    """The demonstrator's episode of this seed, at its end."""
    insertion = NeedleInsertion()
    insertion.reset(seed, level)
    while not insertion.finished:
        insertion.step(insertion.expert_action())
    return insertion


def peak_bin(insertion: NeedleInsertion) -> int:
    """The middle of the brightest bins of the newest A-scan, several where it saturates."""
    scan = insertion.sensor[-1, 1:]
    return round(np.flatnonzero(scan == scan.max()).mean())


def test_a_scan_peaks_at_the_tip_to_tissue_distance() -> None:
    insertion = begun(calm())
    while insertion.contact.distance_mm[-1] > 0.3:
        for _ in range(2):  # held still: the arm lags, and an A-scan is up to 23 ms old
            insertion.step(STILL)
        distance = insertion.knots[-1].pose[2] - insertion.knots[-1].surface_mm
        assert abs(peak_bin(insertion) * BIN_MM - distance) <= 8 * BIN_MM
        insertion.step(down(0.17))
    assert peak_bin(insertion) < 150


def test_the_layer_is_the_second_peak_until_it_is_the_only_one() -> None:
    layout = calm()
    surface, depth = layout.surfaces_mm[0], layout.tissue.layer_depth_mm
    start = layout.start_pose.copy()
    start[2] = surface + 1.0
    insertion = begun(replace(layout, start_pose=start))
    behind = insertion.sensor[-1, 1:].copy()
    behind[: int(1.0 / BIN_MM) + 60] = 0
    # The layer stands on a slope of scattered light, which pulls its peak towards the tip.
    assert abs(behind.argmax() * BIN_MM - (1.0 + depth)) < 0.05
    while not insertion.inside:
        insertion.step(down(0.2))
    insertion.step(STILL)
    inside = insertion.sensor[-1, 1:].copy()
    inside[:150] = 0
    assert abs(inside.argmax() * BIN_MM - insertion.contact.layer_mm[-1]) < 0.05


def test_force_rises_on_contact_drops_at_puncture_and_grows_with_depth() -> None:
    insertion = begun(calm())
    force, depth, inside = [], [], []
    for _ in range(60):
        insertion.step(down(0.12))
        force.append(insertion.contact.force_n.copy())
        now = insertion.knots[-1]
        before = insertion.knots[-2]
        part = np.arange(1, 66) / 65
        surface = before.surface_mm + part * (now.surface_mm - before.surface_mm)
        depth.append(surface - now.motion.at(part * TICK_S)[:, 2])
        inside.append(insertion.contact.inside.copy())
        # The gauge reads the true force but for noise and a slow drift of 20 mN.
        assert np.abs(insertion.sensor[:, 0] - insertion.contact.force_n).max() < 0.08
    f, d, i = (np.concatenate(rows) for rows in (force, depth, inside))
    assert (f[d <= 0] == 0).all() and (d <= 0).any()
    pressing = f[(d > 0) & ~i]
    assert (np.diff(pressing) > 0).all() and pressing[-1] < insertion.layout.tissue.puncture_n
    assert f[i][0] < 0.7 * pressing[-1]
    assert (np.diff(f[i]) > 0).all()
    assert (np.diff(i.astype(int)) >= 0).all()


def twins(
    first: InsertionLayout, second: InsertionLayout
) -> Iterator[tuple[NeedleInsertion, NeedleInsertion]]:
    """Both episodes under the demonstrator's actions in the first, tick by tick."""
    one, other = begun(first), begun(second)
    yield one, other
    while not one.finished:
        action = one.expert_action()
        one.step(action)
        other.step(action)
        yield one, other


@pytest.mark.parametrize("seed", [0, 11])
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
        sensed |= not np.array_equal(one.sensor, other.sensor)
        np.testing.assert_array_equal(one.state, other.state)
        if tick % 4 == 0:
            for view in VIEWS:
                np.testing.assert_array_equal(
                    render(view, one.scene(one.time_s)), render(view, other.scene(other.time_s))
                )
    assert sensed and tick > 5


@pytest.mark.parametrize("seed", [0, 11])
def test_lateral_target_does_not_show_in_sensor_or_state(seed: int) -> None:
    layout = draw_layout(seed)
    mirrored = replace(layout, targets_mm=-layout.targets_mm)
    seen = 0
    for one, other in twins(layout, mirrored):
        np.testing.assert_array_equal(one.sensor, other.sensor)
        np.testing.assert_array_equal(one.state, other.state)
        scenes = (one.scene(one.time_s), other.scene(other.time_s))
        seen += not np.array_equal(*(render("View2", scene) for scene in scenes))
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


@pytest.mark.parametrize("level", ["depth", "full", "moved"])
def test_the_demonstrator_succeeds(level: Level) -> None:
    insertion = demonstrated(300, level)
    assert insertion.outcome == INSERTED
    last, progress = insertion.knots[-1], insertion.progress
    assert insertion.inside and abs(last.layer_mm) < AT_LAYER_MM
    assert np.hypot(*progress.puncture_mm) < NOT_ALIGNED_MM
    upright = orientation(insertion.layout.upright_deg)
    assert (orientation(last.pose[3:]) * upright.inv()).magnitude() < np.deg2rad(1.5)
    places = np.stack([knot.target_mm for knot in insertion.knots])
    assert (np.abs(places) <= WORKSPACE_MM).all()


def test_at_moved_most_phantoms_are_pushed_sideways_and_up_or_down() -> None:
    sideways, heights = 0, 0
    for seed in range(100, 120):
        insertion = demonstrated(seed, "moved")
        first, last = insertion.knots[0], insertion.knots[-1]
        sideways += not np.array_equal(first.target_mm, last.target_mm)
        heights += abs(first.surface_mm - last.surface_mm) > 0.3  # more than it breathes
        assert insertion.outcome == INSERTED
    assert sideways >= 17 and heights >= 12


def test_the_demonstrator_reacts_to_a_push_only_after_its_reaction_time() -> None:
    layout = replace(draw_layout(2), push_times_s=np.array([0.65]))
    unpushed = replace(layout, push_times_s=np.zeros(0))
    one, other = begun(layout), begun(unpushed)
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


def test_both_rotation_conventions_lead_to_the_same_episode() -> None:
    by_vector, by_angles = NeedleInsertion("rotvec"), NeedleInsertion("euler_delta")
    by_vector.reset(1)
    by_angles.reset(1)
    for _ in range(15):
        by_vector.step(by_vector.expert_action())
        before, action = by_angles.setpoint, by_angles.expert_action()
        by_angles.step(action)
        np.testing.assert_allclose(by_angles.setpoint - before, action[:6], atol=1e-9)
    # Angles are added to a setpoint that leads the pose that they were computed at.
    np.testing.assert_allclose(by_vector.knots[-1].pose, by_angles.knots[-1].pose, atol=0.02)


def test_poses_between_ticks_are_what_the_arm_passed() -> None:
    insertion = demonstrated(5)
    knots = insertion.knots
    ends = insertion.poses(np.arange(len(knots)) * TICK_S)
    np.testing.assert_allclose(ends, np.stack([knot.pose for knot in knots]), atol=1e-9)
    fine = insertion.poses(np.arange(0, insertion.time_s, 0.001))
    speed = np.linalg.norm(np.diff(fine[:, :3], axis=0), axis=1) / 0.001
    assert speed.max() < 12.1
    scene = insertion.scene(0.35)
    pose = insertion.poses(np.array([0.35]))[0]
    np.testing.assert_allclose(scene.needle_mm, pose[:2] - insertion.layout.bench_mm)


def test_an_action_adds_to_the_setpoint_and_the_arm_follows_with_its_lag() -> None:
    insertion = begun(calm())
    start = insertion.layout.start_pose
    insertion.step(down(0.5))
    behind = insertion.knots[-1].pose[2] - insertion.setpoint[2]
    assert insertion.setpoint[2] == pytest.approx(start[2] - 0.5)
    # The reference ramps for a tick; what is left after it is the lag's share of a ramp.
    assert behind == pytest.approx(0.5 * LAG_S / TICK_S * (1 - np.exp(-TICK_S / LAG_S)))
    for _ in range(5):
        insertion.step(STILL)
    np.testing.assert_allclose(insertion.knots[-1].pose, insertion.setpoint, atol=1e-6)


def test_a_leap_is_carried_out_at_the_arms_speed() -> None:
    insertion = begun(calm())
    before = insertion.knots[-1].pose
    insertion.step(np.array([20.0, 0, 0, 0, 0, 0, 1]))
    assert 0 < insertion.knots[-1].pose[0] - before[0] <= 1.2
    motion, jumps = ArmMotion.resting(np.zeros(6)), []
    for target in (50.0, -50.0, 50.0):
        after = motion.towards(np.array([target, 0, 0, 0, 0, 0]), TICK_S)
        jumps.append(np.abs(after.velocity - motion.velocity).max())
        motion = after
    assert max(jumps) <= 12.0 + 1e-9


def plunge(insertion: NeedleInsertion, *steps: tuple[int, NDArray[np.float64]]) -> str | None:
    """How an episode ends when each action is repeated so many times, and nothing after."""
    for times, action in steps:
        for _ in range(times):
            if not insertion.finished:
                insertion.step(action)
    while not insertion.finished:
        insertion.step(STILL)
    return insertion.outcome


def over_the_target(offset_mm: float = 0.0) -> NeedleInsertion:
    """An episode that begins above the target, or so far beside it."""
    layout = calm()
    start = layout.start_pose.copy()
    start[:2] = layout.bench_mm + layout.targets_mm[0] + [offset_mm, 0]
    return begun(replace(layout, start_pose=start))


def punctured() -> NeedleInsertion:
    """An episode in which the needle has gone straight down until it is inside."""
    insertion = over_the_target()
    while not insertion.inside:
        insertion.step(down(0.15))
    return insertion


def test_every_way_to_fail_ends_the_episode_with_its_reason() -> None:
    assert plunge(over_the_target(), (0, STILL)) == "time is up before a puncture"
    beside = plunge(over_the_target(1.2 * MISS_MM), (80, down(0.15)))
    assert beside == "punctured beside the target"
    assert plunge(over_the_target(0.8 * MISS_MM), (80, down(0.15))) == "beyond the layer"
    inside = punctured()
    sideways = np.array([0.5, 0, 0, 0, 0, 0, 1.0])
    assert plunge(inside, (1, down(1.0)), (12, sideways)) == "too much force"
    assert inside.progress.max_force_n > FORCE_LIMIT_N
    short = punctured()
    assert plunge(short, (0, STILL)) == "time is up"
    assert len(short.knots) == MAX_TICKS + 1


def test_a_needle_inside_is_held_sideways() -> None:
    insertion = punctured()
    insertion.step(down(0.6))
    calm_n = insertion.knots[-1].force_n
    insertion.step(np.array([0.4, 0, 0, 0, 0, 0, 1.0]))
    pulled = insertion.knots[-1].force_n
    assert pulled > calm_n
    # The gauge along the needle feels the friction of it.
    depth = insertion.layout.tissue.layer_depth_mm - insertion.contact.layer_mm[-1:]
    straight = insertion.layout.tissue.drag_n(depth)[0]
    assert insertion.contact.force_n[-1] > straight + 0.02


def test_a_limit_that_was_passed_is_no_success() -> None:
    good = Progress(np.zeros(2), 0.9 * OVERSHOOT_MM, 0.9 * FORCE_LIMIT_N, HOLD_TICKS)
    assert good.outcome(50) == INSERTED
    assert replace(good, held_ticks=HOLD_TICKS - 1).outcome(50) is None
    assert replace(good, overshoot_mm=1.1 * OVERSHOOT_MM).outcome(50) == "beyond the layer"
    beside = replace(good, puncture_mm=np.array([1.1 * MISS_MM, 0.0]))
    assert beside.outcome(50) == "punctured beside the target"
    assert replace(good, max_force_n=1.1 * FORCE_LIMIT_N).outcome(50) == "too much force"


def test_a_needle_pulled_out_must_puncture_again_and_every_puncture_is_judged() -> None:
    insertion = punctured()
    while insertion.inside:
        insertion.step(down(-0.3))
    assert insertion.contact.force_n[-1] == 0
    for _ in range(6):
        insertion.step(np.array([0.3, 0, 0.05, 0, 0, 0, 1.0]))
    while insertion.contact.distance_mm[-1] > 0:
        insertion.step(down(0.15))
    assert not insertion.inside and insertion.contact.force_n[-1] > 0
    assert plunge(insertion, (40, down(0.15))) == "punctured beside the target"


@pytest.mark.parametrize("action", [np.full(7, np.nan), np.zeros(6)])
def test_an_action_that_is_none_is_refused(action: NDArray[np.float64]) -> None:
    with pytest.raises(ValueError, match="7 finite numbers"):
        over_the_target().step(action)


def test_levels() -> None:
    for seed in range(20):
        depth, full, moved = (draw_layout(seed, level) for level in ("depth", "full", "moved"))
        above = depth.start_pose[:2] - depth.bench_mm - depth.targets_mm[0]
        assert np.abs(above).max() <= 0.3
        assert not len(full.push_times_s) and not len(depth.push_times_s)
        assert len(moved.push_times_s) == 3
        np.testing.assert_array_equal(full.start_pose, moved.start_pose)


def test_the_surface_breathes() -> None:
    insertion = begun(calm())
    for _ in range(60):
        insertion.step(STILL)
    heights = np.array([knot.surface_mm for knot in insertion.knots])
    assert 0.05 < np.ptp(heights) < 0.25


@pytest.mark.parametrize("distance", [0.7, 4.0])
def test_the_demonstrator_never_returns_upwards_and_waits_where_it_is(distance: float) -> None:
    """Averages of what it does at two misses stand between them: nobody learns to hover."""

    def falls(miss: float) -> float:
        seeds = (np.random.default_rng(seed) for seed in range(100))
        beside, still = np.array([miss, 0.0]), (np.zeros(3), np.zeros(6))
        seen = (beside, distance, distance + 2.5, False, *still, 8.0, TICK_S)
        motions = [expert_motion(*seen, rng)[2] for rng in seeds]
        return -float(np.mean(motions))

    speeds = [falls(miss) for miss in np.linspace(0, 2, 21)]
    assert min(speeds) > -0.003  # of tremor alone
    assert (np.diff(speeds) < 1e-9).all()
    assert max(-np.diff(speeds)) < 0.025  # no step of its gate
