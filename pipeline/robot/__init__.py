"""The control loop of robots and rollouts, and the policy server that robots ask for actions.

On the robot's computer, without torch:
loop.py            what is due in which tick, how action chunks are played, and the safe stops:
                   shared by rollouts and robots
realtime.py        the loop in real time: pacing, one tick, safe stops
readings.py        a robot's readings and clock, and what a policy remembers of them
limits.py          what a robot may do
process.py         the policy's thread, the watchdog, and signals
run_report.py      timings and missed ticks, and why a run ended
recorder.py        a run becomes a recording
lerobot_arm.py     a robot with LeRobot's interface
wire.py, client.py messages, and the client of the policy server

Beside the policy:
observation.py     a robot's observation, checked
live_features.py   frames -> features by the policy's own model, checked with golden rows
first_look.py      refuses exchanged views, colours, units and channels
session.py         a served policy, and its memory of each robot
server.py          the websocket server, its status and its log
export.py          the head as ONNX and torch.export
"""
