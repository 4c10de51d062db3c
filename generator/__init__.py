"""Trains controllers and emits everything under ``benchmarks/``, ``onnx/`` and ``vnnlib/``."""
