"""The network on onnxruntime: heights, labels and the hand's place in, a value for every push out."""

from collections.abc import Callable
from typing import Any

import numpy as np

from pregrasp_jax.deploy.bundle import Bundle
from pregrasp_jax.deploy.contract import ONNX, Tensor
from pregrasp_jax.messages import one_line

Values = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""(height_m [B, H, W] float32, labels [B, H, W] uint8, p1_m [B, 2] float32) -> q [B, H, W, K] float32."""


def load_values(bundle: Bundle, *, threads: int = 1) -> Values:
    """Return the policy of a bundle.

    Args:
        bundle: that holds policy.onnx.
        threads: of onnxruntime; more than one helps little, and they spin.

    Raises:
        ValueError: the bundle has no such file, or onnxruntime is not installed or cannot read it.
    """
    try:
        import onnxruntime
    except ImportError:
        raise ValueError("onnxruntime is not installed; allowed is pip install 'pregrasp_jax[deploy]'") from None
    if ONNX not in bundle.files:
        raise ValueError(f"{bundle.folder} has no {ONNX}; allowed is a bundle exported with --formats onnx")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(bundle.files[ONNX], options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own classes
        raise ValueError(f"{bundle.folder / ONNX} cannot be loaded ({one_line(error)})") from None
    tensors = bundle.contract.tensors
    wanted = [(tensor.name, tensor.dtype) for tensor in tensors]
    kinds = {"tensor(float)": "float32", "tensor(uint8)": "uint8"}
    found = [(given.name, kinds.get(given.type, given.type)) for given in session.get_inputs()]
    if wanted != found:
        raise ValueError(f"{bundle.folder / ONNX} reads {found}, but the contract says {wanted}")

    def values(height_m: np.ndarray, labels: np.ndarray, p1_m: np.ndarray) -> np.ndarray:
        given = dict(zip((tensor.name for tensor in tensors), (height_m, labels, p1_m), strict=True))
        for tensor in tensors:
            refuse_tensor(tensor, given[tensor.name])
        return np.asarray(session.run(None, given)[0])

    return values


def refuse_tensor(tensor: Tensor, value: Any) -> None:
    """Refuse what a runtime would take and the policy was never trained on.

    Raises:
        ValueError: another type or shape, not finite, or out of range (heights in mm are).
    """
    if not isinstance(value, np.ndarray) or str(value.dtype) != tensor.dtype:
        got = str(value.dtype) if isinstance(value, np.ndarray) else type(value).__name__
        raise ValueError(f"{tensor.name} is {got}; allowed is a numpy array of {tensor.dtype}")
    shape = tuple(int(size) if size.isdecimal() else None for size in tensor.shape)
    if len(shape) != value.ndim or any(want not in (None, got) for want, got in zip(shape, value.shape, strict=True)):
        raise ValueError(f"{tensor.name} has shape {list(value.shape)}; allowed is [{', '.join(tensor.shape)}]")
    if value.size == 0:
        raise ValueError(f"{tensor.name} is empty; allowed is a batch of at least one")
    if not np.isfinite(value).all():
        raise ValueError(f"{tensor.name} holds NaN or infinity; allowed are finite numbers")
    low, high = float(value.min()), float(value.max())
    if (tensor.low is not None and low < tensor.low) or (tensor.high is not None and high > tensor.high):
        hint = " (are these millimetres?)" if tensor.unit == "m" and high > 10 else ""
        raise ValueError(
            f"{tensor.name} reaches from {low:g} to {high:g} {tensor.unit}{hint}; allowed is {tensor.low} to "
            f"{tensor.high}"
        )
