"""The monitor: watches a controller and its robot from outside, and shares no code with the controller.

It builds on nothing of `mpc` but this room, and of `models` on what reads files and loads C. Tests look at the sources
and at the process that runs.
"""
