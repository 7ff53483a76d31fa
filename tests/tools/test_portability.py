"""What tools/portability.py makes of a checker's complaints."""

import importlib.util
import sys
from pathlib import Path

import pytest

_FILE = Path(__file__).parents[2] / "tools" / "portability.py"

OUTPUT = """
Oclgrind - OpenCL runtime error detected
\tFunction: clGetDeviceInfo
\tError:    CL_INVALID_VALUE
\tFor argument 'param_name'

.
Oclgrind - OpenCL runtime error detected
\tFunction: clEnqueueNDRangeKernel
\tError:    CL_INVALID_WORK_GROUP_SIZE

"""


@pytest.fixture(scope="module")
def portability():
    spec = importlib.util.spec_from_file_location("portability", _FILE)
    module = importlib.util.module_from_spec(spec)
    sys.modules["portability"] = module
    spec.loader.exec_module(module)
    return module


def test_complaints_are_told_from_probing(portability):
    (complaint,) = portability.api_errors(OUTPUT)
    assert "clEnqueueNDRangeKernel" in complaint
    assert "CL_INVALID_WORK_GROUP_SIZE" in complaint


def test_what_is_missing_is_skipped_with_a_word(portability, tmp_path):
    one = portability.Run(("tests/test_package.py",), lambda: "no driver", {})
    assert portability.run("some", one, tmp_path) == ("skipped", "no driver")


def test_another_device_than_expected_is_skipped(portability, tmp_path):
    one = portability.Run(("tests/test_package.py",), str, {}, "a device that nobody has")
    state, word = portability.run("some", one, tmp_path)
    assert state == "skipped"
    assert "expected a device that nobody has" in word


def test_every_file_that_is_run_is_there(portability):
    for quick in (True, False):
        for one in portability.runs(quick).values():
            assert all((portability.ROOT / test).exists() for test in one.tests)
