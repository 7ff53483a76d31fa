"""What is tried on a device before it is trusted."""

import json
import subprocess
import sys

import numpy as np
import pytest

from clra import kernels
from clra.ops.runtime import build, devices, pocl, self_test, trial


def test_every_answer_is_right_here(queue):
    for name, (case, tolerance) in trial.CASES.items():
        found, expected = case(queue)
        assert found.shape == expected.shape and found.size, name
        np.testing.assert_allclose(
            found, expected, rtol=0, atol=tolerance * np.abs(expected).max(), err_msg=name
        )
    assert trial.failure(queue) == ""
    assert trial.rate(queue) > 0


@pytest.mark.parametrize("factor", [1.001, np.nan])
def test_wrong_numbers_are_a_failure(queue, monkeypatch, factor):
    case = trial.CASES["back-projection"][0]

    def wrong(queue):
        found, expected = case(queue)
        return found * factor, expected

    monkeypatch.setitem(trial.CASES, "back-projection", (wrong, trial.TOLERANCE))
    assert trial.failure(queue).startswith("back-projection: wrong numbers, off by ")


@pytest.mark.parametrize(
    ("text", "other", "failure"),
    [
        ("floor(x * 0.3f)", "ceil(x * 0.3f)", "vectors: wrong numbers"),
        ("sums[i - step]", "sums[i]", "local memory: wrong numbers"),
        ("vload16(i, in)", "vload17(i, in)", "local memory: clBuildProgram failed"),
    ],
)
def test_what_a_compiler_may_get_wrong_is_noticed(queue, monkeypatch, text, other, failure):
    assert text in trial._BASICS
    monkeypatch.setattr(trial, "_BASICS", trial._BASICS.replace(text, other))
    assert trial.failure(queue).startswith(failure)


def test_a_kernel_that_does_not_build_is_a_failure(context, monkeypatch):
    source = kernels.source
    monkeypatch.setattr(kernels, "source", lambda file: f"{source(file)}\nthis is no C\n")
    theirs = type(context)(context.devices)  # in the tests' own one the kernels are built already
    failure = trial.failure(build.cl.CommandQueue(theirs))
    assert failure.startswith("back-projection: kernel ") and "does not build" in failure
    assert "\n" not in failure


def test_another_device_than_the_one_meant_is_refused():
    index = devices.devices()[0].index
    with pytest.raises(LookupError, match="is another one here"):
        trial.main(json.dumps({"index": index, "identity": ["x"], "cpu": None, "rate": False}))


# A trial whose device was given a name that does not belong to PoCL's built-ins.
_FORGED = """
import json, sys
from clra.ops.runtime import devices, pocl, trial
request, name, paired = sys.argv[1:]
device = devices.device_at(json.loads(request)["index"])
assert pocl.pair_record(device.int_ptr, device.version, name)
if paired == "no":
    pocl.build_options = lambda devices: ["-DUNPAIRED_" + name.replace("-", "_")]
    trial.CASES = {"back-projection": trial.CASES["back-projection"]}  # others may take minutes
trial.main(request)
"""


def forged(device, index, name, paired):
    """Status and answer, or last words, of a trial on a PoCL whose compiler was given that name."""
    request = {"index": index, "identity": self_test.identity(device), "cpu": None, "rate": False}
    done = subprocess.run(
        [sys.executable, "-P", "-W", "ignore", "-c", _FORGED, json.dumps(request), name, paired],
        capture_output=True,
        text=True,
        timeout=120,
    )
    if done.returncode:
        return done.returncode, {"failure": done.stderr}
    return 0, json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("name", ["znver3", "generic"])
@pytest.mark.slow
def test_a_cpu_name_that_does_not_fit_the_built_ins_ends_the_trial_and_pairing_cures_it(name):
    usual = pocl.cpu_of_variant(pocl.cpu_flags())
    for info in devices.devices():
        device = devices.device_at(info.index)
        if pocl.needs_pairing(device) and pocl.pair_record(device.int_ptr, device.version, usual):
            break
    else:
        pytest.skip("no PoCL before 5.0 that pairs its compiler wrongly")
    status, answer = forged(device, info.index, name, "yes")
    assert (status, answer["failure"]) == (0, "")
    status, answer = forged(device, info.index, name, "no")
    if status == 0 and not answer["failure"]:
        pytest.skip(f"the built-ins for {usual} work with {name} on this CPU")
    # SIGABRT or SIGSEGV of the compiler, SIGILL of a kernel, numbers, or no build at all.
    assert status < 0 or answer["failure"]
