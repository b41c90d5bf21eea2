"""The control loop that a robot and a rollout run, and the policy server that a robot asks.

loop.py                  what is due in which tick: the loop that rollouts and robots share
chunking.py, guides.py   how action chunks are played, and how the next continues the one under way
realtime.py, beside.py   the loop in real time, and what goes on beside its ticks
limits.py, timings.py    what a robot may do, and how long each part of its ticks took
lerobot_arm.py           a robot with LeRobot's interface as one of ours

memory.py                the newest readings and features of one robot, as a policy takes them
features.py              frames -> features, by the very model that the policy was trained on
proof.py                 the live model gives the features of training: golden rows computed again
first_look.py            a robot's first frames and states are what training saw
observation.py           what a robot says, checked
session.py               a served policy, and what it remembers of each robot
server.py, status.py     it is served over a websocket, and a page shows how it goes
wire.py, client.py       the messages, and the client; no torch

recorder.py, run_recording.py   a run becomes a recording
export.py, export_inputs.py     the head as ONNX and torch.export
"""
