"""What an iteration of alignment is made of; each part can be switched off to see what it does."""

import math
from dataclasses import dataclass

import numpy as np

from clra.errors import InputError
from clra.methods.alignment.reprojection import SPREAD, is_large, registration_for, spread_of
from clra.methods.alignment.steps.acceleration import Anderson
from clra.model.geometry import ConeBeamGeometry
from clra.model.sampling.angular_coverage import covered
from clra.model.scan import Scan
from clra.ops.registration.gauss_newton import Registration
from clra.ops.registration.phase_correlation import PhaseCorrelation
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

# Diagonal of the images, pixels, from which on re-projections are good as they are: at half of the
# paper's resolution, 530 pixels, they are displaced by 0.008 pixel in v and 5e-5 in magnification.
_GOOD = 400

ESTIMATORS = ("gauss-newton", "phase-correlation")


@dataclass(frozen=True)
class Solver:
    """The parts of re-projection alignment. ``Solver.paper()`` has none but the paper's.

    ``tools/reproduce_figure3.py --ablation`` prints what becomes of the errors without each.

    Parameters
    ----------
    estimator : {"gauss-newton", "phase-correlation"}
        `Registration`, or the paper's: the peak of the phase
        correlation, refined by a parabola, which finds shifts only.
    memory : int
        Steps from one iteration to the next of a level that Anderson acceleration looks back on; 0
        for plain steps.
    circle : bool
        Reconstruct nothing outside the circle that all views see.
    positive : bool
        Raise negative attenuations of the volume to zero before it is projected: they are streaks,
        which displace the re-projections of a moved scan, most on circles and arcs of them.
    terms : int
        Corrections of a non-negative volume by what its radiographs have beyond its re-projections,
        see :func:`clra.methods.reconstruction.fitted_fbp.fitted_fbp`.
    unbias : bool
        Once at each level whose images are small, find how far the artefacts of the reconstruction
        displace its re-projections, see `reprojections`, and take it off
        what all its iterations find. Soft modes add it up: to 1e-3 of magnification at an
        eighth of the paper's resolution, where the volume is blurred most. It hardly depends on the
        motion.
    shifts_first : bool
        Leave the magnification alone in the first of several iterations: radiographs that do not
        fit each other yet tell a wrong one, 3e-3 for the paper's smooth motion on a helix, which
        takes many iterations to get rid of.
    spread : float
        Expected standard deviation of log(magnification); 0 if nothing is known.
    prealign : bool
        Begin schedule "auto" with shifts by sums over the radiographs, where the motion is large or
        the scan an arc of a parallel beam, whose slow modes they tell better than re-projections,
        see :func:`clra.methods.alignment.prealignment.prealignment.prealigned`; on other arcs with
        the column of the axis.
    harmonics : bool
        Of a truncated sample on a circle, fit the odd harmonics of the shifts along u in the end,
        see :func:`clra.methods.alignment.steps.odd_harmonics.fitted_harmonics`.
    """

    estimator: str = "gauss-newton"
    memory: int = 3
    circle: bool = True
    positive: bool = True
    terms: int = 1
    unbias: bool = True
    shifts_first: bool = True
    spread: float = SPREAD
    prealign: bool = True
    harmonics: bool = True

    def __post_init__(self) -> None:
        if self.estimator not in ESTIMATORS:
            raise InputError(f"estimator: found {self.estimator!r}, expected one of {ESTIMATORS}")

    @classmethod
    def paper(cls) -> "Solver":
        """Return Algorithm 1 as it is printed, which leaves the gauge free, see `clra.align`."""
        return cls(
            estimator="phase-correlation",
            memory=0,
            circle=False,
            positive=False,
            terms=0,
            unbias=False,
            shifts_first=False,
            spread=0.0,
            prealign=False,
            harmonics=False,
        )

    def registration(
        self,
        stream: Stream,
        scan: Scan,
        radiographs: Radiographs,
        *,
        first: bool,
        magnification: bool,
        pulled: bool = True,
    ) -> Registration | PhaseCorrelation:
        """Step 4's estimator; arguments as of `registration_for`, and whether it pulls at all."""
        if self.estimator == "phase-correlation":
            return PhaseCorrelation(stream.context, radiographs.shape[1:], allocator=stream.memory)
        return registration_for(
            stream,
            scan,
            radiographs,
            first=first,
            magnification=magnification,
            spread=self.spread if pulled and not self.jitter(radiographs.shape[1:]) else 0.0,
        )

    def jitter(self, shape: tuple[int, ...]) -> float:
        """Spread of magnifications that have to be pulled after registering (rows, columns).

        0 where registration does so in each view: small images cannot tell even a slow drift, and
        leave it for the next level.
        """
        return self.spread if is_large((shape[0], shape[1])) else 0.0

    def pull(self, shape: tuple[int, ...]) -> float:
        """Spread to which registration of (rows, columns) pulls magnifications; 0 for none."""
        return 0.0 if self.jitter(shape) else spread_of(self.spread, (shape[0], shape[1]))

    def is_biased(self, geometry: ConeBeamGeometry) -> bool:
        """Whether what is found with radiographs of this geometry has to be corrected.

        On a part of a turn what registers of a volume made of re-projections is no measure of it:
        taken off, it grew from level to level, to 0.3 pixel in v where 0.02 remain without.
        """
        small = float(np.hypot(*geometry.shape)) < _GOOD
        return self.unbias and small and covered(geometry) == 2 * math.pi

    def acceleration(self) -> Anderson:
        """Return an extrapolation that knows no steps yet."""
        return Anderson(self.memory)
