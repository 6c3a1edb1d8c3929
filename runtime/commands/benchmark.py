"""`hololoop-runtime benchmark`: the solver measured on this machine."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from runtime.program.command import Command, Result
from runtime.program.screen import Screen

DESCRIPTION = """Measure the solver on this machine, in one run of some minutes.

An iteration against its transforms alone, convergence by iteration and by time against Adam and Gerchberg-Saxton,
deadlines, a warm-started video, memory and sizes; at 1080 x 1920 and two smaller sizes, on scikit-image's pictures,
520 nm, 8 um, 200 mm. Times are medians; compare ratios of one run, not milliseconds of two."""


def options(parser: ArgumentParser) -> None:
    """There are none but --json."""


def run(args: Namespace, screen: Screen) -> Result:
    """Measure."""
    from runtime.benchmark.measure import measure

    with screen.progress("benchmark") as progress:
        return measure(progress=progress)


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """The figures as a table."""
    latency, video = result["latency_ms"], result["video"]
    rows = [
        (
            "an iteration / four whole transforms",
            f"{result['iteration_ms']:.1f} / {result['fft_floor_ms']:.1f} ms",
        ),
        ("ratio", f"{result['iteration_over_floor']:.2f}"),
        ("ratio to the rows and columns it does transform", f"{result['iteration_over_pruned_fft']:.2f}"),
        ("cold start, in iterations", f"{result['cold_start_over_iteration']:.2f}"),
        ("deadline", f"{result['deadline_ms']:.0f} ms"),
        (
            "solves by it: p50, p95, p99",
            f"{latency['p50']:.0f}, {latency['p95']:.0f}, {latency['p99']:.0f} ms",
        ),
        ("past the deadline", f"{result['deadline_misses']} of {result['solves']}"),
        ("peak memory", f"{result['peak_memory_mb']:.0f} MB"),
    ]
    for name, psnr in result["final_psnr_db"].items():
        count = len(result["psnr_by_iteration"][name]) - 1
        rows.append((f"{name}, {count} iterations", f"{psnr:.2f} dB"))
    for name in ("whole_frame", "inside_border"):
        both = f"{video[name]['warm_psnr_db']:.2f} / {video[name]['cold_psnr_db']:.2f} dB"
        rows.append((f"video, {name.replace('_', ' ')}: one warm iteration / ten cold", both))
    for size in result["scaling"]:
        rows.append((f"an iteration of {size['pixels']} pixels", f"{size['iteration_ms']:.1f} ms"))
    for what, figure in rows:
        screen.say(f"{what:<52} {figure}")


COMMAND = Command(
    name="benchmark",
    about="Measure the solver on this machine.",
    options=options,
    run=run,
    show=show,
    examples=("benchmark", "benchmark --json"),
    description=DESCRIPTION,
)
