"""systemd's unit files for a configuration."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from runtime.bundle.whole_files import whole_file
from runtime.service.configuration import Configuration

SERVICE = """[Unit]
Description=Holographic headset
Requires=hololoop.socket
After=hololoop.socket
StartLimitIntervalSec=60
StartLimitBurst=5

[Service]
Type=notify
NotifyAccess=main
ExecStart={command} serve {config}
# After every end, for any reason: the safety controller's dead-man has already darkened the lasers.
ExecStopPost={command} serve --dark {config}
WatchdogSec=2
WatchdogSignal=SIGKILL
Restart=on-failure
RestartSec=200ms
TimeoutStopSec=3
KillMode=control-group
RuntimeDirectory=hololoop
RuntimeDirectoryPreserve=yes
# The heartbeat must not wait for other processes: 20 ms of the 100 ms are its own. The solver gets one priority less.
CPUSchedulingPolicy=rr
CPUSchedulingPriority=10
LimitMEMLOCK=infinity
DevicePolicy=closed
DeviceAllow=char-i2c rw
DeviceAllow=char-usb_device rw
SupplementaryGroups=i2c plugdev video
NoNewPrivileges=yes
ProtectSystem=strict
ProtectHome=read-only
PrivateTmp=yes
RestrictAddressFamilies=AF_UNIX AF_NETLINK AF_INET
RestrictSUIDSGID=yes
LockPersonality=yes

[Install]
WantedBy=multi-user.target
"""

SOCKET = """[Unit]
Description=Socket of the holographic headset

[Socket]
ListenSequentialPacket={socket}
SocketMode=0660
SocketGroup=video
Accept=no
RemoveOnStop=yes

[Install]
WantedBy=sockets.target
"""


def write_units(configuration: Configuration, folder: Path) -> list[Path]:
    """Write hololoop.service and hololoop.socket into `folder`, made if it does not exist; returns their paths.

    Raises
    ------
    InputError
        Where they cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    found = shutil.which("hololoop-runtime", path=str(Path(sys.executable).parent)) or shutil.which(
        "hololoop-runtime"
    )
    command = f'"{found}"' if found else f'"{sys.executable}" -m runtime.cli'
    config = '"' + str(configuration.file).replace("%", "%%") + '"'
    texts = {
        "hololoop.service": SERVICE.format(command=command.replace("%", "%%"), config=config),
        "hololoop.socket": SOCKET.format(socket=str(configuration.socket).replace("%", "%%")),
    }
    paths = []
    for name, text in texts.items():
        with whole_file(folder / name, "w") as file:
            file.write(text)
        paths.append(folder / name)
    return paths
