"""Frames of a detector that was mounted on its side."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clra.io.frames.stacks import FrameStack


class TurnedFrames:
    """Frames (n, rows, columns) turned by 90 degrees: their last columns become the first rows.

    A rotation axis that runs along the rows of the files is vertical then, its right end on top.

    Parameters
    ----------
    stack : FrameStack
        Frames as they are stored.
    """

    def __init__(self, stack: FrameStack) -> None:
        count, rows, columns = stack.shape
        self._stack = stack
        self.shape = (count, columns, rows)
        self.dtype = stack.dtype
        self.files = stack.files

    def __getitem__(self, frames: slice) -> NDArray[Any]:
        """Read some frames."""
        return np.rot90(self._stack[frames], axes=(1, 2))

    def close(self) -> None:
        """Close the files."""
        self._stack.close()
