"""The house: floors, cycles, sizes, names and words."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "clra"
FLOORS = ("kernels", "model", "ops", "methods", "io", "app")
# Used by every floor, and the package's own face.
GROUND = {"errors", "progress", "findings", "__init__"}
MOST_LINES, MOST_FILES = 350, 13

pytestmark = pytest.mark.skipif(not (ROOT / "kernels").is_dir(), reason="not run in a checkout")


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def dotted(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree: ast.AST) -> Iterator[str]:
    """Names that a module imports, with what it takes of them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def imports() -> dict[str, set[str]]:
    """Modules of clra that each module imports, at run time or inside a function."""
    known = {dotted(path) for path in modules()}
    found: dict[str, set[str]] = {}
    for path in modules():
        names = set()
        for name in imported(ast.parse(path.read_text(encoding="utf-8"))):
            while name not in known and "." in name:
                name = name.rpartition(".")[0]
            if name in known:
                names.add(name)
        found[dotted(path)] = names - {dotted(path)}
    return found


def floor(name: str) -> int:
    parts = name.split(".")
    return FLOORS.index(parts[1]) if len(parts) > 1 and parts[1] in FLOORS else -1


def test_every_module_stands_on_a_floor():
    for path in modules():
        parts = path.relative_to(PACKAGE).parts
        assert parts[0] in FLOORS or (len(parts) == 1 and path.stem in GROUND), path


def test_modules_import_from_their_own_floor_and_below():
    up = {
        (name, other)
        for name, others in imports().items()
        for other in others
        if name != "clra" and floor(other) > floor(name)
    }
    assert up == set()


def test_no_import_cycle():
    graph, done, way = imports(), set(), []
    del graph["clra"]

    def visit(name: str) -> None:
        assert name not in way, " -> ".join([*way[way.index(name) :], name])
        if name in done or name not in graph:
            return
        way.append(name)
        for other in sorted(graph[name]):
            visit(other)
        way.pop()
        done.add(name)

    for name in graph:
        visit(name)


@pytest.mark.parametrize(
    ("floor", "library"), [("model", "pyopencl"), ("model", "h5py"), ("methods", "h5py")]
)
def test_libraries_stay_on_their_floors(floor, library):
    for path in (PACKAGE / floor).rglob("*.py"):
        for name in imported(ast.parse(path.read_text(encoding="utf-8"))):
            assert name.split(".")[0] != library, path


def test_one_module_tells_cpus_from_gpus():
    # devices lists kinds and self_test gives advice; what runs is the profile's choice.
    asking = {
        path.stem
        for path in modules()
        if re.search(r"is_cpu|device_type\.CPU", path.read_text(encoding="utf-8"))
    }
    assert asking <= {"profile", "devices", "self_test"}


def test_files_are_short():
    files = [*modules(), *(ROOT / "kernels").glob("*.cl*"), *(ROOT / "tools").glob("*.py")]
    long = {path.name: n for path in files if (n := path.read_text().count("\n")) > MOST_LINES}
    assert long == {}


def test_folders_hold_a_handful_of_files():
    count = Counter(path.parent for path in modules() if path.name != "__init__.py")
    assert {str(folder): n for folder, n in count.items() if n > MOST_FILES} == {}


def test_no_two_modules_share_a_name():
    names = Counter(
        path.stem
        for path in modules()
        if path.name not in ("__init__.py", "__main__.py") and path.parent.name != "commands"
    )
    assert [name for name, n in names.items() if n > 1] == []


def test_no_two_public_classes_share_a_name():
    names = Counter(
        node.name
        for path in modules()
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, n in names.items() if n > 1] == []


def test_each_package_says_what_is_in_it():
    for path in PACKAGE.rglob("__init__.py"):
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), path


# Words that a reader of the field would have to guess, see the left column of the style guide's
# table, and words that only somebody at the developers' own workplace could understand.
DIALECT = (
    r"\bpanels?\b", r"\bbelieved\b", r"\bheirs?\b", r"\bhanded_on\b", r"\btwins?\b", r"Say so if",
    r"\bLeftover\b", r"\bturned_back\b", r"\bin small\b", r"\bbeforehand\b",
)  # fmt: skip


def texts() -> list[Path]:
    endings = ("*.py", "*.cl", "*.clh", "*.md")
    folders = (PACKAGE, ROOT / "kernels", ROOT / "tools", ROOT / ".github")
    found = [path for folder in folders for ending in endings for path in folder.rglob(ending)]
    return [ROOT / "README.md", *found]


@pytest.mark.parametrize("word", DIALECT)
def test_words_are_those_of_the_field(word):
    said = [
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for path in texts()
        for line in path.read_text(encoding="utf-8").splitlines()
        if re.search(word, line, re.IGNORECASE) and "0.1.0" not in line
    ]
    assert said == []


def test_readme_is_short():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = text.splitlines()
    assert len(lines) <= 150
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    assert len(prose.split()) <= 1000
    assert max(len(line) for line in lines if not line.startswith("|")) <= 100


@pytest.mark.parametrize("folder", ["clra", "clra/ops", "kernels", "tests", "tools"])
def test_folder_has_a_page(folder):
    assert (ROOT / folder / "README.md").is_file()


def test_tests_read_no_clock():
    clock = r"\b(perf_counter|process_time|thread_time|monotonic)\b|\btime\.time\("
    for path in (ROOT / "tests").rglob("*.py"):
        if path != Path(__file__):
            assert not re.search(clock, path.read_text(encoding="utf-8")), path
