"""Alignments that start from a rigid motion: it is absorbed, and what is found follows it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from clra.model.geometry import ConeBeamGeometry
from clra.model.motion import Motion
from clra.model.rigid.rigid_gauge import between
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.scan import Scan


@dataclass(frozen=True)
class RigidStart:
    """A scan whose geometry has absorbed the motion to start from.

    Attributes
    ----------
    nominal : ConeBeamGeometry
        Without any motion.
    scan : Scan
        With the motion to start from in its geometry; the truth is not known of what is left.
    """

    nominal: ConeBeamGeometry
    scan: Scan

    @classmethod
    def of(cls, scan: Scan, motion: RigidMotion) -> RigidStart:
        """Absorb a motion into a scan."""
        moved = replace(scan, geometry=scan.geometry.with_motion(motion), truth=None)
        return cls(scan.geometry, moved)

    def followed_by(self, found: Motion) -> RigidMotion:
        """Return the whole motion, from the nominal geometry on.

        Parameters
        ----------
        found : Motion
            What was left. Shifts and magnifications count as translations of the sample that show
            the same at the depth of the axis.
        """
        moved = self.scan.geometry
        if not isinstance(found, RigidMotion):
            found = RigidMotion.from_shifts(found, moved)
        return between(self.nominal, moved.with_motion(found))
