"""Detection of changes in streams: scores of prediction errors, bets on them, and alarms.

Belongs here: statistics of a stream of residuals, and what is promised about false alarms. Not
here: what is watched, and how it is stored (see `models` and `store`).
"""
