"""The cascaded tanks benchmark: its physics, parameters and cases."""
