"""Building an ONNX graph one operation after another.

All tensors are rows ``[batch, width]``. Constants are shared: the same values are one
initialiser, however many steps use them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike, DTypeLike, NDArray
from onnx import helper, numpy_helper

from racecar.controller import IR_VERSION, OPSET


class Tape:
    """A graph under construction; tensors are known by their names.

    Args:
        dtype: of all tensors, float32 or float64.
    """

    def __init__(self, dtype: DTypeLike = np.float32) -> None:
        self.dtype = np.dtype(dtype)
        #: Begins the names of what is added, such as "3." for the step with that number.
        self.prefix = ""
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[tuple[tuple[int, ...], bytes], str] = {}
        self._initializers: list[onnx.TensorProto] = []
        self._declared: list[onnx.ValueInfoProto] = []
        self._used: set[str] = set()

    def constant(self, values: ArrayLike, name: str) -> str:
        """Return a constant; where the values are new, its name begins with ``name``."""
        array = np.ascontiguousarray(np.asarray(values, dtype=self.dtype))
        key = (array.shape, array.tobytes())
        if key not in self._constants:
            if name in self._used:
                name = f"{name}~{len(self._constants)}"
            self._constants[key] = self._fresh(name)
            self._initializers.append(numpy_helper.from_array(array, name))
        return self._constants[key]

    def scalar(self, value: float) -> str:
        """Return a constant ``[1, 1]``."""
        return self.constant([[value]], f"#{len(self._constants)}")

    def apply(self, operator: str, *inputs: str, name: str, **attributes: Any) -> str:
        """Add a node with one output and return the output's name."""
        output = self._fresh(f"{self.prefix}{name}")
        self._nodes.append(helper.make_node(operator, list(inputs), [output], **attributes))
        return output

    def declare(self, x: str, width: int) -> None:
        """Write down the shape of a tensor.

        It follows from the graph; but onnxruntime takes a minute to find the shapes of a long
        one, and a second where some are given.
        """
        self._declared.append(helper.make_tensor_value_info(x, self._kind, ["batch", width]))

    @property
    def _kind(self) -> int:
        return helper.np_dtype_to_tensor_dtype(self.dtype)

    def affine(self, x: str, scale: float, shift: float, name: str) -> str:
        """Return ``scale * x + shift`` with as few operations as it takes."""
        if scale == -1.0 and shift != 0.0:
            return self.apply("Sub", self.scalar(shift), x, name=name)
        if scale != 1.0:
            x = self.apply("Mul", x, self.scalar(scale), name=name if shift == 0.0 else f"{name}*")
        return x if shift == 0.0 else self.apply("Add", x, self.scalar(shift), name=name)

    def fold(self, operator: str, inputs: list[str], name: str) -> str:
        """Combine tensors two by two, as in ``Max`` of several; one alone is returned as it is."""
        result = inputs[0]
        for i, other in enumerate(inputs[1:]):
            last = i == len(inputs) - 2
            result = self.apply(operator, result, other, name=name if last else f"{name}{i}")
        return result

    def column(self, x: str, weights: ArrayLike, name: str) -> str:
        """Return a linear combination ``[batch, 1]`` of the columns of ``x``."""
        values: NDArray = np.asarray(weights, dtype=float).reshape(-1, 1)
        return self.apply("MatMul", x, self.constant(values, f"{name}.row"), name=name)

    def model(
        self, start: str, width: int, output: str, outputs: int, metadata: Mapping[str, str]
    ) -> onnx.ModelProto:
        """Return the model; its input is ``[batch, width]`` and its output ``[batch, outputs]``."""
        kind = self._kind
        graph = helper.make_graph(
            self._nodes,
            "closed_loop",
            [helper.make_tensor_value_info(start, kind, ["batch", width])],
            [helper.make_tensor_value_info(output, kind, ["batch", outputs])],
            self._initializers,
            value_info=self._declared,
        )
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="ClosedLap"
        )
        model.ir_version = IR_VERSION
        helper.set_model_props(model, dict(sorted(metadata.items())))
        onnx.checker.check_model(model, full_check=True)
        return model

    def _fresh(self, name: str) -> str:
        if name in self._used:
            raise ValueError(f"two tensors have the name {name}")
        self._used.add(name)
        return name
