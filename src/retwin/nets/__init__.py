"""Small neural networks, their training, and conditional distributions.

Belongs here: architectures, the training loop, mixtures and flows. Not here: anything of the
method, of twins, or of a robot.
"""
