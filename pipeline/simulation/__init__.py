"""A simulated needle insertion: physics, cameras, and recordings of it in every format we read.

arm.py              pose, orientation and joints of the arm that carries the needle
needle_sensor.py    what the needle measures: force and OCT A-scan
insertion.py        the physics, one step a control tick; closed-loop evaluation grows from here
expert.py           the demonstrator
rendering.py        three camera views
recorder.py         an episode seen through clocks that start late and jitter
insertion_formats.py, lerobot_format.py, demo_recordings.py    the writers
"""
