"""Katsevich's exact reconstruction from one helix or several, streamed."""

import math
from typing import Any

import numpy as np
import pyopencl as cl

from clra.errors import InputError
from clra.methods.truncation import AT_BORDER, profiles
from clra.model.geometry import ConeBeamGeometry
from clra.model.grid import VolumeGrid
from clra.model.helix.fit import fit_helices
from clra.model.helix.helix import Helix
from clra.model.helix.pi_intervals import field_of_view, pi_spans
from clra.model.view_selection import runs, views_that_see
from clra.ops.filtering.katsevich_filter import KatsevichFilter
from clra.ops.projection.pi_backprojector import PiBackProjector
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream
from clra.ops.streaming.volume import PlaneWriter, Volume

# Views of each helix with the helix, and the radius of the field of view [mm].
Exact = tuple[list[tuple[slice, Helix]], float]


def katsevich(
    stream: Stream,
    radiographs: Radiographs,
    geometry: ConeBeamGeometry,
    grid: VolumeGrid,
    *,
    stage: str = "back-projecting",
    fitted: Exact | None = None,
    target: PlaneWriter | None = None,
) -> Volume:
    """Reconstruct exactly from helical radiographs.

    Katsevich's inversion [1]_ for flat detectors, by the five steps of [2]_. Several helices that
    follow each other, such as a double helix, are reconstructed each by itself and averaged where
    more than one of them holds all views of a voxel that the formula needs. Voxels of which no
    helix does, at the ends of the scan and outside the circle that all views see, are 0.

    Parameters
    ----------
    stream : Stream
        Device and memory budget.
    radiographs : Radiographs
        Line integrals at the resolution of `geometry`, free of motion.
    geometry : ConeBeamGeometry
        Of those radiographs: helices about z, upright detectors that face the axis. Start, sense
        and pitch are free, and so is where on the detector the axis is seen.
    grid : VolumeGrid
        Where to reconstruct.
    stage : str
        What progress reports call this.
    fitted : optional
        What :func:`exact_helices` found, if it has been asked already.
    target : PlaneWriter, optional
        Takes the planes of each slab as soon as it is done; the volume is then not kept.

    Returns
    -------
    Volume
        Attenuation [1/mm]; without its slabs if they went to `target`.

    Raises
    ------
    InputError
        If the trajectory is no helix, the detector shorter than the Tam-Danielsson window, the
        sample wider than the field of view, or the helix too short for any of the grid; the message
        says what would do.

    References
    ----------
    .. [1] A. Katsevich, "Theoretically exact filtered backprojection-type inversion algorithm for
       spiral CT", SIAM J. Appl. Math. 62, 2012 (2002).
    .. [2] F. Noo, J. Pack, D. Heuscher, "Exact helical reconstruction using native cone-beam
       geometries", Phys. Med. Biol. 48, 3787 (2003).
    """
    helical, radius = fitted or exact_helices(radiographs, geometry, grid)
    # Steps 1 to 4: derivative, to kappa lines, Hilbert transform, back to rows.
    memory: dict[str, Any] = {"allocator": stream.memory, "scratch_limit": stream.scratch_limit}
    filters = [KatsevichFilter(stream.context, helix, radius, **memory) for _, helix in helical]
    helices = [one.helix for one in filters]
    volume = Volume(stream, grid)
    seeing = [
        [views_that_see(helix.geometry(), slab) for helix in helices] for slab in volume.slabs
    ]
    total, done = sum(int(chosen.sum()) for slab in seeing for chosen in slab), 0
    for index, slab in enumerate(volume.slabs):
        nz, ny, nx = slab.shape
        attenuation = stream.empty((ny, nx, nz))
        attenuation.fill(np.float32(0), queue=stream.queue)
        for number, (all_views, _) in enumerate(helical):
            # Step 5: back-projection over pi-intervals.
            back = PiBackProjector(stream.context, helices, number, slab, radius, **memory)
            busy: list[tuple[cl.Event, tuple[Any, ...]]] = []
            for run in runs(seeing[index][number]):
                for chunk in stream.chunks(run.stop - run.start, radiographs.view_bytes):
                    views = slice(run.start + chunk.start, run.start + chunk.stop)
                    stream.report(stage, done, total)
                    first = all_views.start + views.start
                    count = views.stop - views.start
                    # The filter makes one view from two.
                    measured = stream.upload(radiographs.read(slice(first, first + count + 1)))
                    filtered = stream.empty((count, *helices[number].shape))
                    ready = filters[number](stream.queue, filtered, measured)
                    event = back(stream.queue, attenuation, filtered, views=views, wait_for=[ready])
                    # One chunk is read and copied while another is worked on; none may be let go
                    # before.
                    busy.append((event, (measured, filtered)))
                    if len(busy) > 1:
                        busy[0][0].wait()
                        del busy[0]
                    del measured, filtered
                    done += count
            stream.queue.finish()
        if target is None:
            volume.put(index, attenuation)
        else:
            volume.write_slab(index, attenuation, target)
        del attenuation  # before the next slab is made
    stream.report(stage, total, total)
    return volume


def exact_helices(radiographs: Radiographs, geometry: ConeBeamGeometry, grid: VolumeGrid) -> Exact:
    """Find the helices of a scan, and refuse what :func:`katsevich` cannot treat.

    Parameters
    ----------
    radiographs, geometry, grid
        As :func:`katsevich` takes them. A few radiographs are read; of these, any that differ much
        in mean or contrast say nothing: a dark one would be a sample that is too wide.

    Returns
    -------
    helices : list of (slice, Helix)
        Views of each helix, and the helix.
    radius : float
        Of the field of view about the axis [mm].

    Raises
    ------
    InputError
        As :func:`katsevich` does.
    """
    fitted = fit_helices(geometry)
    radius = field_of_view([helix for _, helix in fitted], grid)
    _refuse_short([helix.between() for _, helix in fitted], grid, radius)
    for views, helix in fitted:
        _refuse_wide_sample(radiographs, views, helix, radius)
    return fitted, radius


def _refuse_short(helices: list[Helix], grid: VolumeGrid, radius: float) -> None:
    """Raise where no plane of the grid has a voxel whose pi-interval is on a helix."""
    plane = grid.slab(0, 1)
    planes = grid.shape[0]
    for helix in helices:
        low, high = np.moveaxis(pi_spans(helix, plane, radius), 2, 0)
        if ((np.maximum(low, 0) <= np.minimum(high, planes - 1)) & np.isfinite(low)).any():
            return
    z = [end for helix in helices for end in (helix.z, helix.z + helix.views * helix.z_step)]
    raise InputError(
        f"grid: found heights {grid.coordinates()[2][0]:.4g} to {grid.coordinates()[2][-1]:.4g} mm "
        f"of which the helix, {min(z):.4g} to {max(z):.4g} mm, holds no pi-interval, expected more "
        "turns, a smaller pitch or another grid"
    )


def _refuse_wide_sample(
    radiographs: Radiographs, views: slice, helix: Helix, radius: float
) -> None:
    """Raise where a sample reaches beyond the field of view, as far as radiographs show it."""
    border = math.tan(helix.fan(radius))
    tangent = helix.tangent_u(np.arange(helix.shape[1]))
    rows = slice(*helix.window_rows(radius))
    inside = np.flatnonzero(np.abs(tangent) <= border)
    seen = profiles(radiographs, views, rows)[:, inside]
    borders = seen[:, [0, -1]].max(axis=1)
    worst = int(borders.argmax())
    cut, most = borders[worst], seen[worst].max()
    if cut > AT_BORDER * seen.max():
        # As wide as a round sample on the axis with the same line integrals would be.
        width = 2 * radius / math.sqrt(max(1 - (cut / most) ** 2, 1e-2))
        raise InputError(
            f"radiographs: the sample reaches beyond the field of view of {2 * radius:.4g} mm "
            f"(line integrals of {cut:.3g} at its border, {most:.3g} inside), expected a field of "
            f"view of about {width:.4g} mm or a smaller sample; or use method 'fbp'"
        )
