"""The control loop that a robot and a rollout run: the model at its own rate, the head every tick.

chunking.py, guides.py   how action chunks are played, and how the next continues the one under way
memory.py                the newest readings and features of one robot, as a policy takes them
features.py              frames -> features, by the very model that the policy was trained on
loop.py                  what is due in which tick: the loop that rollouts and robots share
realtime.py, beside.py   that loop in real time, and what goes on beside its ticks
limits.py, timings.py    what a robot may do, and how long each part of its ticks took
"""
