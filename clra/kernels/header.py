"""C declarations of the kernels: their names, their files, and the places of their arguments."""

import re
from dataclasses import dataclass

from clra import kernels
from clra.errors import InputError

_KERNEL = re.compile(r"^kernel\b.*\bvoid (\w+)\($")
# By the house's rule an argument is one line: type, name, and what it is.
_ARGUMENT = re.compile(r"^ +(?P<type>[^,]*?)(?P<name>\w+)[,)] *(?:// *(?P<meaning>.*))?$")


@dataclass(frozen=True)
class Argument:
    """One argument of a kernel.

    Attributes
    ----------
    type : str
        As declared, for example ``"global const float *restrict"``.
    name : str
        Its name.
    meaning : str
        Shape, unit and the like; may be empty.
    """

    type: str
    name: str
    meaning: str


@dataclass(frozen=True)
class Signature:
    """One kernel.

    Attributes
    ----------
    name : str
        Of the function.
    file : str
        That it is in.
    arguments : tuple of Argument
        In order.
    """

    name: str
    file: str
    arguments: tuple[Argument, ...]


def signatures(file: str) -> tuple[Signature, ...]:
    """Read the kernels of one file.

    Parameters
    ----------
    file : str
        Name, for example ``"backproject.cl"``.

    Returns
    -------
    tuple of Signature
        In the file's order.

    Raises
    ------
    InputError
        If there is no such file, or an argument is not one line.
    """
    found: list[Signature] = []
    lines = iter(kernels.source(file).splitlines())
    for line in lines:
        if kernel := _KERNEL.match(line):
            arguments = []
            for declaration in lines:
                if declaration == "{":
                    break
                argument = _ARGUMENT.match(declaration)
                if argument is None:
                    raise InputError(f"{file}: found {declaration!r}, expected one argument")
                kind, name, meaning = argument.group("type", "name", "meaning")
                arguments.append(Argument(kind.strip(), name, meaning or ""))
            found.append(Signature(kernel.group(1), file, tuple(arguments)))
    return tuple(found)


def header() -> str:
    """Return a C header with every kernel's name, file and arguments.

    For each kernel ``name`` it defines ``CLRA_NAME`` and ``CLRA_NAME_FILE``, and an enumeration of
    the indices that ``clSetKernelArg`` takes, ``CLRA_NAME_ARGUMENT``, which ends with their number,
    ``CLRA_NAME_ARGUMENTS``. Where a kernel's arguments change, so do the indices, and a host that
    uses these still compiles to what is right, or does not compile.

    Returns
    -------
    str
        C90, usable from C++.
    """
    parts = [_PREAMBLE]
    for file in kernels.names():
        parts += [_declarations(signature) for signature in signatures(file)]
    return "\n".join([*parts, "#endif\n"])


_PREAMBLE = """\
/* The kernels of clra, written by `python -m clra.kernels`.
 *
 * The head comment of each file says what its kernels do and which global sizes they take; the
 * comment at each argument says its shape and unit. Each file compiles alone, as OpenCL C 1.2,
 * without definitions. A buffer is followed by an offset into it, in elements (cl_ulong).
 */
#ifndef CLRA_KERNELS_H
#define CLRA_KERNELS_H
"""


def _declarations(signature: Signature) -> str:
    prefix = f"CLRA_{signature.name.upper()}"
    lines = [
        f"/* {signature.name} in {signature.file} */",
        f'#define {prefix} "{signature.name}"',
        f'#define {prefix}_FILE "{signature.file}"',
        "enum {",
    ]
    for argument in signature.arguments:
        meaning = f": {argument.meaning}" if argument.meaning else ""
        lines.append(f"    {prefix}_{argument.name.upper()}, /* {argument.type}{meaning} */")
    return "\n".join([*lines, f"    {prefix}_ARGUMENTS", "};", ""])
