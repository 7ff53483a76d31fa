"""Loops and instruction classes of machine code: NVIDIA's SASS and AMD's GCN."""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

# NVIDIA's, by the part of the operation before its first dot.
_SASS = {
    "FP32": "FFMA FADD FMUL FFMA32I FADD32I FMUL32I",
    "MUFU": "MUFU",
    "CVT": "F2I I2F FRND F2F I2I F2IP I2IP",
    "FCMP": "FMNMX FSEL FSETP FSET FCHK FMNMX3 I2FP F2FP",
    "INT": "IADD3 LEA IADD SHF LOP3 ISETP IMNMX SEL ISCADD IABS BMSK SGXT PRMT POPC FLO VIMNMX "
    "VIADD VIADDMNMX ISET LOP SHL SHR VIMNMX3",
    "IMAD": "IMAD IMUL",
    "LOAD": "LDG LD",
    "STORE": "STG ST",
    "LDS": "LDS STS LDSM ATOMS",
    "LOCAL": "LDL STL",
    "CONST": "LDC ULDC LDCU",
    "FP64": "DFMA DADD DMUL DSETP",
}
_SASS_CLASS = {name: kind for kind, names in _SASS.items() for name in names.split()}
_JUMPS = ("BRA", "JMP", "BRX", "EXIT", "RET")


def nvidia_class(operation: str) -> str:
    """Class of an instruction, for example "FP32"; "INT64" of addresses, "other" of the rest."""
    base = operation.partition(".")[0]
    if base == "IMAD" and ".WIDE" in operation:
        return "INT64"
    if base in ("IADD3", "LEA", "IADD") and (".X" in operation or ".HI" in operation):
        return "INT64"
    if base == "IMAD" and ".MOV" in operation:
        return "other"
    return _SASS_CLASS.get(base, "other")


def amd_class(operation: str) -> str:
    """Class of an instruction of GCN or RDNA; "SALU" and "other" take no slot of the vector ALU."""
    if operation.startswith(("global_load", "flat_load", "buffer_load")):
        return "LOAD"
    if operation.startswith("ds_"):
        return "LDS"
    if "store" in operation:
        return "STORE"
    if not operation.startswith("v_"):
        return "SALU" if operation.startswith("s_") else "other"
    if re.match(r"v_(rcp|rsq|sqrt|exp|log|sin|cos)", operation):
        return "MUFU"
    if re.match(r"v_cvt|v_trunc|v_floor|v_fract|v_rndne|v_ceil", operation):
        return "CVT"
    if re.match(r"v_(dual_)?(pk_)?(fma|mul|add|sub|subrev|mac|fmac|mad)\w*_f32", operation):
        return "FP32"
    if re.match(r"v_(mad_u64|mad_i64|lshlrev_b64|lshl_b64|add_co|addc|mul_hi)", operation):
        return "INT64"
    return "INT"


@dataclass
class Block:
    """Instructions without a jump among them, and the blocks that may follow."""

    classes: Counter[str] = field(default_factory=Counter)
    follow: list[int] = field(default_factory=list)
    jump: tuple[str, str, str] | None = None  # predicate, operation, operands


@dataclass(frozen=True)
class Loop:
    """One loop of a kernel.

    Attributes
    ----------
    own : Counter
        Instructions by class, those of inner loops left out.
    always : Counter
        Of these, what runs in every turn.
    inner : int
        Number of loops within.
    """

    own: Counter[str]
    always: Counter[str]
    inner: int

    @property
    def size(self) -> int:
        """Instructions of its own."""
        return self.own.total()


def nvidia_kernels(text: str) -> dict[str, list[Loop]]:
    """Loops of each kernel in the output of ``nvdisasm -c``, in the order of the code."""
    found: dict[str, list[Loop]] = {}
    for part in re.split(r"^\s*\.section\s+\.text\.", text, flags=re.MULTILINE)[1:]:
        name = part.partition(",")[0].strip()
        found[name] = _loops(_blocks(_nvidia_lines(part), _nvidia_ways))
    return found


def amd_kernels(text: str) -> dict[str, list[Loop]]:
    """Loops of each kernel in LLVM's assembly, in the order of the code."""
    found: dict[str, list[Loop]] = {}
    for match in re.finditer(r"^(\w+):\s*; @\w+\n(.*?)^\s*\.section", text, re.M | re.S):
        found[match[1]] = _loops(_blocks(_amd_lines(match[2]), _amd_ways))
    return found


# Lines of code: ("label", name, "", "") or ("", operation, operands, predicate).
Line = tuple[str, str, str, str]


def _nvidia_lines(part: str) -> Iterator[Line]:
    for line in part.splitlines():
        code = line.partition("//")[0].strip()
        if label := re.match(r"^(\.L_\S+):$", code):
            yield "label", label[1], "", ""
        elif one := re.match(r"/\*[0-9a-f]+\*/\s+(@!?U?P\w+\s+)?([A-Z0-9_.]+)(.*?);", code):
            if one[2] != "NOP":
                yield nvidia_class(one[2]), one[2], one[3].strip(), (one[1] or "").strip()


def _amd_lines(part: str) -> Iterator[Line]:
    for line in part.splitlines():
        if label := re.match(r"^(\.LBB\w+):", line):
            yield "label", label[1], "", ""
        elif one := re.match(r"^\s+([a-z]\w+)\s*(.*?)(;.*)?$", line):
            yield amd_class(one[1]), one[1], one[2].strip(), ""


def _nvidia_ways(predicate: str, operation: str, operands: str) -> tuple[str | None, bool] | None:
    """Where a jump leads, and whether the next block may follow; None if it is no jump."""
    base = operation.partition(".")[0]
    if base not in _JUMPS:
        return None
    target = re.search(r"`\((\S+?)\)", operands)
    conditional = predicate != "" or re.match(r"!?U?P\d", operands) is not None
    return (target[1] if target and base in ("BRA", "JMP") else None), conditional


def _amd_ways(predicate: str, operation: str, operands: str) -> tuple[str | None, bool] | None:
    if operation.startswith(("s_endpgm", "s_setpc")):
        return None, False
    if operation.startswith(("s_cbranch", "s_branch")):
        return operands.split()[0], operation.startswith("s_cbranch")
    return None


def _blocks(
    lines: Iterator[Line], ways: Callable[[str, str, str], tuple[str | None, bool] | None]
) -> list[Block]:
    blocks, labels, ends = [Block()], {}, {}
    fresh = True
    for kind, operation, operands, predicate in lines:
        if kind == "label":
            if not fresh:
                blocks.append(Block())
            labels[operation], fresh = len(blocks) - 1, True
            continue
        fresh = False
        blocks[-1].classes[kind] += 1
        way = ways(predicate, operation, operands)
        if way is not None:
            ends[len(blocks) - 1] = way
            blocks.append(Block())
            fresh = True
    for number, block in enumerate(blocks):
        target, on = ends.get(number, (None, True))
        if target in labels:
            block.follow.append(labels[target])
        if on and number + 1 < len(blocks):
            block.follow.append(number + 1)
    return blocks


def _loops(blocks: list[Block]) -> list[Loop]:
    before: dict[int, list[int]] = defaultdict(list)
    for number, block in enumerate(blocks):
        for other in block.follow:
            before[other].append(number)
    everything = set(range(len(blocks)))
    dominators = [{0}] + [everything.copy() for _ in blocks[1:]]
    changed = True
    while changed:
        changed = False
        for number in range(1, len(blocks)):
            sets = [dominators[p] for p in before[number]]
            new = {number} | (set.intersection(*sets) if sets else set())
            changed |= new != dominators[number]
            dominators[number] = new
    bodies: dict[int, set[int]] = {}
    latches: dict[int, list[int]] = defaultdict(list)
    for number, block in enumerate(blocks):
        for head in block.follow:
            if head in dominators[number]:
                body, left = bodies.setdefault(head, {head}), [number]
                latches[head].append(number)
                while left:
                    one = left.pop()
                    if one not in body:
                        body.add(one)
                        left += before[one]
    found = []
    for head in sorted(bodies):
        inner = [other for other in bodies if other != head and other in bodies[head]]
        own = bodies[head].difference(*(bodies[other] for other in inner))
        always = {one for one in own if all(one in dominators[end] for end in latches[head])}
        loop = Loop(_sum(blocks, own), _sum(blocks, always), len(inner))
        if loop.size > 2:  # the trap behind a kernel's end jumps to itself
            found.append(loop)
    return found


def _sum(blocks: list[Block], numbers: set[int]) -> Counter[str]:
    return sum((blocks[number].classes for number in numbers), Counter())
