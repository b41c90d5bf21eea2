"""Run the simulated arm over the wire: python examples/simulated_arm.py [ws://host:port] [seed].

Serve a policy that was trained on the demo first: python -m stages.serve
"""

import sys

from pipeline.data.insertion import SENSOR, STATE
from pipeline.robot.client import PolicyClient
from pipeline.robot.loop import Executor
from pipeline.simulation.environment import InsertionEnvironment
from pipeline.simulation.rendering import VIEWS

ARM = {"state": STATE.names, "state_units": STATE.units, "sensor": SENSOR.names, "views": VIEWS}
ARM |= {"sensor_units": SENSOR.units, "action_units": ("mm",) * 3 + ("deg",) * 3 + ("",)}
ARM |= {"action_kind": "delta", "action_hz": 10.0}  # its rotations follow the policy's


def main(url: str = "ws://127.0.0.1:8000", seed: int = 1_000_000) -> None:
    """One episode: observe, ask for a chunk, do its first step, until it ends."""
    with PolicyClient(url, robot=ARM) as client:
        names = client.metadata["streams"]["action"]["names"]
        arm = InsertionEnvironment("full", "rotvec" if "rx" in names else "euler_delta")
        readings, info = arm.reset(seed=seed)
        executor = Executor("none", 1, client.metadata["horizon"], client.metadata["moving"])
        client.reset(seed)
        while "reason" not in info:
            frames = arm.frames().items()
            taken = {f"images/{view}": frame for view, (_, frame) in frames}
            times = {f"images_time/{view}": time for view, (time, _) in frames}
            executor.begin()
            answer = client.infer({**readings, **taken, **times})
            executor.plan(answer["actions"])
            readings, *_, info = arm.step(executor.next_action())
            print(f"{readings['time'][0]:5.1f} s  features {answer['feature_age_s']:.2f} s old")
    print(info["reason"])


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(int, sys.argv[2:3]))
