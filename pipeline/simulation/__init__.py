"""Simulated robots; above all a needle insertion, with recordings of it in every format.

interface.py            what an environment must have for rollouts
meta_world.py           tasks of Meta-World

arm.py                  pose, orientation, motion and joints of the arm that carries the needle
needle_sensor.py        force and OCT A-scan at the needle
layout.py               the hidden parameters of an episode
insertion.py            the physics, one step for each control tick
expert.py               the demonstrator
rendering.py            three camera views
environment.py          the insertion as a gymnasium environment, and as a robot in real time;
                        the environments by name
recorder.py             an episode recorded by clocks that start late and jitter
insertion_formats.py    writers of an episode in each format
demo_recordings.py      the demo's sets of recordings
"""
