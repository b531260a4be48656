"""The method: surrogate (Eq. 5), corrections g, residual models (Eq. 6-10), identification.

Belongs here: everything that makes a corrected twin from a twin and measured outputs. Does not
belong here: diagnosers, scores, and systems.
"""
