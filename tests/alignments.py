"""Alignments that were made up."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from clra.io.alignment_file import write_alignment
from clra.methods.alignment.result import AlignmentResult
from clra.model.motion import Motion


def keep_motion(path: Path, motion: Motion, flagged: Sequence[int] = (), **fields: Any) -> None:
    """Write an alignment file of which nothing but a motion and rejected views is known."""
    valid_views = ~np.isin(np.arange(motion.views), flagged)
    write_alignment(path, replace(AlignmentResult.from_motion(motion, valid_views), **fields))
