"""Trials that end as those of broken devices do."""

import json
import sys
from collections.abc import Sequence
from typing import Any

import pytest

from clra.ops.runtime import self_test

RIGHT = """print('{"failure": "", "rate": null}')"""
WRONG = """print('{"failure": "vectors: wrong numbers, off by 0.5", "rate": null}')"""
HANGS = "import time; time.sleep(600)"
ABORTS = """
import os, resource, sys
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
print("LLVM ERROR: Cannot select: FILD", file=sys.stderr, flush=True)
os.abort()
"""
ENDS = "import sys; print('driver: out of memory', file=sys.stderr); sys.exit(3)"

# What the child does, and what clra says of it.
BROKEN = {
    "aborts": (ABORTS, r"its compiler or driver ended by SIGABRT \(LLVM ERROR: Cannot select: "),
    "ends": (ENDS, r"its compiler or driver ended with status 3 \(driver: out of memory\)"),
    "hangs": (HANGS, "does not come to an end within 1 s"),
    "wrong": (WRONG, "vectors: wrong numbers, off by 0.5"),
}


def replace_trials(patch: pytest.MonkeyPatch, programs: Sequence[str]) -> list[dict[str, Any]]:
    """Let trials be these programs, one after the other and then the last one; what was asked."""
    left, asked = list(programs), []

    def command(request: str) -> list[str]:
        asked.append(json.loads(request))
        return [sys.executable, "-c", left.pop(0) if len(left) > 1 else left[0]]

    patch.setattr(self_test, "_command", command)
    if HANGS in programs:
        patch.setattr(self_test, "SECONDS", 1.0)
    return asked


def forget(patch: pytest.MonkeyPatch, folder: Any) -> None:
    """Know nothing of any device, and keep what is found out in a folder."""
    patch.setattr(self_test, "_verdicts", {})
    patch.setattr(self_test, "cache_folder", lambda: folder)
    patch.delenv(self_test.VARIABLE, raising=False)
