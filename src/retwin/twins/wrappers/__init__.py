"""Twins that simulate by another twin: with noise, with parameters, or drawn at random.

Belongs here: what changes the commands, the outputs or the parameters of any twin. Not here: what
is learned from records (see `update`).
"""
