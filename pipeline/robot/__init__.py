"""The control loop that a robot and a rollout run: the model at its own rate, the head every tick.

chunking.py, guides.py   how action chunks are played, and how the next continues the one under way
memory.py                the newest readings and features of one robot, as a policy takes them
features.py              frames -> features, by the very model that the policy was trained on
proof.py                 the live model gives the features of training: golden rows computed again
first_look.py            a robot's first frames and states are what training saw
loop.py                  one robot's loop, on whichever clock its readings bring
observation.py           what a robot says, checked
session.py               a served policy, and what it remembers of each robot
server.py, status.py     it is served over a websocket, and a page shows how it goes
wire.py, client.py       the messages, and the client; no torch
"""
