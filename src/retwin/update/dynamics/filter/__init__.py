"""The Kalman filter of corrected state equations, and the noise that it assumes."""
