"""The command that reconstructs, and the options of its iterative methods."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from clra.app.console import Console, Memory, Reading
from clra.app.correcting import Correcting
from clra.app.planning.cluster_option import Cluster
from clra.errors import InputError

if TYPE_CHECKING:
    from clra.model.geometry import ConeBeamGeometry
    from clra.model.grid import VolumeGrid


@dataclass(frozen=True)
class Iterating:
    """How osem-tr and imgr iterate; each has a default that suits."""

    subsets: Annotated[
        int | None, typer.Option(metavar="N", help="osem-tr, imgr: subsets of the views.")
    ] = None
    passes: Annotated[
        int | None, typer.Option(metavar="N", help="osem-tr, imgr: how often all views are used.")
    ] = None
    update: Annotated[
        str | None,
        typer.Option(
            metavar="paraboloid|optimal|multiplicative", help="osem-tr, imgr: form of the update."
        ),
    ] = None
    initial: Annotated[
        str | None,
        typer.Option(metavar="fbp|uniform|VOLUME", help="osem-tr, imgr: volume to start from."),
    ] = None
    i0: Annotated[
        float | None,
        typer.Option(metavar="PHOTONS", help="osem-tr, imgr: counts a pixel of the open beam."),
    ] = None
    background: Annotated[
        float | None,
        typer.Option(metavar="PHOTONS", help="osem-tr, imgr: counts a pixel that are scatter."),
    ] = None
    levels: Annotated[
        str | None,
        typer.Option(metavar="QR-HR-FR", help="imgr: resolutions of a cycle; ER is an eighth."),
    ] = None
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on where this command was interrupted.")
    ] = False

    def options(self) -> dict[str, Any]:
        """Return the options that were given, by name."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "resume"}
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class Sampling:
    """Which voxels, of which pixels."""

    roi: Annotated[
        str | None,
        typer.Option(
            metavar="X0:X1,Y0:Y1,Z0:Z1",
            help="Region to reconstruct, in mm from the axis and the scan's middle height; an end "
            "that is left out is that of the field of view.",
        ),
    ] = None
    voxel_size: Annotated[
        float | None,
        typer.Option(metavar="MM", help="Edge of a voxel; by default a pixel seen at the axis."),
    ] = None
    bin: Annotated[
        int, typer.Option(metavar="N", help="Average N x N pixels (and so voxels) first.")
    ] = 1
    window: Annotated[
        str,
        typer.Option(
            metavar="ram-lak|shepp-logan|hann",
            help="fbp: window of the ramp filter, against noise.",
        ),
    ] = "ram-lak"

    def options(self) -> dict[str, Any]:
        """Return what `reconstruct` takes, but for the grid."""
        from clra.ops.filtering.ramp import WINDOWS

        if self.bin < 1:
            raise InputError(f"--bin: found {self.bin}, expected 1 or more")
        if self.window not in WINDOWS:
            raise InputError(f"--window: found {self.window!r}, expected {', '.join(WINDOWS)}")
        return {"binning": self.bin, "window": self.window}

    def grid(self, geometry: "ConeBeamGeometry") -> "VolumeGrid":
        """Return the grid that is asked for."""
        from clra.app.arguments import region
        from clra.model.grid import volume_grid

        roi = None if self.roi is None else region("--roi", self.roi)
        return volume_grid(geometry.binned(self.bin), roi=roi, voxel_size=self.voxel_size)


@dataclass(frozen=True)
class Storing:
    """How voxels are stored."""

    dtype: Annotated[
        str,
        typer.Option(
            metavar="float32|uint16|uint8", help="Of the voxels; integers with their scale."
        ),
    ] = "float32"
    limits: Annotated[
        str,
        typer.Option(
            metavar="LOW,HIGH|LOW%,HIGH%",
            help="Values in 1/mm, or percentiles of the voxels, that are the least and the "
            "greatest integer.",
        ),
    ] = "0.01%,99.99%"
    compress: Annotated[
        bool, typer.Option("--compress", help="Compress a .h5; .zarr is in any case.")
    ] = False

    def options(self) -> dict[str, Any]:
        """Return what `open_volume` takes."""
        from clra.app.arguments import limits_of_integers
        from clra.io.volumes.volume_description import TYPES

        if self.dtype not in TYPES:
            raise InputError(f"--dtype: found {self.dtype!r}, expected one of {', '.join(TYPES)}")
        limits = limits_of_integers("--limits", self.limits)
        compression = "gzip" if self.compress else None
        return {"dtype": self.dtype, "limits": limits, "compression": compression}


def reconstruct(
    console: Console,
    reading: Reading,
    memory: Memory,
    sampling: Sampling,
    storing: Storing,
    iterating: Iterating,
    correcting: Correcting,
    scan: Annotated[Path, typer.Argument(metavar="SCAN", help="NXtomo file.")],
    out: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="VOLUME",
            help="Volume to write: .h5, .tif, .zarr, .nrrd or .raw.",
        ),
    ],
    method: Annotated[
        str,
        typer.Option(
            metavar="fbp|katsevich|osem-tr|imgr",
            help="Ramp-filtered back-projection, for any trajectory; Katsevich's exact one, for "
            "helices; ordered subsets for counted photons; multigrid iteration.",
        ),
    ] = "fbp",
    motion: Annotated[
        Path | None, typer.Option(metavar="MOTION.h5", help="Motion to correct, from clra align.")
    ] = None,
    align: Annotated[
        bool,
        typer.Option(
            "--align", help="Align the scan first, as clra align would; imgr does it on the way."
        ),
    ] = False,
    cluster: Cluster = None,
) -> None:
    """Reconstruct a volume.

    Covers the whole field of view, in 1/mm. The motion goes into the geometry: no radiograph is
    resampled; with katsevich each is, once. Whatever interrupts osem-tr, imgr or --align, finished
    passes, levels and iterations stay beside the volume, and --resume goes on from there.

    Examples
    --------
      clra reconstruct scan.nxs -o volume.h5 --motion motion.h5
      clra reconstruct scan.nxs -o volume.tif --align --dtype uint16
      clra reconstruct scan.nxs -o part.zarr --motion motion.h5 --roi=-1:1,-1:1,0:0.5
      clra reconstruct scan.nxs -o overview.h5 --bin 4
      clra reconstruct helix.nxs -o volume.h5 --method katsevich --align
      clra reconstruct scan.nxs -o volume.h5 --method imgr --align
      clra reconstruct noisy.nxs -o volume.h5 --method osem-tr --i0 4000 --passes 2
      clra reconstruct scan.nxs -o volume.h5 --motion motion.h5 --cluster local:4
    """
    from clra.app.annotations import alignment_for
    from clra.app.arguments import volume_file
    from clra.app.exit_status import command_line, keeping
    from clra.app.scan_description import metric
    from clra.app.session.overall_progress import align_parts, reconstruction_parts
    from clra.io.atomic import ensure_writable
    from clra.io.provenance import provenance
    from clra.io.volumes.raw_volume import sidecar
    from clra.io.volumes.volume_files import open_volume
    from clra.methods.execution.checkpoint import Checkpoint
    from clra.methods.reconstruction.iterative import options_for
    from clra.methods.reconstruction.reconstruct import METHODS, reconstruct_into
    from clra.model.schedule import parse_schedule

    volume_file(out)
    limits = memory.limits()
    if motion is not None and align:
        raise InputError("--motion, --align: found both, expected one of them")
    if method not in METHODS:
        raise InputError(f"--method: found {method!r}, expected one of {', '.join(METHODS)}")
    given = iterating.options()
    sampled, stored = sampling.options(), storing.options()
    opened = reading.scan(scan)
    grid = sampling.grid(opened.cropped().geometry)
    initial = None
    if given.get("initial") not in (None, "fbp", "uniform"):
        initial = Path(given["initial"])
        given["initial"] = _start(initial, grid)
    options = options_for(method, given)
    if iterating.resume and options is None and not align:
        expected = "osem-tr, imgr or --align"
        raise InputError(f"--resume: found it with --method {method}, expected {expected}")
    alignment = None
    if motion is not None:
        opened, alignment = alignment_for(opened, motion, reading.geometry())
    nz, ny, nx = grid.shape
    ensure_writable(out, (scan, motion, initial), 4 * nz * ny * nx)
    if out.suffix.lower() == ".raw":
        ensure_writable(sidecar(out), (scan, motion, initial))
    made = provenance(
        command=command_line(),
        scan=opened,
        alignment=alignment,
        method=method,
        options=options,
        grid=grid,
    )
    checkpoint = Checkpoint(f"{out}.resume", resume=iterating.resume)
    parts = reconstruction_parts(method)
    if align and method != "imgr":
        stages = parse_schedule("auto", opened.cropped().geometry.shape)
        parts = [*align_parts("ra", stages), *parts]
    with console.progress(parts) as progress, keeping(checkpoint):
        with open_volume(out, grid, provenance=made, **stored) as target:
            done = reconstruct_into(
                target,
                opened,
                method=method,
                grid=grid,
                align=align,
                device=console.device,
                alignment=alignment,
                options=options,
                corrections=correcting.options(),
                progress=progress,
                checkpoint=checkpoint,
                cluster=cluster,
                **sampled,
                **limits,
            )
        checkpoint.clear()
    values = {"file": out, "shape": grid.shape, "voxel_mm": grid.voxel_size, "units": "1/mm"}
    lines = [f"wrote {out}: {nx} x {ny} x {nz} voxels of {metric(grid.voxel_size)}, in 1/mm"]
    if done.steps:
        values["steps"] = done.steps
        lines += [f"  cycle {s.cycle}, {s.level}: misfit {s.misfit:.4g} before" for s in done.steps]
    console.summary(values, "\n".join(lines))


def _start(path: Path, grid: "VolumeGrid") -> Any:
    """Read a volume to start from."""
    from clra.io.volumes.volume_files import read_volume

    volume, found = read_volume(path)
    if found.shape != grid.shape:
        raise InputError.at(path, "/volume", f"shape {found.shape}", f"{grid.shape} as of the scan")
    return volume
