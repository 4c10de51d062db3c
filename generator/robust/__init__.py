"""Robust controllers: a network that learns from a teacher that sees the car's true state.

``teacher`` drives by the state, ``student`` is the network, ``spoil`` what goes wrong with
its scans, ``mine`` finds the rays that it misses most, ``dagger`` is the training and
``train`` its checkpoints and curve.
"""
