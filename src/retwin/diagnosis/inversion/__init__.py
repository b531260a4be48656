"""Diagnosis by physics: which fault explains the measured outputs, and how large it is."""
