"""A formula of core in each framework: NumPy float32, PyTorch and Dr.Jit, values and gradients; the float64 oracle.

A formula is ``function(ops, *scalars)`` → scalars. Gradients are those of Σ_k v_k/(k + 1), k = 0, 1, …, of its values.
"""

import numpy as np
import pytest

from helpers.variants import VARIANT
from mi_ntf.core import ops


def numpy32(function, inputs):
    """Values, and None for the gradients."""
    return function(ops, *inputs), None


def torch(function, inputs):
    """``(values, gradients)``, lists of float32 arrays."""
    torch = pytest.importorskip("torch")
    namespace = pytest.importorskip("mi_ntf.train.ops")
    inputs = [torch.tensor(v, requires_grad=True) for v in inputs]
    values = function(namespace, *inputs)
    sum((v / (k + 1)).sum() for k, v in enumerate(values)).backward()
    zero = np.zeros_like(inputs[0].detach().numpy())  # of an input that no value depends on
    return [v.detach().numpy() for v in values], [zero if v.grad is None else v.grad.numpy() for v in inputs]


def drjit(function, inputs):
    """Return values and derivatives of `function` in Dr.Jit, in the form of :func:`torch`."""
    mi = pytest.importorskip("mitsuba")
    import drjit as dr

    mi.set_variant(VARIANT)
    from mi_ntf.infer import ops as namespace

    inputs = [mi.Float(v) for v in inputs]
    dr.enable_grad(inputs)
    values = function(namespace, *inputs)
    dr.backward(sum((dr.sum(v / (k + 1)) for k, v in enumerate(values)), mi.Float(0)))
    return [v.numpy() for v in values], [v.grad.numpy() for v in inputs]


BACKENDS = {"numpy32": numpy32, "torch": torch, "drjit": drjit}


def oracle(function, inputs, step):
    """In float64: values (k, n), and per input the central difference of their weighted sum; `step` relative to each
    input's size."""
    inputs = [np.asarray(v, np.float64) for v in inputs]
    values = np.array(function(ops, *inputs))
    weights = 1 / np.arange(1, len(values) + 1)
    gradients = []
    for i, x in enumerate(inputs):
        width = step * np.maximum(np.abs(x), 1e-2)
        moved = [[*inputs[:i], x + s, *inputs[i + 1:]] for s in (width, -width)]
        up, down = (weights @ np.array(function(ops, *m)) for m in moved)
        gradients.append((up - down) / (2 * width))
    return values, np.array(gradients)
