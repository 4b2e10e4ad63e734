"""Copies of NumPy arrays for Dr.Jit."""

import drjit as dr
import numpy as np
import pytest

from mi_ntf.infer.backend import floats


@pytest.mark.parametrize("shift", range(0, 16, 3))
def test_kernels_do_not_depend_on_where_numpy_put_its_numbers(variant, shift):
    """Dr.Jit fetches rows of four at once from aligned memory alone."""
    dj = variant
    values = np.arange(100, dtype=np.float32)[shift : shift + 64].reshape(8, 8)

    def kernel(array):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            row = dr.gather(dj.Array4f, array, dr.opaque(dj.UInt32, 3, 5))
            dr.eval(row)
            actual = [k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        np.testing.assert_array_equal(row.numpy()[:, 0], values.ravel()[12:16])
        return actual

    assert kernel(floats(values, dj)) == kernel(floats(np.repeat(values, 2, 1)[:, ::2], dj)) != []
