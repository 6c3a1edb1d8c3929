"""Numbers of a result as the commands' sentences have them."""

from __future__ import annotations

from runtime.program.command import Result

LIKENESS = ("psnr_db", "ssim", "one_minus_lpips")  # how alike two pictures are, as results name it


def percent_text(share: float | None) -> str:
    """A share as per cent."""
    return "not known" if share is None else f"{100 * share:.3g} %"


def small_text(value: float | None) -> str:
    """An excess, two digits."""
    return "not known" if value is None else f"{value:.2g}"


def sizes_text(parameters: Result, most: int | None = None) -> str:
    """The parameters of an effect in one line, at most `most` of them."""
    from trainer.formatting import parameters as lines

    return "; ".join(f"{p.name} {p.text}" for p in lines(parameters)[:most])
