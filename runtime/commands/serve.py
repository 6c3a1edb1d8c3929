"""`hololoop-runtime serve`: the service that owns the headset."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from runtime.program.command import Command, Result
from runtime.program.screen import Screen

DESCRIPTION = """Run the service that owns the headset's panel, lasers and camera, until it is stopped.

CONFIG is one TOML file:

  schema = 1
  bundle = "bundle"                      # from hololoop-trainer export; paths are from this file's folder

  [service]
  socket = "/run/hololoop/service.sock"  # unless systemd passes one
  refresh_hz = 60.0                      # pictures a second
  solve_ms = 12.0                        # time for a pattern
  stale_limit_ms = 80.0                  # what is older than this is not lit
  metrics_port = 9464                    # http://127.0.0.1:9464/metrics; 0: none
  users = [1000]                         # who may connect, as well as root and the service's own user
  channel = "green"                      # the colour to show, where the bundle has several and the panel one field

  [panel]
  kind = "board"                         # or dlpc900, mirrored, "my_lab:panel"
  # fields = 3                           # colours in turn, all of the bundle's; without it, one
  [lasers]
  bus = "/dev/i2c-1"
  power = { green = 0.5 }                # fraction of full while something is shown
  channel = [                            # calibration of each, in the order of the DAC's outputs
    { name = "red", wavelength_nm = 638.0, full_power_uw = 120.0, threshold_ma = 45.0, slope_uw_per_ma = 4.0 },
    { name = "green", wavelength_nm = 520.0, full_power_uw = 100.0, threshold_ma = 40.0, slope_uw_per_ma = 4.0 },
    { name = "blue", wavelength_nm = 450.0, full_power_uw = 15.0, threshold_ma = 30.0, slope_uw_per_ma = 1.0 },
  ]
  [camera]                               # may be left out
  kind = "oak"

Without hardware: python -m firmware_iface.virtual.served SOCKET --bench virtual:demo emulates it, with these three
lasers, and bus = "virtual:SOCKET" in [panel], [lasers] and (with kind = "virtual") [camera] leads there. The bundle
is one of the same bench. firmware_iface/configured_devices.py lists all keys.

A line on standard error says when programs may connect. They do so as runtime.service.client does in Python;
hololoop_service.h, next to it, is for C. The lasers are dark until a program clears and arms them, and after every
fault until it does so again.

With --dark nothing is served: the lasers are switched off, for ExecStopPost= in the service's unit. Unit files are
in the folder that `hololoop-runtime serve --units DIR` writes."""


def options(parser: ArgumentParser) -> None:
    """The options of `serve`."""
    parser.add_argument("config", metavar="CONFIG", type=Path, help="the headset's TOML file")
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--dark", action="store_true", help="switch the lasers off and stop")
    only.add_argument(
        "--units", metavar="DIR", type=Path, help="write systemd's unit files for CONFIG and stop"
    )


def run(args: Namespace, screen: Screen) -> Result:
    """Serve until stopped."""
    from firmware_iface.configured_devices import open_lasers
    from runtime.service.configuration import read_configuration
    from runtime.service.supervisor import Supervisor

    configuration = read_configuration(args.config)
    if args.dark:
        lasers = open_lasers(configuration.devices["lasers"])
        lasers.off()
        lasers.close()
        return {"dark": True}
    if args.units is not None:
        from runtime.service.systemd_units import write_units

        return {"units": [str(path) for path in write_units(configuration, args.units)]}
    supervisor = Supervisor(configuration)
    supervisor.run()
    return {"served": supervisor.counts}


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What was done, in a line or two."""
    if "dark" in result:
        screen.say("the lasers are off")
    for path in result.get("units", []):
        screen.say(str(path))
    if served := result.get("served"):
        screen.say(", ".join(f"{count} {name}" for name, count in served.items()))


COMMAND = Command(
    name="serve",
    about="Run the headset's service.",
    options=options,
    run=run,
    show=show,
    examples=("serve headset.toml", "serve headset.toml --units units/"),
    after="See that its devices answer: devices headset.toml",
    description=DESCRIPTION,
)
