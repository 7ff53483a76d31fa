"""The option of the commands whose work a cluster can share."""

from typing import Annotated

import typer

Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS|FILE|local:N|slurm:N",
        help="Workers of dask.distributed to share the work out to: a scheduler's address or file, "
        "N processes here, or N jobs. They have to see the scan and the output's folder.",
    ),
]
