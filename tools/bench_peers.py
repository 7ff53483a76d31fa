"""Other software's projectors on the work of :mod:`bench_cases`, for ``bench.py --peer``.

A peer's methods take what clra's operators take, in numpy arrays (LEAP's for ideal circles and
helices alone), and return a function that does the work once. What it returns is comparable with
clra's, where it returns something.
"""

import os
import tempfile
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clra import ConeBeamGeometry, VolumeGrid
from clra.io.motion_formats.rtk import write_rtk_geometry

Floats = NDArray[np.float32]
Run = Callable[[], Any]


class Peer(Protocol):
    """Software to compare with."""

    name: str

    def back(self, geometry: ConeBeamGeometry, grid: VolumeGrid, projections: Floats) -> Run:
        """Back-project with the weights of FDK."""

    def forward(self, geometry: ConeBeamGeometry, grid: VolumeGrid, volume: Floats) -> Run:
        """Project a volume."""

    def fdk(self, geometry: ConeBeamGeometry, grid: VolumeGrid, projections: Floats) -> Run:
        """Filter and back-project."""


def threads() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


class Rtk:
    """RTK (the wheel ``itk-rtk``): FDK's voxel-driven back-projection and Joseph's projector.

    RTK turns about its y axis: its (x, y, z) are our (x, z, -y).
    """

    name = "rtk"

    def __init__(self) -> None:
        try:
            import itk
            from itk import RTK
        except ImportError as error:
            raise RuntimeError("itk-rtk is not installed (pip install itk-rtk)") from error
        itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(threads())
        self._itk, self._rtk = itk, RTK
        self._image_type = itk.Image[itk.F, 3]

    def back(self, geometry: ConeBeamGeometry, grid: VolumeGrid, projections: Floats) -> Run:
        """Back-project with the weights of FDK."""
        empty = self._volume(grid, np.zeros(grid.shape, np.float32))
        inputs = (empty, self._projections(geometry, projections))
        return self._run("FDKBackProjectionImageFilter", geometry, inputs, _volume_back)

    def forward(self, geometry: ConeBeamGeometry, grid: VolumeGrid, volume: Floats) -> Run:
        """Project a volume."""
        shape = (geometry.views, *geometry.shape)
        empty = self._projections(geometry, np.zeros(shape, np.float32))
        inputs = (empty, self._volume(grid, volume))
        return self._run("JosephForwardProjectionImageFilter", geometry, inputs, np.array)

    def fdk(self, geometry: ConeBeamGeometry, grid: VolumeGrid, projections: Floats) -> Run:
        """Filter and back-project."""
        empty = self._volume(grid, np.zeros(grid.shape, np.float32))
        inputs = (empty, self._projections(geometry, projections))
        return self._run("FDKConeBeamReconstructionFilter", geometry, inputs, _volume_back)

    def _run(
        self,
        name: str,
        geometry: ConeBeamGeometry,
        inputs: tuple[Any, Any],
        result: Callable[[Any], Floats],
    ) -> Run:
        kind = getattr(self._rtk, name)
        kind = kind[self._image_type] if "Cone" in name else kind[(self._image_type,) * 2]
        orbit = self._geometry(geometry)

        def run() -> Callable[[], Floats]:
            # A filter that is up to date does nothing: each run takes a new one.
            task = kind.New()
            task.SetInput(0, inputs[0])
            task.SetInput(1, inputs[1])
            task.SetInPlace(False)
            task.SetGeometry(orbit)
            task.Update()
            return lambda: result(self._itk.array_from_image(task.GetOutput()))

        return run

    def _geometry(self, geometry: ConeBeamGeometry) -> Any:
        # Through its file, which knows any rectangular detector.
        with tempfile.NamedTemporaryFile(suffix=".xml") as file:
            write_rtk_geometry(file.name, geometry)
            reader = self._rtk.ThreeDCircularProjectionGeometryXMLFileReader.New()
            reader.SetFilename(file.name)
            reader.GenerateOutputInformation()
            return reader.GetOutputObject()

    def _projections(self, geometry: ConeBeamGeometry, projections: Floats) -> Any:
        pitch = [float(np.linalg.norm(step[0])) for step in (geometry.u, geometry.v)]
        return self._image(projections, [*pitch, 1.0])

    def _volume(self, grid: VolumeGrid, volume: Floats) -> Any:
        turned = volume.transpose(1, 0, 2)[::-1]
        return self._image(turned, [float(grid.voxel_size)] * 3)

    def _image(self, values: Floats, spacing: list[float]) -> Any:
        image = self._itk.image_from_array(np.ascontiguousarray(values, np.float32))
        image.SetSpacing(spacing)
        sizes = values.shape[::-1]
        image.SetOrigin([-0.5 * (n - 1) * d for n, d in zip(sizes, spacing, strict=True)])
        return image


def _volume_back(values: Floats) -> Floats:
    """From RTK's axes to ours."""
    return np.ascontiguousarray(values[::-1].transpose(1, 0, 2))


class Leap:
    """LEAP (built for the CPU, ``leapctype`` importable): separable footprints, matched."""

    name = "leap"

    def __init__(self) -> None:
        try:
            from leapctype import tomographicModels
        except (ImportError, OSError) as error:
            raise RuntimeError("LEAP's library is not found (github.com/LLNL/LEAP)") from error
        self._models = tomographicModels

    def back(self, geometry: ConeBeamGeometry, grid: VolumeGrid, projections: Floats) -> Run:
        """Back-project with the transpose of the projector."""
        models, volume = self._set_up(geometry, grid), np.zeros(grid.shape, np.float32)
        return lambda: models.backproject(projections, volume)

    def forward(self, geometry: ConeBeamGeometry, grid: VolumeGrid, volume: Floats) -> Run:
        """Project a volume."""
        models = self._set_up(geometry, grid)
        projections = np.zeros((geometry.views, *geometry.shape), np.float32)
        return lambda: models.project(projections, volume)

    def fdk(self, geometry: ConeBeamGeometry, grid: VolumeGrid, projections: Floats) -> Run:
        """Filter and back-project."""
        models, volume = self._set_up(geometry, grid), np.zeros(grid.shape, np.float32)
        return lambda: models.FBP(projections, volume)

    def _set_up(self, geometry: ConeBeamGeometry, grid: VolumeGrid) -> Any:
        models = self._models()
        models.set_gpu(-1)
        rows, columns = geometry.shape
        angles = np.unwrap(np.arctan2(geometry.source[:, 0], -geometry.source[:, 1]))
        rise = np.ptp(geometry.source[:, 2]) / np.ptp(angles)
        models.set_conebeam(
            geometry.views,
            rows,
            columns,
            float(np.linalg.norm(geometry.v[0])),
            float(np.linalg.norm(geometry.u[0])),
            0.5 * (rows - 1),
            0.5 * (columns - 1),
            np.degrees(angles).astype(np.float32),
            float(geometry.source_to_axis[0]),
            float(geometry.source_to_detector[0]),
            helicalPitch=float(rise),
        )
        nz, ny, nx = grid.shape
        models.set_volume(nx, ny, nz, grid.voxel_size, grid.voxel_size)
        return models


class Astra:
    """ASTRA on CUDA: its geometries are ours; runs include what goes to the GPU and comes back."""

    name = "astra"

    def __init__(self) -> None:
        try:
            import astra
        except ImportError as error:
            raise RuntimeError("ASTRA is not installed (conda install astra-toolbox)") from error
        if not astra.use_cuda():
            raise RuntimeError("ASTRA finds no CUDA")
        self._astra = astra

    def back(self, geometry: ConeBeamGeometry, grid: VolumeGrid, projections: Floats) -> Run:
        """Back-project without weights."""
        return self._runs(
            "BP3D_CUDA", geometry, grid, projections, np.zeros(grid.shape, np.float32)
        )

    def forward(self, geometry: ConeBeamGeometry, grid: VolumeGrid, volume: Floats) -> Run:
        """Project a volume."""
        projections = np.zeros((geometry.views, *geometry.shape), np.float32)
        return self._runs("FP3D_CUDA", geometry, grid, projections, volume)

    def fdk(self, geometry: ConeBeamGeometry, grid: VolumeGrid, projections: Floats) -> Run:
        """Filter and back-project."""
        volume = np.zeros(grid.shape, np.float32)
        return self._runs("FDK_CUDA", geometry, grid, projections, volume)

    def _runs(
        self,
        algorithm: str,
        geometry: ConeBeamGeometry,
        grid: VolumeGrid,
        projections: Floats,
        volume: Floats,
    ) -> Run:
        astra = self._astra
        nz, ny, nx = grid.shape
        ends = [
            end
            for n, middle in zip((nx, ny, nz), grid.centre, strict=True)
            for end in (middle - 0.5 * n * grid.voxel_size, middle + 0.5 * n * grid.voxel_size)
        ]
        volumes = astra.create_vol_geom(ny, nx, nz, *ends)
        rows, columns = geometry.shape
        cone = astra.create_proj_geom("cone_vec", rows, columns, geometry.to_astra())
        # ASTRA's projections are (row, view, column).
        sinograms = np.ascontiguousarray(projections.transpose(1, 0, 2))
        settings = astra.astra_dict(algorithm)
        settings["ProjectionDataId"] = astra.data3d.link("-sino", cone, sinograms)
        name = "VolumeDataId" if algorithm == "FP3D_CUDA" else "ReconstructionDataId"
        settings[name] = astra.data3d.link("-vol", volumes, volume)
        made = astra.algorithm.create(settings)
        return lambda: astra.algorithm.run(made)


PEERS: dict[str, Callable[[], Peer]] = {"rtk": Rtk, "leap": Leap, "astra": Astra}
