"""The control loop of robots and rollouts, and the policy server that robots ask for actions.

On the robot's computer, without torch:
loop.py            what is due in which tick, and the safe stops: shared by rollouts and robots
chunking.py        how action chunks are played, and how the next chunk continues the current one
realtime.py        the loop in real time: pacing, one tick, safe stops
readings.py        a robot's readings before they go to the policy, and its clock
limits.py          what a robot may do
process.py         the policy's thread, the watchdog, priority and signals
run_report.py      timings and missed ticks, and why a run ended
lerobot_arm.py     a robot with LeRobot's interface
wire.py, client.py messages, and the client of the policy server
recorder.py, run_recording.py  turn a run into a recording

Beside the policy:
observation.py     a robot's observation, checked
robot_memory.py    the newest readings and features of one robot, as a policy takes them
live_features.py   frames -> features by the policy's own model, checked with golden rows
first_look.py      refuses exchanged views, colours, units and channels
session.py         a served policy, and its memory of each robot
server.py          the websocket server, and its counts and latencies
export.py, export_inputs.py    the head as ONNX and torch.export
"""
