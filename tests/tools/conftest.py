import importlib
from pathlib import Path

import pytest


@pytest.fixture
def tool(monkeypatch):
    """Import a tool, which finds its neighbours as it does when it is run."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "tools"))
    return importlib.import_module
