"""The same numbers from every OpenCL runtime of the machine: skipped where there is only one.

tools/portability.py installs some and runs this.
"""

import numpy as np
import pyopencl as cl
import pytest
from operator_cases import CASES, result

from clra.ops.runtime.devices import choose_device, devices

SAME = 1e-5  # of the largest value


@pytest.fixture(scope="module")
def others(context) -> list[cl.Context]:
    """A context for each device but the default one."""
    listed = [choose_device(info.index) for info in devices()]
    found = [cl.Context([device]) for device in listed if device != context.devices[0]]
    if not found:
        pytest.skip("one device only")
    return found


@pytest.mark.parametrize("name", CASES)
def test_every_device_gives_the_same(name, context, queue, others):
    case = CASES[name]
    expected = result(case, case.make(context), queue)
    for theirs in others:
        found = result(case, case.make(theirs), cl.CommandQueue(theirs))
        np.testing.assert_allclose(
            found, expected, rtol=0, atol=SAME * np.abs(expected).max(), err_msg=str(theirs)
        )
