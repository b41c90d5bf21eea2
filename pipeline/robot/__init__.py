"""The control loop that a robot and a rollout run: the model at its own rate, the head every tick.

chunking.py, guides.py   how action chunks are played, and how the next continues the one under way
memory.py                the newest readings and features of one robot, as a policy takes them
features.py              frames -> features, by the very model that the policy was trained on
proof.py                 the live model gives the features of training: golden rows computed again
first_look.py            a robot's first frames and states are what training saw
loop.py                  one robot's loop, on whichever clock its readings bring
"""
