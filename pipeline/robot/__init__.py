"""The control loop that a robot and a rollout run: the model at its own rate, the head every tick.

chunking.py, guides.py   how action chunks are played, and how the next continues the one under way
memory.py                the newest readings and features of one robot, as a policy takes them
features.py              frames -> features, by the very model that the policy was trained on
loop.py                  one robot's loop, on whichever clock its readings bring
"""
