"""One resolution of a multigrid reconstruction, whose work is shared out to several workers."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.methods.reconstruction.imgr_level import Bools, Floats, MultigridLevel
from clra.methods.reconstruction.residuals import RadiographComparison
from clra.methods.shared_work.multigrid_tasks import (
    CompareWithVolume,
    ProlongateSlab,
    RestoreSlab,
    RestrictSlab,
    SubtractSimulated,
)
from clra.methods.shared_work.shared_ordered_subsets import shared_osem_tr, shared_start_volume
from clra.methods.shared_work.shared_scan import SharedRadiographs, SharedScan, SharedVolume
from clra.methods.shared_work.tasks import ReconstructSlab
from clra.methods.truncation import extension
from clra.model.motion import Motion
from clra.model.view_selection import sampled
from clra.ops.streaming.part_files import RadiographParts, VolumeParts


@dataclass
class SharedMultigridLevel(MultigridLevel):
    """A level whose radiographs and volumes are in files.

    The motion, the views that are rejected and the stop rule stay with the caller.

    Parameters
    ----------
    shared : SharedScan
        Its scan, and who does the work.
    """

    shared: SharedScan = field(kw_only=True)

    @cached_property
    def radiographs(self) -> SharedRadiographs:
        """The measured radiographs, binned when they are needed."""
        return self.shared.binned(self.stream, self.factor)

    def restored(self, planes: NDArray[np.float32]) -> SharedVolume:
        """Return a volume that was kept, copied: what keeps it is replaced later on."""
        parts = self.shared.volume_parts(self.grid, self.volumes)
        return self._by_slab(RestoreSlab(planes, parts), "reading what was kept", "checkpoint")

    def first(self, motion: Motion, valid_views: Bools) -> SharedVolume:
        """Return the volume to start from: steps 1 and 2."""
        return self.shared.source(
            shared_start_volume(
                self.shared,
                self.stream,
                self.radiographs,
                self.geometry(motion),
                self.grid,
                self.osem,
                valid_views=valid_views,
            )
        )

    def brought(self, volume: SharedVolume, title: str | None) -> SharedVolume:
        """Bring the volume of the level before to this resolution; no title, no reports."""
        if not self.lowest:
            fine = self.shared.volume_parts(self.grid, self.volumes)
            return self._by_slab(ProlongateSlab(volume.parts, fine), "prolongating", title)
        for _ in range(self.factor.bit_length() - 1):
            coarse = self.shared.volume_parts(volume.grid.binned(2), self.volumes)
            volume = self._by_slab(RestrictSlab(volume.parts, coarse), "restricting", title)
        return volume

    def corrected(
        self,
        volume: SharedVolume,
        simulated: RadiographParts,
        motion: Motion,
        *,
        moved: Floats | None,
        valid_views: Bools,
        title: str,
    ) -> SharedVolume:
        """Add what the radiographs hold beyond simulated ones: steps 15, 21."""
        measured, workers = self.radiographs.measured, self.shared.workers
        lacking = self.shared.radiograph_parts("lacking", self.factor)
        subtract = SubtractSimulated(measured, simulated, self.used, moved, lacking)
        workers.map(subtract, lacking.parts, stage=f"{title}: subtracting")
        geometry, left = self.geometry(motion), SharedRadiographs.in_files(lacking, self.factor)
        options = {
            "valid_views": valid_views,
            "extend": extension(left, geometry, valid_views),
            "volumes": self.volumes,
            "step": sampled(geometry, self.grid),
        }
        target = self.shared.like(volume.parts)
        task = ReconstructSlab(left.measured, geometry, target, options, onto=volume.parts)
        return self._by_slab(task, "correcting", title)

    def reconstruct(
        self, volume: SharedVolume, motion: Motion, valid_views: Bools, title: str
    ) -> SharedVolume:
        """Raise the likelihood of the volume by OSEM-TR: step 9."""
        parts, _ = shared_osem_tr(
            self.shared,
            self.stream,
            self.radiographs,
            self.geometry(motion),
            volume.parts,
            self.osem,
            used=self.used,
            valid_views=valid_views,
            stage=f"{title}: OSEM-TR",
        )
        return self.shared.source(parts)

    def _compared(
        self, compare: RadiographComparison, volume: SharedVolume, motion: Motion, stage: str
    ) -> tuple[RadiographParts, float, Floats | None]:
        simulated = self.shared.radiograph_parts("simulated", self.factor)
        task = CompareWithVolume(
            self.shared.held,
            self.radiographs.measured,
            volume.parts,
            self.geometry(motion),
            motion.magnification,
            compare,
            simulated,
        )
        found = self.shared.workers.map(task, simulated.parts, stage=stage)
        table = np.concatenate([part for _, part in found]) if compare.registering else None
        return simulated, sum(deviance for deviance, _ in found), table

    def _by_slab(self, task: Any, doing: str, title: str | None) -> SharedVolume:
        """Do a task with each slab of its target; return that."""
        target: VolumeParts = task.target
        self.shared.workers.map(
            task,
            range(len(target.planes)),
            stage=f"{title or 'full resolution'}: {doing}",
            part=None if title is None else (0, 1),
        )
        return self.shared.source(target)
