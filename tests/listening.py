"""At which addresses processes of this machine listen, as Linux tells."""

from __future__ import annotations

import os
import socket
from pathlib import Path


def addresses(port: int | None = None) -> set[str]:
    """Of a TCP port; without one, of this process."""
    own = None if port is not None else _sockets()
    found = set()
    for family, table in ((socket.AF_INET, "tcp"), (socket.AF_INET6, "tcp6")):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            address, _, number = fields[1].partition(":")
            wanted = int(number, 16) == port if own is None else fields[9] in own
            if fields[3] == "0A" and wanted:
                words = [bytes.fromhex(address[i : i + 8])[::-1] for i in range(0, len(address), 8)]
                found.add(socket.inet_ntop(family, b"".join(words)))
    return found


def _sockets() -> set[str]:
    """Inodes of the sockets of this process."""
    links = []
    for name in os.listdir("/proc/self/fd"):
        try:
            links.append(os.readlink(f"/proc/self/fd/{name}"))
        except OSError:  # closed meanwhile
            continue
    return {link[8:-1] for link in links if link.startswith("socket:[")}
