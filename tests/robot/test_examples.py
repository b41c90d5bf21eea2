"""Each example runs, and is as short as it says."""

import runpy
from pathlib import Path

import pytest

from pipeline.base.errors import CheckpointMismatch
from pipeline.simulation.insertion import MAX_TICKS

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
MOST_LINES = 40


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short(example: Path) -> None:
    assert len(example.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


def test_the_simulated_arm_runs_over_the_wire_and_refuses_a_policy_for_another_robot(
    served_policy, serving, capsys
):
    server = serving(served_policy())
    main = runpy.run_path(str(ROOT / "examples" / "simulated_arm.py"))["main"]
    main(f"ws://{server.address}", 78)
    lines = capsys.readouterr().out.splitlines()
    assert 20 < len(lines) <= MAX_TICKS and "features 0." in lines[0]
    assert lines[-1] != "inserted"  # a policy of random weights
    other = served_policy()
    other.metadata |= {"action_hz": 30.0}
    with pytest.raises(CheckpointMismatch, match="action_hz: 30"):
        main(f"ws://{serving(other).address}", 78)
