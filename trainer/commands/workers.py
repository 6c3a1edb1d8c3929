"""How many processes a command uses: --workers and --cluster."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from firmware_iface.errors import InputError
from runtime.program.options import whole
from runtime.program.threads import cores


def worker_options(parser: ArgumentParser, cluster: bool = True) -> None:
    """--workers and --cluster."""
    workers_option(
        parser,
        "processes that fit candidates at the same time (default: one a core, and on a given capture set "
        "no more than memory is there for; 1: this process alone)",
    )
    if cluster:
        parser.add_argument(
            "--cluster", metavar="ADDRESS", help="fit on a Dask cluster instead, such as tcp://10.0.0.5:8786"
        )


def workers_option(parser: ArgumentParser, what: str) -> None:
    """--workers."""
    parser.add_argument("--workers", metavar="N", type=whole(1, 4096), default=None, help=what)


def workers_of(args: Namespace) -> int:
    """How many processes to use; with one, this process takes every core.

    Raises
    ------
    InputError
        For several processes, or a cluster, on a GPU.
    """
    on_gpu = getattr(args, "device", "cpu") == "cuda"
    if on_gpu and (args.workers not in (None, 1) or getattr(args, "cluster", None) is not None):
        raise InputError(
            "with --device cuda one process computes on the GPU: leave out --workers and --cluster"
        )
    workers = 1 if on_gpu else int(args.workers or _by_default(getattr(args, "captures", None)))
    if workers == 1:
        use_every_core()
    return workers


def _by_default(folder: Path | None) -> int:
    """How many processes to use for captures in a folder."""
    if folder is None:
        return cores()
    from trainer.fitting.process_memory import processes_for

    return processes_for(folder)


def use_every_core() -> None:
    """Let torch use all of this process's processors: for work that is done in this process."""
    import torch

    torch.set_num_threads(cores())
