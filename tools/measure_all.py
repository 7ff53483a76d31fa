"""Measure every table of tools/README.md on the present code, one after the other.

``python tools/measure_all.py -o FOLDER`` runs the command of each table and puts what it prints
between its markers in tools/README.md, with machine, driver and version. Each output is kept in
FOLDER/NAME.md as soon as it is there: started again, the tool goes on where it was stopped, unless
``--again`` is given. ``--only NAME`` measures some; ``--list`` prints the names and commands.
``CLRA_TEST_DATA`` names the folder of public data that a few of them read.
"""

import argparse
import importlib.metadata
import platform
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from clra.ops.runtime.devices import choose_device

TOOLS = Path(__file__).resolve().parent
PAGE = TOOLS / "README.md"
# Name of a table, and the tool with its arguments; FOLDER stands for a folder of the table's own.
COMMANDS = {
    "stress": "stress.py run --seeds 1 2 3 4 -o FOLDER",
    "figure3": "reproduce_figure3.py --scale 4 --schedules 1QR-1HR,2QR-2HR,auto -o FOLDER",
    "figure3-full": "reproduce_figure3.py --scale 1 --schedules 1QR-1HR,auto -o FOLDER",
    "ablation": "reproduce_figure3.py --scale 4 --ablation -o FOLDER",
    "real": "real_scan.py --seeds 101 102 103 104 105 106 107 108 109 110 -o FOLDER",
    "rock": "rock.py --scale 4 -o FOLDER",
    "registration": "registration_table.py",
    "bad-views": "bad_views.py --seeds 3 -o FOLDER",
    "baselines": "baselines.py",
    "source": "source_drift.py",
    "katsevich": "exact_helices.py",
    "rigid": "rigid.py -o FOLDER",
    "wood": "figure4_small.py --scale 16 -o FOLDER",
    "imgr": "imgr_small.py",
    "memory": "memory_peaks.py",
    "cluster-equal": "cluster_equal.py",
    "cluster-times": "cluster_times.py",
    "cluster": "cluster_table.py",
    "gpu": "check_gpu.py --only limits",
    "bench": "bench.py --peer rtk --long",
}


def tables(printed: str) -> str:
    """Markdown tables in what a tool printed, with the lines of text between them."""
    lines = printed.splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    return "\n".join(lines)


def where() -> str:
    """One line on the machine and the versions."""
    device = choose_device()
    return (
        f"clra {importlib.metadata.version('clra')}, {device.name.strip()}, "
        f"{device.max_compute_units} cores, {device.platform.version.partition('  ')[0]}, "
        f"Python {platform.python_version()}"
    )


def measure(name: str, folder: Path) -> str:
    """Run the command of a table."""
    own = folder / name
    own.mkdir(parents=True, exist_ok=True)
    words = [str(own) if word == "FOLDER" else word for word in COMMANDS[name].split()]
    command = [sys.executable, str(TOOLS / words[0]), *words[1:]]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return f"`python tools/{COMMANDS[name]}` ({where()})\n\n{tables(done.stdout)}\n"


def insert(page: str, name: str, text: str) -> str:
    """Return the page with a table between its markers replaced."""
    pattern = re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    if not pattern.search(page):
        raise SystemExit(f"{PAGE}: found no markers <!-- {name} --> ... <!-- end -->")
    return pattern.sub(lambda found: f"{found[1]}\n{text}\n{found[2]}", page)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER")
    parser.add_argument("--only", action="append", choices=COMMANDS, default=[], metavar="NAME")
    parser.add_argument("--again", action="store_true", help="measure what is kept already, too")
    parser.add_argument("--list", action="store_true", help="print names and commands")
    options = parser.parse_args(arguments)
    if options.list or options.output is None:
        print(*(f"{name:<14}{command}" for name, command in COMMANDS.items()), sep="\n")
        return
    failed = []
    for name in options.only or COMMANDS:
        kept = options.output / f"{name}.md"
        if options.again or not kept.is_file():
            print(f"{name}: {COMMANDS[name]}", file=sys.stderr, flush=True)
            try:
                text = measure(name, options.output)
            except subprocess.CalledProcessError as error:
                failed.append(f"{name}: exit status {error.returncode}")
                continue
            kept.write_text(text, encoding="utf-8")
        page = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(insert(page, name, kept.read_text(encoding="utf-8")), encoding="utf-8")
    if failed:
        raise SystemExit("\n".join(failed))


if __name__ == "__main__":
    main()
