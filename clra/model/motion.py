"""The apparent motion of each radiograph: a shift and a magnification."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clra.errors import InputError
from clra.model.validation import column, same_views, selection, whole

Floats = NDArray[np.float64]

CAUSES = ("detector", "source", "sample")


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Motion:
    """Shift and magnification of each view.

    A feature that the ideal geometry puts at pixel q appears at
    ``c + magnification (q - c) + shift``, c the detector's centre, q and shift ordered (u, v).

    Parameters
    ----------
    shift_u : array_like, (views,)
        Shift toward higher columns [pixel of the full-resolution detector].
    shift_v : array_like, (views,)
        Shift toward higher rows [pixel of the full-resolution detector].
    magnification : array_like, (views,), optional
        Above 1 where the radiograph appears larger; all 1 if not given.
    cause : {"detector", "source", "sample"}
        What moved: the radiograph in its plane, or the source, or the sample as a rigid body
        (:class:`clra.model.rigid.rigid_motion.RigidMotion`). A source that moves shifts what is
        near it farther than what is far; the numbers above are then those of a point at the depth
        of the rotation axis.

    Raises
    ------
    InputError
        If lengths disagree, a number is not finite, a magnification is not positive or `cause` is
        none of these.
    """

    shift_u: Floats
    shift_v: Floats
    magnification: Floats
    cause: str

    def __init__(
        self,
        *,
        shift_u: ArrayLike,
        shift_v: ArrayLike,
        magnification: ArrayLike | None = None,
        cause: str = "detector",
    ) -> None:
        if cause not in CAUSES:
            raise InputError(f"cause: found {cause!r}, expected one of {CAUSES}")
        object.__setattr__(self, "cause", cause)
        if magnification is None:
            magnification = np.ones(np.shape(shift_u))
        object.__setattr__(self, "shift_u", column("shift_u", shift_u, "views"))
        object.__setattr__(self, "shift_v", column("shift_v", shift_v, "views"))
        object.__setattr__(self, "magnification", column("magnification", magnification, "views"))
        same_views(shift_u=self.shift_u, shift_v=self.shift_v, magnification=self.magnification)
        if self.magnification.min() <= 0:
            raise InputError(
                f"magnification: found {self.magnification.min()}, expected positive numbers"
            )

    @classmethod
    def identity(cls, views: int, cause: str = "detector") -> Motion:
        """Return no motion of `views` views."""
        still = np.zeros(whole("views", views))
        return cls(shift_u=still, shift_v=still, cause=cause)

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.shift_u)

    def __len__(self) -> int:
        """Return the number of views."""
        return self.views

    def __eq__(self, other: object) -> bool:
        """Compare exactly, number by number."""
        if not isinstance(other, Motion):
            return NotImplemented
        return self.cause == other.cause and np.array_equal(self.columns(), other.columns())

    def __repr__(self) -> str:
        """Summarise the ranges."""
        u, v, m = ((a.min(), a.max()) for a in self.columns())
        moved = " of the source" if self.cause == "source" else ""
        return (
            f"Motion({self.views} views{moved}, shift_u {u[0]:.4g} to {u[1]:.4g} pixel, "
            f"shift_v {v[0]:.4g} to {v[1]:.4g} pixel, magnification {m[0]:.6g} to {m[1]:.6g})"
        )

    def then(self, residual: Motion) -> Motion:
        """Return this motion followed by `residual`.

        Parameters
        ----------
        residual : Motion
            What is still to be moved once this motion is in the geometry, as a registration of
            measured with re-projected radiographs finds it.

        Raises
        ------
        InputError
            If it is of another number of views.
        """
        if residual.views != self.views:
            raise InputError(f"residual: found {residual.views} views, expected {self.views}")
        m = residual.magnification
        return Motion(
            shift_u=m * self.shift_u + residual.shift_u,
            shift_v=m * self.shift_v + residual.shift_v,
            magnification=m * self.magnification,
            cause=self.cause,
        )

    def inverse(self) -> Motion:
        """Return the motion that undoes this one: ``motion.then(motion.inverse())`` is none."""
        m = self.magnification
        return Motion(
            shift_u=-self.shift_u / m,
            shift_v=-self.shift_v / m,
            magnification=1 / m,
            cause=self.cause,
        )

    def normalised(self) -> Motion:
        """Return the motion with its magnifications divided by their geometric mean.

        That mean cannot be told from the size of the sample.
        """
        return Motion(
            shift_u=self.shift_u,
            shift_v=self.shift_v,
            magnification=self.magnification / np.exp(np.mean(np.log(self.magnification))),
            cause=self.cause,
        )

    def about(self, offset_u: float, offset_v: float) -> Motion:
        """Return the same motion with magnifications about another centre.

        Parameters
        ----------
        offset_u, offset_v : float
            From the centre so far to that point [pixel].
        """
        grown = self.magnification - 1
        return Motion(
            shift_u=self.shift_u + grown * offset_u,
            shift_v=self.shift_v + grown * offset_v,
            magnification=self.magnification,
            cause=self.cause,
        )

    def caused_by(self, cause: str) -> Motion:
        """Return the same apparent motion, of the detector or of the source."""
        return Motion(
            shift_u=self.shift_u,
            shift_v=self.shift_v,
            magnification=self.magnification,
            cause=cause,
        )

    def subset(self, index: slice | ArrayLike) -> Motion:
        """Return the motion of some of the views.

        Parameters
        ----------
        index : slice, int, integers or boolean mask (views,)
            Which views, in that order.
        """
        chosen = selection(index)
        return Motion(
            shift_u=self.shift_u[chosen],
            shift_v=self.shift_v[chosen],
            magnification=self.magnification[chosen],
            cause=self.cause,
        )

    def columns(self) -> tuple[Floats, ...]:
        """Return all numbers that tell it from others but its cause, of (views,) each."""
        return self.shift_u, self.shift_v, self.magnification
