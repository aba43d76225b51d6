"""An ONNX graph under construction: a call adds a node and returns the name of its output.

Opset 17 and IR 8 are what older runtimes on robots read. Only operators that have not changed since are used, and no
Resize, which runtimes have understood differently.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET, IR_VERSION = 17, 8
"""Of every graph."""

ELEMENT_TYPES = {"float32": TensorProto.FLOAT, "uint8": TensorProto.UINT8}
"""numpy name -> ONNX's, of inputs and outputs."""


class Graph:
    """Nodes and constants. Constants are stored once, however often they are asked for."""

    def __init__(self):
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[str, onnx.TensorProto] = {}
        self._by_content: dict[tuple[Any, ...], str] = {}

    def __call__(self, operator: str, *inputs: "str | np.ndarray", **attributes: Any) -> str:
        """Add a node; arrays among its inputs become constants.

        Returns:
            The name of its one output.
        """
        output = f"{operator.lower()}_{len(self._nodes)}"
        names = [given if isinstance(given, str) else self.constant(given) for given in inputs]
        self._nodes.append(helper.make_node(operator, names, [output], name=output, **attributes))
        return output

    def constant(self, value: np.ndarray, name: str = "") -> str:
        """Return the name of a constant; int stands for int64 and float for float32."""
        value = np.asarray(value)
        if value.dtype.kind in "if":
            value = value.astype(np.int64 if value.dtype.kind == "i" else np.float32)
        content = (value.dtype.str, value.shape, value.tobytes())
        if content not in self._by_content:
            self._by_content[content] = name or f"constant_{len(self._constants)}"
            self._constants[self._by_content[content]] = numpy_helper.from_array(
                np.ascontiguousarray(value), self._by_content[content]
            )
        return self._by_content[content]

    def cast(self, value: str, dtype: int) -> str:
        """Return a value as another element type."""
        return self("Cast", value, to=dtype)

    def model(
        self,
        inputs: Mapping[str, tuple[str, Sequence[int | str]]],
        outputs: Mapping[str, tuple[str, Sequence[int | str]]],
        *,
        results: Mapping[str, str],
        name: str,
    ) -> onnx.ModelProto:
        """Return the checked model.

        Args:
            inputs: name -> (numpy dtype, shape with names for what may vary).
            outputs: the same.
            results: output name -> the value that it is.
            name: of the graph.
        """
        for output, value in results.items():
            self._nodes.append(helper.make_node("Identity", [value], [output], name=output))
        infos = [
            [helper.make_tensor_value_info(key, ELEMENT_TYPES[dtype], shape) for key, (dtype, shape) in group.items()]
            for group in (inputs, outputs)
        ]
        graph = helper.make_graph(self._nodes, name, *infos, initializer=list(self._constants.values()))
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="pregrasp_jax")
        model.ir_version = IR_VERSION
        onnx.checker.check_model(model, full_check=True)
        return model
