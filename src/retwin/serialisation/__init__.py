"""Objects as JSON and safetensors, written whole or not at all.

Belongs here: atomic files, model folders, config objects, fingerprints. Not here: file formats of
trajectories (see `data.io`). Pickle is used nowhere.
"""
