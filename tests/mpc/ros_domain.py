"""Exclusive ROS domain for each test process: nodes in a shared domain would receive each other's messages."""

import fcntl
import os
import tempfile
from functools import cache
from pathlib import Path

# Other programs may use the ports of domains above 101.
_DOMAINS = 101
# Without intra-process delivery, because Fast DDS 2.14 may deadlock if several participants of a process are deleted.
# https://github.com/eProsima/Fast-DDS/issues/6193
_PROFILES = """<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><library_settings>
<intraprocess_delivery>OFF</intraprocess_delivery></library_settings></dds>"""


@cache
def own_domain() -> str:
    """Reserve a domain for this process, set its profile of Fast DDS, and return the number of the domain."""
    folder = Path(tempfile.gettempdir(), f"diffdrive-mpc-ros-domains-{os.getuid()}")
    folder.mkdir(exist_ok=True)
    for number in range(_DOMAINS):
        domain = 1 + (os.getpid() + number) % _DOMAINS
        lock = os.open(folder / str(domain), os.O_CREAT | os.O_RDWR, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            continue
        profiles = folder / f"{domain}.xml"
        profiles.write_text(_PROFILES)
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profiles)
        return str(domain)
    raise RuntimeError(f"all {_DOMAINS} ROS domains are taken; remove {folder}")
