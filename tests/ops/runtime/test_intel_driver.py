"""Intel's driver is registered where it is installed, and the others stay."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from clra.ops.runtime import devices, intel_driver


@pytest.fixture(autouse=True)
def installed(monkeypatch, tmp_path):
    """A driver in an environment without any other, and variables that come back."""
    for name in intel_driver.CHOSEN:
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    driver = tmp_path / "env" / "lib" / "libintelocl.so"
    driver.parent.mkdir(parents=True)
    driver.write_text("")
    monkeypatch.setattr(intel_driver, "find", lambda: driver)
    monkeypatch.setattr(intel_driver, "SYSTEM", tmp_path / "vendors")
    return driver


def vendors() -> dict[str, str]:
    folder = Path(os.environ["OCL_ICD_VENDORS"])
    return {file.name: file.read_text() for file in folder.iterdir()}


def test_the_driver_is_put_beside_those_of_the_system(installed, tmp_path):
    (tmp_path / "vendors").mkdir()
    (tmp_path / "vendors" / "nvidia.icd").write_text("libnvidia-opencl.so.1\n")
    (tmp_path / "vendors" / "gone.icd").write_text("/opt/nowhere/libgone.so\n")
    intel_driver.register(tmp_path)
    first = os.environ["OCL_ICD_VENDORS"]
    expected = {"nvidia.icd": "libnvidia-opencl.so.1\n", "clra-intel.icd": f"{installed}\n"}
    assert vendors() == expected
    intel_driver.register(tmp_path)  # it is chosen now
    assert os.environ["OCL_ICD_VENDORS"] == first
    del os.environ["OCL_ICD_VENDORS"]
    (tmp_path / "vendors" / "other.icd").write_text("libother.so\n")
    intel_driver.register(tmp_path)
    assert vendors() == {**expected, "other.icd": "libother.so\n"}
    assert os.environ["OCL_ICD_VENDORS"] != first


def test_who_chooses_drivers_himself_is_left_alone(monkeypatch, tmp_path):
    for name in intel_driver.CHOSEN:
        with monkeypatch.context() as patch:
            patch.setenv(name, "mine")
            intel_driver.register(tmp_path)
            assert os.environ[name] == "mine"
            assert name == "OCL_ICD_VENDORS" or "OCL_ICD_VENDORS" not in os.environ


def test_a_driver_that_is_registered_already_is_left_alone(tmp_path):
    (tmp_path / "vendors").mkdir()
    (tmp_path / "vendors" / "intel64.icd").write_text("libintelocl.so\n")
    intel_driver.register(tmp_path)
    assert "OCL_ICD_VENDORS" not in os.environ


def test_without_the_packages_nothing_is_done(monkeypatch, tmp_path):
    monkeypatch.setattr(intel_driver, "find", lambda: None)
    intel_driver.register(tmp_path)
    assert "OCL_ICD_VENDORS" not in os.environ


def test_a_folder_that_cannot_be_made_leaves_the_drivers_of_the_system(tmp_path):
    (tmp_path / "file").write_text("")
    intel_driver.register(tmp_path / "file")
    assert "OCL_ICD_VENDORS" not in os.environ


def test_importing_clra_registers_nothing():
    code = (
        "import os, clra; clra.align, clra.read_scan;"
        "assert 'OCL_ICD_VENDORS' not in os.environ, os.environ['OCL_ICD_VENDORS']"
    )
    subprocess.run([sys.executable, "-P", "-c", code], check=True)


@pytest.mark.skipif(
    not (Path(sys.prefix) / "lib" / "libintelocl.so").exists(),
    reason="Intel's runtime is not installed (pip install 'clra[intel]')",
)
def test_intels_runtime_is_found_and_pocl_stays_the_default():
    code = (
        "from clra.ops.runtime import devices;"
        "print([info.platform for info in devices.devices()]);"
        "print(devices.choose_device().platform.name)"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], check=True, capture_output=True, text=True
    )
    listed, chosen = done.stdout.splitlines()
    assert "Intel(R) OpenCL" in listed
    if "Portable Computing Language" in listed:
        assert chosen == "Portable Computing Language"


def test_pocl_goes_before_other_drivers_of_a_cpu(monkeypatch):
    import types

    def driver(name, version):
        platform = types.SimpleNamespace(name=name, version=version)
        return types.SimpleNamespace(
            type=devices.cl.device_type.CPU, max_compute_units=2, platform=platform
        )

    pocl = driver("Portable Computing Language", "OpenCL 3.0 PoCL 3.0")
    intel = driver("Intel(R) OpenCL", "OpenCL 3.1 LINUX")
    assert devices._rank(pocl) > devices._rank(intel)
