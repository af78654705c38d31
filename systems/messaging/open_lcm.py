"""Where messages travel."""

import os
import time

from lcm import LCM

DEFAULT_URL = "udpm://239.255.76.67:7667?ttl=0&recv_buf_size=4000000"
"""LCM's own group and port, seen on this host only (ttl=0); a buffer for images."""

_PROBE = "SPLATPILOT_PROBE"

# LCM waits by select(), which overwrites its stack for files numbered from 1024; it opens several.
_MOST_FILES = 1000


def open_lcm(url: str = DEFAULT_URL) -> LCM:
    """
    Opens LCM and makes sure that it delivers.

    Args:
        url: as LCM has it, `udpm://GROUP:PORT?ttl=HOPS` or, within this process, `memq://`.

    Raises:
        OSError: if there is no such provider, the port is in use by something else, or there is no
            route for multicast.
    """
    if not url.startswith(("udpm://", "memq://")):
        raise OSError(f"the LCM URL is {url!r}; it must begin with udpm:// or memq://")
    with open(os.devnull) as file:
        if file.fileno() >= _MOST_FILES:
            raise OSError(
                f"LCM cannot use {url}: {file.fileno()} files are open in this process, at most "
                f"{_MOST_FILES} may be; close what is no longer needed"
            )
    heard = []
    try:
        lcm = LCM(url)
        probe = lcm.subscribe(_PROBE, lambda _, data: heard.append(data))
        deadline = time.monotonic() + 2.0
        # It gives no subscription where it cannot have the port; why is on standard error.
        while probe is not None and not heard and time.monotonic() < deadline:
            lcm.publish(_PROBE, b"")
            lcm.handle_timeout(100)
    except (RuntimeError, OSError) as error:
        raise OSError(f"LCM cannot use {url}: {error}; {_REMEDY}") from None
    if probe is None or not heard:
        raise OSError(f"LCM at {url} does not deliver its own messages; {_REMEDY}")
    lcm.unsubscribe(probe)
    return lcm


_REMEDY = (
    "use a multicast group and a port that only LCM has, and give the host a multicast route "
    "(ip route add 224.0.0.0/4 dev lo)"
)
