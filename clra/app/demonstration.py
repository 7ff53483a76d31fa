"""The demonstration: a simulated scan, aligned and reconstructed."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clra.app.annotations import annotated
from clra.app.report.html_report import write_report
from clra.app.report.summary import Errors, findings_of, summary_of
from clra.app.simulation import paper_like, sample, simulated_motion, simulated_scan
from clra.io.alignment_file import write_alignment
from clra.io.scan_files import read_scan, write_scan
from clra.io.volumes.volume_files import write_volume
from clra.methods.alignment.align import align
from clra.methods.alignment.result import AlignmentResult
from clra.methods.reconstruction.reconstruct import reconstruct
from clra.model.grid import default_grid

if TYPE_CHECKING:
    from clra.progress import ProgressCallback

# Chosen so that all of it ends within a minute on two cores without a GPU.
VIEWS, DETECTOR = 360, (256, 192)
_SHIFT, _MAGNIFICATION, _PHOTONS = (-10.0, 10.0), 0.002, 20000.0


@dataclass(frozen=True)
class Shown:
    """What the demonstration made.

    Attributes
    ----------
    folder : Path
        Holds scan.nxs, motion.h5, before.h5, after.h5 and report.html.
    result : AlignmentResult
        Of the alignment.
    errors : Errors
        Against the motion that was put in.
    """

    folder: Path
    result: AlignmentResult
    errors: Errors

    def values(self) -> dict[str, Any]:
        """Results for programs."""
        values, _ = summary_of(self.result, self.errors)
        files = {name: self.folder / name for name in ("scan.nxs", "motion.h5", "report.html")}
        return {"folder": self.folder, "files": files, **values}

    def text(self) -> str:
        """Results for people."""
        _, text = summary_of(self.result, self.errors)
        return (
            f"{text}\n\nscan.nxs, motion.h5, before.h5 and after.h5 are in {self.folder}\n"
            f"report: {self.folder / 'report.html'}"
        )


def run_demo(
    folder: Path | None = None,
    *,
    views: int = VIEWS,
    detector: tuple[int, int] = DETECTOR,
    schedule: str = "auto",
    phantom: str = "porous",
    seed: int = 0,
    device: Any = None,
    progress: "ProgressCallback | None" = None,
) -> Shown:
    """Simulate a space-filling scan, align it, reconstruct it before and after, report.

    Parameters
    ----------
    folder : Path, optional
        For the files; a new temporary one if not given.
    views : int
        Number of radiographs.
    detector : (int, int)
        Rows and columns of a radiograph.
    schedule : str
        Of the alignment.
    phantom : {"porous", "spheres"}
        The sample.
    seed : int
        Of all random numbers.
    device : str or cl.Device, optional
        Where to compute.
    progress : callable, optional
        Told how far it is.
    """
    if folder is None:
        folder = Path(tempfile.mkdtemp(prefix="clra-demo-"))
    folder.mkdir(parents=True, exist_ok=True)
    geometry = paper_like("space-filling", views, detector)
    truth = simulated_motion(
        "both", geometry, shift=_SHIFT, magnification=_MAGNIFICATION, seed=seed
    )
    simulated = simulated_scan(
        geometry, sample(phantom, geometry, seed), truth, noise=_PHOTONS, seed=seed, name="demo"
    )
    write_scan(folder / "scan.nxs", simulated, progress=progress)
    scan = read_scan(folder / "scan.nxs")
    result = align(scan, schedule=schedule, device=device, progress=progress)
    command = f"clra align scan.nxs -o motion.h5 --schedule {schedule} --report report.html"
    result = annotated(result, scan, command=command)
    write_alignment(folder / "motion.h5", result)
    grid = default_grid(scan.geometry)
    for name, motion in (("before.h5", None), ("after.h5", result.motion)):
        volume = reconstruct(scan, grid=grid, motion=motion, device=device, progress=progress)
        write_volume(folder / name, volume, grid)
    findings = findings_of(result, scan, device=device, progress=progress)
    write_report(folder / "report.html", findings)
    assert findings.errors is not None  # a simulated scan knows its motion
    return Shown(folder, result, findings.errors)
