"""Networks in the YAML layout that Verisig reads: weights, offsets, activations by layer.

``weights: {1: [[...], ...]}`` has one row per neuron, ``offsets: {1: [...]}`` one value per
neuron, ``activations: {1: Tanh}``. The network reads ``(scan - 2.5) / 5`` and its output is
steering before the factor of 15 degrees.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from generator.actor import fold
from racecar.controller import Controller
from racecar.errors import BadInput
from racecar.instance import read_text

#: Activations by the names that the layout uses.
ACTIVATIONS = {"Tanh": "tanh", "Sigmoid": "sigmoid", "Relu": "relu", "Linear": "linear"}
_SECTIONS = ("weights", "offsets", "activations")
#: One layer: weights ``[out, in]``, offsets ``[out]`` (float64), activation.
YamlLayer = tuple[NDArray[np.float64], NDArray[np.float64], str]


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The fast loader where there is one; a key given twice is an error, not an overwrite."""


def _construct_mapping(loader: Any, node: yaml.MappingNode) -> dict[Any, Any]:
    mapping: dict[Any, Any] = loader.construct_mapping(node, deep=True)
    if len(mapping) < len(node.value):
        raise yaml.constructor.ConstructorError(problem="a key is given twice")
    return mapping


_Loader.add_constructor("tag:yaml.org,2002:map", _construct_mapping)


def import_yaml(path: Path, name: str) -> Controller:
    """Return the controller of a YAML file, with metadata on where it came from.

    name: kept in the metadata. Raises BadInput if the file breaks the layout.
    """
    content = read_text(path)
    metadata = {
        "name": name,
        "source": "network YAML as Verisig reads it",
        "source_sha256": hashlib.sha256(content).hexdigest(),
    }
    layers = parse_yaml(content, str(path))
    with np.errstate(over="ignore"):
        controller = fold(layers, metadata)
    for i, layer in enumerate(controller.layers, start=1):
        if not (np.isfinite(layer.weights).all() and np.isfinite(layer.biases).all()):
            raise BadInput(f"{path}: layer {i}: a value is too large for float32")
    return controller


def parse_yaml(content: bytes, where: str) -> list[YamlLayer]:
    """Read the layers from YAML text; BadInput names what breaks the layout in ``where``."""
    try:
        data = yaml.load(content, _Loader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        problem = getattr(error, "problem", None) or "it is cut off or damaged"
        raise BadInput(f"{where}: not YAML: {problem}") from None
    if not isinstance(data, dict) or set(data) != set(_SECTIONS):
        raise BadInput(f"{where}: it needs the sections {', '.join(_SECTIONS)} and no others")
    count = len(data["weights"]) if isinstance(data["weights"], dict) else 0
    for section in _SECTIONS:
        keys = data[section]
        numbered = isinstance(keys, dict) and all(type(key) is int for key in keys)
        if not numbered or not count or set(keys) != set(range(1, count + 1)):
            raise BadInput(
                f"{where}: {section}: layers must be numbered 1, 2, ... as in the other sections"
            )
    layers: list[YamlLayer] = []
    for i in range(1, count + 1):
        layers.append(_layer(data, i, where))
        if len(layers) > 1 and layers[-2][0].shape[0] != layers[-1][0].shape[1]:
            raise BadInput(
                f"{where}: layer {i} reads {layers[-1][0].shape[1]} values, "
                f"but layer {i - 1} has {layers[-2][0].shape[0]} neurons"
            )
    if layers[-1][0].shape[0] != 1:
        raise BadInput(
            f"{where}: layer {count} has {layers[-1][0].shape[0]} neurons; a controller returns 1"
        )
    if layers[0][0].shape[1] < 2:
        raise BadInput(f"{where}: layer 1 reads 1 value; a controller reads at least 2 rays")
    return layers


def _layer(data: dict[str, Any], i: int, where: str) -> YamlLayer:
    rows, offsets, activation = (data[section][i] for section in _SECTIONS)
    if not isinstance(activation, str) or activation not in ACTIVATIONS:
        raise BadInput(
            f"{where}: activations: layer {i}: {activation!r} is unknown; "
            f"use one of {', '.join(ACTIVATIONS)}"
        )
    if not isinstance(rows, list) or not rows:
        raise BadInput(f"{where}: weights: layer {i}: it must be a list of rows")
    weights = [_numbers(row, f"{where}: weights: layer {i}, row {j}") for j, row in enumerate(rows)]
    if len({len(row) for row in weights}) > 1:
        raise BadInput(f"{where}: weights: layer {i}: its rows have different lengths")
    biases = _numbers(offsets, f"{where}: offsets: layer {i}")
    if len(biases) != len(weights):
        raise BadInput(
            f"{where}: offsets: layer {i}: {len(biases)} values for {len(weights)} neurons"
        )
    return np.array(weights), np.array(biases), ACTIVATIONS[activation]


def _numbers(values: Any, where: str) -> list[float]:
    if not isinstance(values, list) or not values:
        raise BadInput(f"{where}: it must be a list of numbers")
    return [_number(value, where) for value in values]


def _number(value: Any, where: str) -> float:
    # YAML 1.1 takes 1e-05, without a point, for text.
    if type(value) in (int, float, str):
        try:
            number = float(value)
        except (ValueError, OverflowError):
            number = math.nan
        if math.isfinite(number):
            return number
    raise BadInput(f"{where}: {str(value)[:40]!r} is not a finite number")
