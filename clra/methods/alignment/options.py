"""What an iteration of alignment is made of; each part can be switched off to see what it does."""

from dataclasses import dataclass

import numpy as np

from clra.errors import InputError
from clra.methods.alignment.acceleration import Anderson
from clra.methods.alignment.reprojection import SPREAD, registration_for
from clra.model.scan import Scan
from clra.ops.registration.gauss_newton import Registration
from clra.ops.registration.phase_correlation import PhaseCorrelation
from clra.ops.streaming.radiographs import Radiographs
from clra.ops.streaming.stream import Stream

# Diagonal of the images, pixels, from which on re-projections are good as they are: at half of the
# paper's resolution, 530 pixels, they are displaced by 0.008 pixel in v and 5e-5 in magnification.
_GOOD = 400
# And from which on they are sharp enough to tell how far they are displaced. Scans of 232 x 128, in
# images of 116 x 64 and half of it, end at 0.010 pixel in v and 2.8e-4 in magnification instead of
# 0.016 and 3.2e-4 (helix, random motion) with volumes sharpened before, a scan of 135 x 160 at 0.33
# pixel in u instead of 0.39.
_SHARP = 200

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
    """

    estimator: str = "gauss-newton"
    memory: int = 3
    circle: bool = True
    unbias: bool = True
    shifts_first: bool = True
    spread: float = SPREAD

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
            unbias=False,
            shifts_first=False,
            spread=0.0,
        )

    def registration(
        self,
        stream: Stream,
        scan: Scan,
        radiographs: Radiographs,
        *,
        first: bool,
        magnification: bool,
    ) -> Registration | PhaseCorrelation:
        """Step 4's estimator; arguments as of `registration_for`."""
        if self.estimator == "phase-correlation":
            return PhaseCorrelation(stream.context, radiographs.shape[1:], allocator=stream.memory)
        return registration_for(
            stream,
            scan,
            radiographs,
            first=first,
            magnification=magnification,
            spread=self.spread,
        )

    def is_biased(self, shape: tuple[int, int]) -> bool:
        """Whether what is found with images of (rows, columns) has to be corrected."""
        return self.unbias and float(np.hypot(*shape)) < _GOOD

    def is_blurred(self, shape: tuple[int, int]) -> bool:
        """Whether a volume is sharpened before it tells the displacement of (rows, columns)."""
        return float(np.hypot(*shape)) < _SHARP

    def acceleration(self) -> Anderson:
        """Return an extrapolation that knows no steps yet."""
        return Anderson(self.memory)
