"""What is wrong with records before anything is learned from them, as findings.

Belongs here: checks that are computed from arrays of commands, outputs and nominal outputs. Not
here: what needs a twin to be simulated, which is in `retwin.update.agreement`.
"""
