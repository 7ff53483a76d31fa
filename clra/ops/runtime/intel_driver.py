"""Intel's OpenCL runtime for CPUs, as the packages of ``clra[intel]`` install it.

The packages bring the driver but do not register it. OpenCL's loader looks for drivers once a
process, in a folder of one-line text files: before it does, it is given one that has Intel's beside
those of the system. pyopencl's own loader adds the PoCL that comes with it.
"""

import hashlib
import os
import site
import sys
from pathlib import Path

SYSTEM = Path("/etc/OpenCL/vendors")
# Who sets one of these chooses the drivers himself.
CHOSEN = ("OCL_ICD_VENDORS", "OCL_ICD_FILENAMES", "OPENCL_VENDOR_PATH")


def register(cache: Path) -> None:
    """Let this process's OpenCL loader find Intel's driver, if it is installed beside clra.

    Parameters
    ----------
    cache : Path
        Where to make the folder of drivers.
    """
    driver = find()
    if driver is None or any(os.environ.get(name) for name in CHOSEN):
        return
    texts = registered(SYSTEM, Path(sys.prefix) / "etc" / "OpenCL" / "vendors")
    if any("intelocl" in text for text in texts.values()):
        return
    texts["clra-intel.icd"] = f"{driver}\n"
    name = hashlib.sha256(repr(sorted(texts.items())).encode()).hexdigest()[:16]
    folder = cache / f"drivers-{name}"
    try:
        folder.mkdir(exist_ok=True)
        for file, text in texts.items():
            if not (folder / file).exists():
                part = folder / f".{file}.{os.getpid()}"
                part.write_text(text)
                part.replace(folder / file)
    except OSError:  # full by now: the drivers of the system are still there
        return
    os.environ["OCL_ICD_VENDORS"] = str(folder)


def find() -> Path | None:
    """Intel's driver in this Python's environment; None if it is not installed."""
    if sys.platform != "linux":
        return None
    places = (
        Path(prefix) / "lib" / "libintelocl.so" for prefix in (sys.prefix, site.USER_BASE or "")
    )
    return next((place for place in places if place.exists()), None)


def registered(*folders: Path) -> dict[str, str]:
    """Drivers registered in some folders, by file name, without those that are not there."""
    texts: dict[str, str] = {}
    for folder in folders:
        for file in sorted(folder.glob("*.icd")):
            try:
                text = file.read_text()
            except (OSError, UnicodeDecodeError):
                continue
            library = text.strip()
            # Intel's packages leave files that name a folder of the machine they were made on.
            if not library.startswith("/") or Path(library).exists():
                texts.setdefault(file.name, text)
    return texts
