"""The kernels in a host written in C, against the same projection from Python."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyopencl as cl
import pyopencl.array as cl_array
import pytest

from clra import ConeBeamGeometry, ForwardProjector, VolumeGrid
from clra.kernels.__main__ import write

SOURCE = Path(__file__).with_name("project_sphere.c")
NO_DEVICE = 77

# As in project_sphere.c.
VIEWS, COLUMNS, ROWS, N = 5, 23, 19, 21
VOXEL, SOURCE_DISTANCE, DETECTOR_DISTANCE, PIXEL = 0.1, 5.0, 3.0, 0.17
DIAMETER, ATTENUATION = 16, np.float32(1 / 512)
AGREEMENT = 1e-6  # of the longest ray's integral: only roundings differ


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    """Built beside the kernels that it reads."""
    folder = tmp_path_factory.mktemp("c host")
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc)")
    trial = folder / "trial.c"
    trial.write_text("#include <CL/cl.h>\nint main(void) { return clFinish(0) == 0; }\n")
    if subprocess.run(
        [compiler, trial, "-lOpenCL", "-o", folder / "trial"], capture_output=True, check=False
    ).returncode:
        pytest.skip("no OpenCL headers or loader (Debian: ocl-icd-opencl-dev, opencl-headers)")
    write(folder)
    built = folder / "project_sphere"
    warnings = ["-std=c99", "-Wall", "-Wextra", "-Werror"]
    command = [compiler, *warnings, f"-I{folder}", SOURCE, "-lOpenCL", "-lm", "-o", built]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return built


def environments(folder: Path) -> list[dict[str, str]]:
    """The machine's own drivers, then those of wheels: Intel's CPU runtime and PoCL."""
    found = [dict(os.environ)]
    wheels = [Path(sys.prefix) / "lib" / "libintelocl.so"]
    wheels += Path(cl.__file__).parent.glob(".libs/libpocl*")
    for driver in filter(Path.exists, wheels):
        icds = folder / f"{driver.name} alone"
        icds.mkdir()
        (icds / "driver.icd").write_text(f"{driver}\n")
        found.append({**os.environ, "OCL_ICD_VENDORS": str(icds)})
    return found


def from_c(program: Path, folder: Path) -> np.ndarray:
    out = folder / "projections"
    for environment in environments(folder):
        done = subprocess.run(
            [program, program.parent, out],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != NO_DEVICE:
            assert done.returncode == 0, done.stderr
            return np.fromfile(out, np.float32).reshape(VIEWS, ROWS, COLUMNS)
    pytest.skip(f"the C program: {done.stderr.strip()}")


def from_python(context: cl.Context) -> np.ndarray:
    angle = 0.3 + 1.1 * np.arange(VIEWS)
    zero, one = np.zeros(VIEWS), np.ones(VIEWS)
    outward = np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
    geometry = ConeBeamGeometry(
        source=SOURCE_DISTANCE * outward,
        detector=-DETECTOR_DISTANCE * outward,
        u=PIXEL * np.stack([-np.sin(angle), np.cos(angle), zero], axis=1),
        v=-PIXEL * np.stack([zero, zero, one], axis=1),
        shape=(ROWS, COLUMNS),
    )
    grid = VolumeGrid(shape=(N, N, N), voxel_size=VOXEL)
    place = (2 * np.arange(N) - (N - 1)) ** 2
    depth = DIAMETER**2 - (place[:, None, None] + place[:, None] + place)
    queue = cl.CommandQueue(context)
    volume = cl_array.to_device(queue, ATTENUATION * np.maximum(depth, 0).astype(np.float32))
    out = cl_array.empty(queue, (VIEWS, ROWS, COLUMNS), np.float32)
    ForwardProjector(context, geometry, grid)(queue, out, volume)
    return out.get()


def test_a_sphere_projected_from_c_is_that_from_python(program, context, tmp_path):
    expected = from_python(context)
    middle = ATTENUATION * DIAMETER**2 * 2 / 3 * DIAMETER * VOXEL  # closed form through the centre
    assert expected.max() == pytest.approx(middle, rel=0.01)
    np.testing.assert_allclose(
        from_c(program, tmp_path), expected, rtol=0, atol=AGREEMENT * expected.max()
    )


def test_the_c_program_says_how_it_is_called(program):
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "usage: " in done.stderr
