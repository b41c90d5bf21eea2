"""What a robot's loop is measured against: the ticks it should have run, and its limits."""

from contextlib import closing

import numpy as np
import pytest

from benchmarks.robot_jitter import ACTION, LIMITS, CountedRobot, world_limits
from pipeline.data.insertion import SENSOR, STATE
from pipeline.robot.limits import Limits
from pipeline.simulation.insertion import TICK_HZ

METADATA = {
    "streams": {
        "action": ACTION,
        "state": {"names": list(STATE.names), "units": list(STATE.units)},
        "sensor": {"names": list(SENSOR.names), "units": list(SENSOR.units)},
    },
    "moving": [True] * 6 + [False],
}


@pytest.mark.parametrize(("safe_stop", "stopped_at"), [(False, 10.2), (True, 45.0)])
def test_a_tick_that_is_neither_run_nor_left_out_is_not_accounted_for(safe_stop, stopped_at):
    """Ticks 0, 1, 2, 5, 6, 9, and a last one where it is stopped safely, for 35 ticks."""
    now = 0.0
    with closing(CountedRobot(hz=100.0, clock=lambda: now)) as robot:
        for tick in (0, 1, 2, 5, 6, 9, 10)[: 7 if safe_stop else 6]:
            now = (tick + 0.1) / 100
            robot.observe()
        now = stopped_at / 100
        robot.stop("enough")
        assert robot.unaccounted(4, safe_stop) == pytest.approx(0, abs=0.2)
        assert robot.unaccounted(2, safe_stop) == pytest.approx(2, abs=0.2)
        assert robot.unaccounted(6, safe_stop) == pytest.approx(-2, abs=0.2)


@pytest.mark.parametrize("hz", [10.0, 100.0])
def test_limits_are_those_of_the_phantom_however_fast_its_world_goes(hz: float) -> None:
    fast, life = world_limits(METADATA, hz), Limits.read(LIMITS, METADATA, TICK_HZ)
    assert fast.hz == hz
    for action in np.random.default_rng(0).normal(0, 0.5, (50, 7)):
        np.testing.assert_allclose(fast.allow(action), life.allow(action))
    assert fast.clipped == life.clipped > 0
