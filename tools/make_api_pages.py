"""Make pages of the public names and all modules from their docstrings: needs ``pdoc``.

``python tools/make_api_pages.py OUT_DIR`` writes HTML; ``OUT_DIR/clra.html`` is where to begin.
Fails where a public name does not get onto its page.
"""

import pkgutil
import sys
import warnings
from pathlib import Path

import pdoc

import clra


def main() -> int:
    if len(sys.argv) != 2:
        print(f"usage: {sys.argv[0]} OUT_DIR", file=sys.stderr)
        return 2
    folder = Path(sys.argv[1])
    for name in clra.__all__:  # which are handed on lazily, and pdoc looks for what is there
        setattr(clra, name, getattr(clra, name))
    # pdoc goes from `clra` to what is public, and into each floor for the rest.
    floors = [floor.name for floor in pkgutil.iter_modules(clra.__path__, "clra.") if floor.ispkg]
    floors.remove("clra.kernels")
    pdoc.render.configure(docformat="numpy")
    with warnings.catch_warnings():
        # of names that are imported for type checkers only
        warnings.filterwarnings("ignore", "Error parsing type annotation", UserWarning)
        pdoc.pdoc("clra", *floors, output_directory=folder)
    front = (folder / "clra.html").read_text(encoding="utf-8")
    missing = [name for name in clra.__all__ if f'id="{name}"' not in front and name != "kernels"]
    if missing:
        print(f"no {', '.join(missing)} in {folder / 'clra.html'}", file=sys.stderr)
        return 1
    print(f"{len(list(folder.rglob('*.html')))} pages")
    return 0


if __name__ == "__main__":
    sys.exit(main())
