"""Options of the commands that correct defects of the radiographs."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from clra.app.arguments import coefficients, view_numbers

if TYPE_CHECKING:
    from clra.model.corrections.correction_options import CorrectionOptions


@dataclass(frozen=True)
class Correcting:
    """Which defects of the radiographs are corrected first."""

    exclude: Annotated[
        str | None,
        typer.Option(metavar="VIEWS", help="Views not to use, from 0, such as 3,17,40-52."),
    ] = None
    rings: Annotated[
        bool,
        typer.Option(
            "--rings", help="Take out what pixels show in the mean of all views: ring artefacts."
        ),
    ] = False
    beam_hardening: Annotated[
        str | None,
        typer.Option(
            metavar="C1,C2,...",
            help="Of a calibration: line integrals p become p + C1 p^2 + C2 p^3 + ...",
        ),
    ] = None
    no_corrections: Annotated[
        bool,
        typer.Option(
            "--no-corrections",
            help="Leave bad pixels, zingers and the beam's intensity as they are; by default they "
            "are found and corrected.",
        ),
    ] = False

    def options(self) -> "CorrectionOptions":
        """Return what was asked for."""
        from clra.model.corrections.correction_options import CorrectionOptions

        wanted = not self.no_corrections
        hardening = self.beam_hardening
        return CorrectionOptions(
            bad_pixels=wanted,
            zingers=wanted,
            intensity=wanted,
            rings=self.rings,
            beam_hardening=() if hardening is None else coefficients("--beam-hardening", hardening),
            exclude=() if self.exclude is None else view_numbers("--exclude", self.exclude),
        )
