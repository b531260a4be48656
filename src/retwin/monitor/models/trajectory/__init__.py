"""The monitor of machines that work in trajectories: calibration, state, evidence."""
