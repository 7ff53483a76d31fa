"""Passes over all subsets, and the step of a volume at each; whoever does the work."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pyopencl.array import Array

from clra.ops.statistics.poisson import VolumeStep
from clra.ops.streaming.stream import Stream

# A voxel whose denominator is below this part of the largest is hardly met by rays.
_LEAST = 1e-4
# Steps are this much longer than the paraboloids ask for. Anything below 2 still raises the
# likelihood; 1.5 saves a pass in three, 1.9 gathers more noise.
_RELAXATION = 1.5


class SubsetWork(Protocol):
    """Who does the work: with the volume and the views of all subsets.

    Attributes
    ----------
    subsets : int
        Number of subsets.
    """

    @property
    def subsets(self) -> int:
        """How many; see above."""
        ...

    def weigh(self, stage: str) -> None:
        """Precompute the denominator, A' (a c): c are the curvatures at the measured counts."""
        ...

    def update(self, subset: int, stage: str) -> None:
        """Project the volume into the views of a subset, compare, back-project, and step."""
        ...

    def misfit(self) -> float:
        """Return the mean deviance of the rays compared since this was asked last."""
        ...


def raise_likelihood(
    work: SubsetWork,
    rule: "StepRule",
    passes: int,
    *,
    stage: str,
    done: int,
    after_pass: Callable[[int], None] | None,
) -> list[float]:
    """Step by step, raise the likelihood of a volume.

    Parameters
    ----------
    work : SubsetWork
        Who does the work.
    rule : StepRule
        Of the steps.
    passes, done : int
        How often all subsets are used, those before this call among them.
    stage : str
        What progress reports call this.
    after_pass : callable, optional
        Called with the number of each pass that is finished.

    Returns
    -------
    list of float
        Misfit of each pass.
    """
    if rule.precomputed and done < passes:
        work.weigh(f"{stage}: weighing rays")
    misfits = []
    for number in range(done + 1, passes + 1):
        for subset in range(work.subsets):
            work.update(subset, f"{stage}: pass {number}/{passes}")
        misfits.append(work.misfit())
        if after_pass is not None:
            after_pass(number)
    return misfits


@dataclass(frozen=True)
class StepRule:
    """How voxels change by what is back-projected of a subset.

    Parameters
    ----------
    update : str
        As for :class:`clra.methods.reconstruction.osem_tr.OrderedSubsets`.
    subsets : int
        Number of subsets.
    """

    update: str
    subsets: int

    @property
    def precomputed(self) -> bool:
        """Whether one denominator, that of all views, serves all steps."""
        return self.update == "paraboloid"

    def __call__(
        self, stream: Stream, volume: Array, numerator: Array, denominator: Array, largest: float
    ) -> None:
        """Change a slab in place.

        Parameters
        ----------
        stream : Stream
            Device.
        volume, numerator, denominator : Array
            Slab (ny, nx, planes), and what is back-projected to it.
        largest : float
            Largest denominator of all slabs.
        """
        step = VolumeStep(stream.context)
        # mu <- max(0, mu + subsets numerator / d), or mu <- mu numerator / denominator
        if self.update == "multiplicative":
            step.multiply(stream.queue, volume, numerator, denominator)
        else:
            scale = _RELAXATION * (self.subsets if self.precomputed else 1)
            step.add(stream.queue, volume, numerator, denominator, scale, _LEAST * largest)
        stream.queue.finish()
