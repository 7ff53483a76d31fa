"""Device arrays that are not simply all of a buffer."""

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array


def with_offset(queue: cl.CommandQueue, values: np.ndarray, skip: int = 3) -> cl_array.Array:
    """An array that starts `skip` elements into its buffer and ends before the buffer does."""
    padded = np.full(values.size + 2 * skip, np.nan, values.dtype)
    padded[skip : skip + values.size] = values.ravel()
    return cl_array.to_device(queue, padded)[skip : skip + values.size].reshape(values.shape)
