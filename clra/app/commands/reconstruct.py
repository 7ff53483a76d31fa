"""The command that reconstructs, and the options of its iterative methods."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from clra.app.console import Console, Memory, Reading
from clra.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from clra.methods.reconstruction.imgr_state import ImgrStep
    from clra.model.grid import VolumeGrid
    from clra.model.motion import Motion
    from clra.model.scan import Scan
    from clra.progress import ProgressCallback


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
        bool, typer.Option("--resume", help="imgr: go on where Ctrl-C stopped this command.")
    ] = False

    def options(self) -> dict[str, Any]:
        """Return the options that were given, by name."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "resume"}
        return {name: value for name, value in given.items() if value is not None}


def reconstruct(
    console: Console,
    reading: Reading,
    memory: Memory,
    iterating: Iterating,
    scan: Annotated[Path, typer.Argument(metavar="SCAN", help="NXtomo file.")],
    out: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="VOLUME", help="Volume to write: .h5 or .tif."),
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
) -> None:
    """Reconstruct a volume.

    Covers the whole field of view, in 1/mm. The motion goes into the geometry: no radiograph is
    resampled; with katsevich each is, once. Ctrl-C in imgr keeps the levels finished so far beside
    the volume, and --resume goes on from there.

    Examples
    --------
      clra reconstruct scan.nxs -o volume.h5 --motion motion.h5
      clra reconstruct scan.nxs -o volume.tif --align
      clra reconstruct helix.nxs -o volume.h5 --method katsevich --align
      clra reconstruct scan.nxs -o volume.h5 --method imgr --align
      clra reconstruct noisy.nxs -o volume.h5 --method osem-tr --i0 4000 --passes 2
    """
    from clra.app.arguments import volume_file
    from clra.app.output_checks import alignment_for, room_for
    from clra.app.scan_description import metric
    from clra.io.volumes.volume_files import open_volume
    from clra.methods.reconstruction.iterative import sorted_options
    from clra.methods.reconstruction.reconstruct import METHODS, reconstruct_into
    from clra.model.grid import default_grid

    volume_file(out)
    limits = memory.limits()
    if motion is not None and align:
        raise InputError("--motion, --align: found both, expected one of them")
    if method not in METHODS:
        raise InputError(f"--method: found {method!r}, expected one of {', '.join(METHODS)}")
    if iterating.resume and method != "imgr":
        raise InputError(f"--resume: found it with --method {method}, expected imgr")
    options = iterating.options()
    opened = reading.scan(scan)
    grid = default_grid(opened.cropped().geometry)
    initial = None
    if options.get("initial") not in (None, "fbp", "uniform"):
        initial = Path(options["initial"])
        options["initial"] = _start(initial, grid)
    sorted_options(method, options)
    known = valid_views = None
    if motion is not None:
        opened, alignment = alignment_for(opened, motion, reading.geometry())
        known, valid_views = alignment.motion, alignment.valid_views
    nz, ny, nx = grid.shape
    room_for(out, 4 * nz * ny * nx, keep=(scan, motion, initial))
    steps: tuple[ImgrStep, ...] = ()
    with console.progress() as progress:
        if method == "imgr":
            steps = _imgr(
                opened,
                out,
                grid,
                known,
                valid_views,
                align,
                options,
                iterating.resume,
                console,
                progress,
                limits,
            )
        else:
            with open_volume(out, grid) as target:
                reconstruct_into(
                    target,
                    opened,
                    method=method,
                    grid=grid,
                    motion=known,
                    align=align,
                    valid_views=valid_views,
                    device=console.device,
                    progress=progress,
                    **limits,
                    **options,
                )
    values = {"file": out, "shape": grid.shape, "voxel_mm": grid.voxel_size, "units": "1/mm"}
    lines = [f"wrote {out}: {nx} x {ny} x {nz} voxels of {metric(grid.voxel_size)}, in 1/mm"]
    if steps:
        values["steps"] = steps
        lines += [f"  cycle {s.cycle}, {s.level}: misfit {s.misfit:.4g} before" for s in steps]
    console.summary(values, "\n".join(lines))


def _start(path: Path, grid: "VolumeGrid") -> Any:
    """Read a volume to start from."""
    from clra.errors import InputError
    from clra.io.volumes.volume_files import read_volume

    volume, found = read_volume(path)
    if found.shape != grid.shape:
        raise InputError.at(path, "/volume", f"shape {found.shape}", f"{grid.shape} as of the scan")
    return volume


def _imgr(
    scan: "Scan",
    out: Path,
    grid: "VolumeGrid",
    motion: "Motion | None",
    valid_views: "NDArray[np.bool_] | None",
    align: bool,
    options: dict[str, Any],
    resume: bool,
    console: Console,
    progress: "ProgressCallback",
    limits: dict[str, Any],
) -> "tuple[ImgrStep, ...]":
    """Reconstruct by multigrid iteration, keep what Ctrl-C leaves, or go on from there."""
    import numpy as np

    from clra.app.exit_status import InterruptedCommandError
    from clra.app.resuming import SavedState, fingerprint
    from clra.io.volumes.volume_files import open_volume
    from clra.methods.reconstruction.imgr import imgr
    from clra.methods.reconstruction.imgr_state import ReconstructionInterrupted
    from clra.methods.reconstruction.iterative import sorted_options
    from clra.ops.runtime.devices import usable_devices
    from clra.ops.streaming.stream import Stream

    osem, cycle = sorted_options("imgr", options)
    settings = {
        "align": align,
        "motion": motion
        and f"{motion.cause} " + fingerprint(motion.shift_u, motion.shift_v, motion.magnification),
        "valid_views": None if valid_views is None else fingerprint(valid_views),
        "grid": fingerprint(np.array([*grid.shape, grid.voxel_size, *grid.centre])),
        **options,
    }
    saved = SavedState(out, scan, settings)
    stream = Stream(usable_devices(console.device, progress)[0], report=progress, **limits)
    state = saved.load(stream, grid) if resume else None
    try:
        found = imgr(
            stream,
            scan,
            grid,
            align=align,
            motion=motion,
            valid_views=valid_views,
            truth=scan.truth,
            osem=osem,
            state=state,
            **cycle,
        )
    except ReconstructionInterrupted as stopped:
        saved.save(stopped.state)
        last = stopped.state.steps[-1]
        raise InterruptedCommandError(
            f"{saved.folder} keeps cycle {last.cycle} up to {last.level}, --resume goes on"
        ) from None
    with open_volume(out, grid) as target:
        found.volume.write(target)
    saved.clear()
    return found.steps
