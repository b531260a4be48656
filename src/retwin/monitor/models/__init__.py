"""What watches a machine: monitors of samples and of trajectories, and the causes of alarms.

Belongs here: monitors, how they are calibrated and saved, their state, and what they return. Not
here: the statistics of detection (see `detect`), and machines that run (see `live`).
"""
